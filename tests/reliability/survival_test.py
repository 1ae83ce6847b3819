"""Runs survive torn files, dead processes and diverging worlds."""

import csv
import math
import os
import pathlib
import subprocess
import sys
from typing import Any, Iterator
from unittest import mock

import numpy as np
import pytest
from tensorboard.backend.event_processing import event_accumulator
import torch

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.utils import files

_RUN = run_config.RunConfig(
  modes='idle,walk_forward',
  num_worlds=8,
  threads=1,
  one_hot=True,
  ppo=ppo_config.PPOConfig(
    hidden_sizes=(8,), rollout_length=4, minibatches=1, epochs=1
  ),
)
_ITERATION = 8 * 4  # Control steps.


class _Recorder:
  """A logger that keeps its rows."""

  def __init__(self) -> None:
    self.rows: list[dict[str, float]] = []

  def write(self, values: Any) -> None:
    self.rows.append(dict(values))

  def close(self) -> None:
    pass


@pytest.fixture(scope='module', autouse=True)
def _one_thread() -> Iterator[None]:
  before = torch.get_num_threads()
  yield
  torch.set_num_threads(before)


@pytest.fixture(scope='module')
def run() -> setup.Run:
  """Worlds to be poisoned; whoever uses it begins where the last one ended."""
  motions = library.resolve(_RUN.modes)
  return setup.build(_RUN, mode_set.one_hot(motions))


def _train(run: setup.Run, iterations: int) -> list[dict[str, float]]:
  """Trains for some iterations more; returns their rows."""
  logger, steps = _Recorder(), run.loop.steps + iterations * _ITERATION
  config = runner.TrainingConfig(steps=steps, log_every=1)
  run.loop.run(config, logger, lambda: None)
  return logger.rows


# Worlds that diverge.


def test_they_are_counted_and_the_count_is_kept(run: setup.Run) -> None:
  before = _train(run, 1)[-1]['diverged']
  run.environment.qvel[[1, 5], 3] = math.nan
  assert _train(run, 1)[-1]['diverged'] == before + 2
  assert np.isfinite(run.environment.qpos).all()
  assert _train(run, 1)[-1]['diverged'] == before + 2
  tensors, values = run.loop.state()
  tensors = {k: torch.as_tensor(v).clone() for k, v in tensors.items()}
  assert values['diverged'] == before + 2
  run.environment.qvel[3, 3] = math.nan
  assert _train(run, 1)[-1]['diverged'] == before + 3
  run.loop.restore(tensors, values)
  assert _train(run, 1)[-1]['diverged'] == before + 2
  # A checkpoint from before they were counted.
  del values['diverged']
  run.loop.restore(tensors, values)
  assert _train(run, 1)[-1]['diverged'] == 0


def test_too_many_end_the_run(run: setup.Run) -> None:
  """More than 20 in 20,000 control steps, and not one fewer."""
  run.loop.restore(*_copied(run))  # A new window.
  for _ in range(5):
    run.environment.qvel[:4, 3] = math.nan
    _train(run, 1)
  iterations, weights = run.loop.iterations, run.network.state_dict()
  weights = {key: value.clone() for key, value in weights.items()}
  run.environment.qvel[0, 3] = math.nan
  with pytest.raises(FloatingPointError, match='21 worlds diverged') as caught:
    _train(run, 1)
  assert 'physics_timestep' in str(caught.value)
  assert '\n' not in str(caught.value)
  assert run.loop.iterations == iterations + 1
  for key, value in run.network.state_dict().items():
    assert torch.equal(value, weights[key]), key


def _copied(run: setup.Run) -> tuple[dict[str, torch.Tensor], Any]:
  tensors, values = run.loop.state()
  copies = {k: torch.as_tensor(v).clone() for k, v in tensors.items()}
  return copies, values


def test_no_tensor_of_another_shape_is_taken_over(run: setup.Run) -> None:
  run.loop.restore(*_copied(run))  # A new window.
  _train(run, 1)
  tensors, values = _copied(run)
  assert len(tensors) > 40
  for name in tensors:
    other = {**tensors, name: torch.zeros(3, 5, 7)}
    with pytest.raises(ValueError) as caught:
      run.loop.restore(other, values)
    assert len(str(caught.value).splitlines()) == 1, name
  for name in ('steps', 'iterations'):
    with pytest.raises(ValueError):
      run.loop.restore(tensors, {**values, name: None})
  with pytest.raises(ValueError, match='worlds have made'):
    run.loop.restore(tensors, {**values, 'steps': 1})
  further = {'learner/optimiser/policy/99/exp_avg': torch.zeros(1)}
  with pytest.raises(ValueError, match='damaged'):
    run.loop.restore({**tensors, **further}, values)
  run.loop.restore(tensors, values)


# Files.


def test_no_bit_of_a_checkpoint_may_differ(tmp_path: pathlib.Path) -> None:
  checkpointer = checkpointing.Checkpointer(tmp_path)
  for steps in (1, 2):
    checkpointer.save(
      {
        'a': torch.arange(4.0),
        'b': torch.tensor([True, False]),
        'c': np.array(3),
        'd': np.zeros((0, 2)),
      },
      {'steps': steps},
    )
  path = tmp_path / checkpointing.NAME
  content = path.read_bytes()
  tensors, values, note = checkpointer.load()
  assert values['steps'] == 2 and not note
  noticed = 0
  for place in range(len(content)):
    damaged = bytearray(content)
    damaged[place] ^= 1 << (place % 8)
    path.write_bytes(damaged)
    found, metadata, note = checkpointer.load()
    if not note:  # White space, say, or the name of the checksum.
      assert metadata == values and found.keys() == tensors.keys(), place
      assert all(torch.equal(found[key], tensors[key]) for key in found), place
      continue
    noticed += 1
    assert metadata['steps'] == 1, place
    assert note.endswith(f'Resuming from {checkpointing.PREVIOUS}.')
  assert noticed > 0.9 * len(content)


def test_a_checkpoint_from_before_there_were_checksums(
  tmp_path: pathlib.Path,
) -> None:
  with mock.patch.object(checkpointing, '_checksum', return_value=0):
    checkpointing.save_tensors(tmp_path / 'file', {'x': torch.zeros(2)}, {})
  path = tmp_path / 'file'
  with pytest.raises(ValueError, match='checksum'):
    checkpointing.load_tensors(path)
  path.write_bytes(path.read_bytes().replace(b'"crc32"', b'"other"'))
  tensors, _ = checkpointing.load_tensors(path)
  assert tensors['x'].tolist() == [0, 0]


@pytest.mark.parametrize('steps', [None, 3.0, True])
def test_a_checkpoint_without_its_steps_is_none(
  tmp_path: pathlib.Path, steps: Any
) -> None:
  checkpointer = checkpointing.Checkpointer(tmp_path)
  checkpointer.save({'x': torch.zeros(2)}, {'steps': steps})
  with pytest.raises(ValueError, match='not a training checkpoint'):
    checkpointer.load()


def test_what_dead_processes_left_goes(tmp_path: pathlib.Path) -> None:
  done = subprocess.run([sys.executable, '-c', 'import os; print(os.getpid())'],
    capture_output=True, text=True, check=True,
  )  # fmt: skip
  dead = tmp_path / f'.file.{done.stdout.strip()}.tmp'
  kept = [
    tmp_path / f'.file.{os.getppid()}.tmp',  # Somebody is writing it.
    tmp_path / f'.other.{done.stdout.strip()}.tmp',
    tmp_path / '.file.x.tmp',
    tmp_path / '.file.1.2',
  ]
  for path in (dead, *kept):
    path.write_bytes(b'half')
  files.write(tmp_path / 'file', b'whole')
  found = {path.name for path in tmp_path.iterdir()}
  assert found == {'file', *(path.name for path in kept)}


def test_a_row_that_was_cut_off_is_dropped(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'metrics.csv'
  for torn in ('3', '30,', '30,0.', '30,0.3\r'):
    path.write_text(f'steps,a\r\n10,0.1\r\n20,0.2\r\n{torn}', newline='')
    loggers.CSVLogger(path, resume_from=40).close()
    with open(path, newline='', encoding='utf-8') as file:
      assert [row['steps'] for row in csv.DictReader(file)] == ['10', '20']


@pytest.mark.parametrize(
  'text',
  [
    'steps,a\r\n10\r\n',
    'steps,a\r\nten,0.1\r\n',
    'steps,a\r\n10,"' + 'x' * 200_000 + '"\r\n',
  ],
)
def test_a_log_that_is_none(tmp_path: pathlib.Path, text: str) -> None:
  path = tmp_path / 'metrics.csv'
  path.write_text(text, newline='')
  with pytest.raises(ValueError, match=r'metrics\.csv does not hold') as caught:
    loggers.CSVLogger(path, resume_from=40)
  assert '\n' not in str(caught.value)


def test_events_are_on_disk_when_a_process_dies(tmp_path: pathlib.Path) -> None:
  logger = loggers.TensorBoardLogger(tmp_path)
  logger.write({'steps': 10, 'a': 1.0})
  events = event_accumulator.EventAccumulator(str(tmp_path))
  events.Reload()  # Nothing was closed.
  assert [event.step for event in events.Scalars('a')] == [10]
  logger.close()


def test_all_loggers_are_closed_whatever_one_raises() -> None:
  parts = [mock.Mock(), mock.Mock(), mock.Mock()]
  loggers.Dispatcher(parts).write({'steps': 1})
  parts[0].close.side_effect = OSError('full')
  with pytest.raises(OSError, match='full'):
    loggers.Dispatcher(parts).close()
  for part in parts:
    part.write.assert_called_once_with({'steps': 1})
    part.close.assert_called_once()
