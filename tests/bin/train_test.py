"""Tests of dmc_multimode.bin.train."""

import csv
import itertools
import json
import pathlib
import shutil
import signal
import subprocess
import sys
import time
from typing import Any, Callable, Iterator

import pytest
from tensorboard.backend.event_processing import event_accumulator
import torch

from dmc_multimode import pretrained
from dmc_multimode.agents import checkpointing
from dmc_multimode.experiments import run_folder
from tests.bin import processes
from tests.bin import short_run
from tests.bin import untrained

_ROOT = pathlib.Path(__file__).parents[2]
_ITERATION, _STEPS = short_run.ITERATION, short_run.STEPS
_TINY = (*short_run.FLAGS, '--threads=1')
_ROW_EVERY = 5 * _ITERATION  # Between rows of the logs.
# A checkpoint after every iteration; stalls with the eighth rollout at hand.
_STALLING = """
import functools, time
binary.runner.TrainingConfig = functools.partial(
  binary.runner.TrainingConfig, checkpoint_seconds=1e-9
)
loop = binary.runner.TrainingLoop
collect = loop._collect
loop._collect = lambda self: (
  collect(self), self.iterations == 8 and time.sleep(300)
)
"""
# What is imported late, and what the first model costs.
_WARM_UP = """
import torch
from torch.utils import tensorboard
torch.optim.Adam([torch.zeros(1)])
from dmc_multimode.modes import library
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import mujoco_worlds
mujoco_worlds.compile_model(multimode_biped.make_task(library.mode_set('idle')))
"""

_BAD_MODE = """\
name: wait
kind: steady
duration: -1
keyframes: [{phase: 0, position: [0, 0, 1]}, {phase: 1, position: [0, 0, 1]}]
"""

_STANDING = """\
name: {}
kind: steady
duration: 0.6
half_cycle_symmetric: true
keyframes:
  - {{phase: 0, position: [0, 0, {height}], contacts: [1, 1]}}
  - {{phase: 1, position: [0, 0, {height}], contacts: [1, 1]}}
"""

_Files = dict[str, bytes]


@pytest.fixture(scope='module')
def train(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  binary = processes.Binary(
    'train', tmp_path_factory.mktemp('output'), _WARM_UP
  )
  yield binary
  binary.close()


@pytest.fixture(scope='module')
def run_dir(
  train: processes.Binary, tmp_path_factory: pytest.TempPathFactory
) -> pathlib.Path:
  """A run that nothing has interrupted; not to be written to."""
  folder = tmp_path_factory.mktemp('runs') / 'whole'
  done = train(f'--run_dir={folder}', *_TINY, f'--steps={_STEPS}')
  assert done.code == 0, done.stderr
  (line,) = done.stdout.splitlines()
  assert line == f'{_STEPS:,} steps; the policy is in {folder / "policy"}'
  for shown in (f'/{_STEPS} ', 'steps/s=', 'MRA=', 'survival=', 'lr='):
    assert shown in done.stderr  # The progress line.
  assert 'error' not in done.stderr and 'Traceback' not in done.stderr
  return folder


def _files(folder: pathlib.Path) -> _Files:
  return {
    str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b''
    for path in folder.rglob('*')
  }


def _rows(folder: pathlib.Path) -> list[dict[str, str]]:
  with open(folder / 'metrics.csv', newline='', encoding='utf-8') as file:
    return list(csv.DictReader(file))


def _wait_for(condition: Callable[[], Any]) -> None:
  deadline = time.monotonic() + 300
  while not condition():
    assert time.monotonic() < deadline
    time.sleep(0.01)


def test_folder_of_a_run(run_dir: pathlib.Path) -> None:
  found = {name.partition('/')[0] for name in _files(run_dir)}
  expected = {
    run_folder.CONFIG_FILE,
    checkpointing.NAME,
    'policy',
    'metrics.csv',
    'tensorboard',
  }
  assert found == expected
  config, mode_set = run_folder.RunFolder(run_dir).load()
  assert (config.num_worlds, config.threads, config.one_hot) == (8, 1, True)
  assert config.ppo.hidden_sizes == (16,)
  assert mode_set.names == ('idle', 'walk_forward')
  assert mode_set.latents.tolist() == [[1, 0], [0, 1]]
  policy = pretrained.load(run_dir)
  assert policy.provenance['steps'] == _STEPS
  assert policy.mode_set.names == ('idle', 'walk_forward')
  json.dumps(dict(policy.provenance))


def test_metrics_of_every_mode(run_dir: pathlib.Path) -> None:
  rows = _rows(run_dir)
  steps = [_ROW_EVERY, 2 * _ROW_EVERY]
  assert [int(row['steps']) for row in rows] == steps
  (folder,) = (run_dir / 'tensorboard').glob('*')
  events = event_accumulator.EventAccumulator(str(folder))
  events.Reload()
  names = ['idle', 'walk_forward']
  names += ['idle->walk_forward', 'walk_forward->idle']
  for name in names:
    for kind in ('return', 'survival', 'p'):
      key = f'{kind}/{name}'
      scalars = events.Scalars(key)
      assert [event.step for event in scalars] == steps
      for event, row in zip(scalars, rows, strict=True):
        assert float(row[key]) == pytest.approx(event.value, rel=1e-4)
        assert 0 <= event.value <= 1
  for row in rows:
    both = float(row['p/idle']) + float(row['p/walk_forward'])
    assert both == pytest.approx(1.0, rel=1e-4)


@pytest.mark.slow
def test_killed_run_goes_on_bit_for_bit(
  train: processes.Binary, run_dir: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  folder = tmp_path / 'killed'
  flags = f'--run_dir={folder}', f'--steps={_STEPS}'
  process = train.start(*flags, *_TINY, before=_STALLING)
  # A row is written, and the next iterations are under way.
  _wait_for(lambda: (folder / 'metrics.csv').exists() and _rows(folder))
  _wait_for((folder / checkpointing.PREVIOUS).exists)
  processes.send(process, signal.SIGKILL)
  assert train.wait().code == -signal.SIGKILL

  done = train(*flags, '--resume')
  assert done.code == 0, done.stderr
  assert 'Resuming' in done.stdout
  for name in ('policy/policy.safetensors', checkpointing.NAME):
    expected, _ = checkpointing.load_tensors(run_dir / name)
    found, _ = checkpointing.load_tensors(folder / name)
    assert expected.keys() == found.keys()
    for key, value in expected.items():
      assert torch.equal(value, found[key]), key
  speed = {'steps_per_second': ''}
  rows = [{**row, **speed} for row in _rows(folder)]
  assert rows == [{**row, **speed} for row in _rows(run_dir)]


def test_policies_are_kept_along_the_way(
  train: processes.Binary, run_dir: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  """Every 100 steps of which 32 are one iteration, in two parts."""
  folder = tmp_path / 'kept'
  flags = f'--run_dir={folder}', '--keep_every=100'
  assert train(*flags, *_TINY, f'--steps={5 * _ITERATION}').code == 0
  found = lambda: sorted(path.name for path in (folder / 'policies').iterdir())
  assert found() == ['128']
  done = train(*flags, '--resume', f'--steps={_STEPS}')
  assert done.code == 0, done.stderr
  assert found() == ['128', '224', '320']
  tensors = []
  for name in ('policies/128', 'policies/224', 'policies/320', ''):
    policy = pretrained.load(folder / name)
    assert policy.provenance['steps'] == int(name[-3:] or _STEPS)
    assert policy.mode_set.names == ('idle', 'walk_forward')
    directory = folder / (name or 'policy')
    values, _ = checkpointing.load_tensors(directory / 'policy.safetensors')
    tensors.append(torch.cat([value.ravel() for value in values.values()]))
  for one, other in itertools.combinations(tensors, 2):
    assert not torch.equal(one, other)
  # A run is what it would be without.
  expected, _ = checkpointing.load_tensors(
    run_dir / 'policy' / 'policy.safetensors'
  )
  found_last, _ = checkpointing.load_tensors(
    folder / 'policy' / 'policy.safetensors'
  )
  assert all(torch.equal(expected[key], found_last[key]) for key in expected)


@pytest.mark.slow
def test_interrupt_stops_with_a_checkpoint(tmp_path: pathlib.Path) -> None:
  """As `python -m`, in a terminal."""
  folder = tmp_path / 'interrupted'
  process = subprocess.Popen(
    [
      sys.executable,
      '-m',
      'dmc_multimode.bin.train',
      f'--run_dir={folder}',
      *_TINY,
      '--steps=1000000',
    ],
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
    cwd=_ROOT,
  )
  try:
    _wait_for(lambda: (folder / 'metrics.csv').exists() and _rows(folder))
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=300)
  finally:
    process.kill()
  assert process.returncode == 0, stderr
  assert 'Traceback' not in stderr
  assert f'the policy is in {folder / "policy"}' in stdout
  _, values, note = checkpointing.Checkpointer(folder).load()
  assert not note and values['steps'] >= _ROW_EVERY
  assert pretrained.load(folder).provenance['steps'] == values['steps']


# Bad input. Nothing is left behind, and a run that is there stays as it was.


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--modes=idle,fly'], 'fly'),
    (['--mode_file={tmp}/bad.yaml'], 'bad.yaml:3:'),
    (['--encoder={tmp}/absent', '--noone_hot'], 'absent'),
    (['--steps=0'], 'steps'),
    (['--minutes=nan'], 'minutes'),
    (['--keep_every=-1'], 'keep_every'),
    (['--num_worlds=0'], 'num_worlds'),
    (['--ppo_symmetry=augment', '--modes=walk_left'], 'walk_right'),
    (['--task_physics_timestep=0.007'], 'physics_timestep'),
    (['--run_dir={tmp}/file/below'], 'file'),
    (['--resume'], 'without --resume'),
    pytest.param(
      ['--device=cuda'],
      '--device=cuda',
      marks=pytest.mark.skipif(torch.cuda.is_available(), reason='It is there'),
    ),
    (['--run_dir='], '--run_dir must name'),
  ],
  ids=lambda value: value if isinstance(value, str) else ' '.join(value),
)
def test_bad_input(
  train: processes.Binary,
  tmp_path: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  (tmp_path / 'file').touch()
  (tmp_path / 'bad.yaml').write_text(_BAD_MODE)
  before = _files(tmp_path)
  done = train(
    f'--run_dir={tmp_path / "run"}',
    *_TINY,
    '--steps=32',
    *(flag.format(tmp=tmp_path) for flag in flags),
  )
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not done.stdout
  assert _files(tmp_path) == before


@pytest.fixture
def copy(run_dir: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
  """A run that may be damaged."""
  folder = tmp_path / 'copy'
  shutil.copytree(run_dir, folder)
  return folder


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    ([], 'already holds a run'),
    (['--resume', '--num_worlds=16'], 'num_worlds'),
    (['--resume', '--noone_hot'], 'one_hot'),
    (['--resume', '--ppo_clip=0.1'], 'ppo'),
  ],
  ids=lambda value: value if isinstance(value, str) else ' '.join(value),
)
def test_another_run_than_that_of_the_folder(
  train: processes.Binary,
  copy: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  before = _files(copy)
  done = train(f'--run_dir={copy}', '--steps=100000', *flags)
  assert done.code == 2
  assert message in done.error
  assert _files(copy) == before


def _truncated(path: pathlib.Path) -> None:
  path.write_bytes(path.read_bytes()[:-100])


def _without_the_actor(path: pathlib.Path) -> None:
  tensors, values = checkpointing.load_tensors(path)
  del tensors['actor/generator']
  checkpointing.save_tensors(path, tensors, values)


def _of_another_network(path: pathlib.Path) -> None:
  tensors, values = checkpointing.load_tensors(path)
  tensors['learner/network/policy.0.weight'] = torch.zeros(3, 3)
  checkpointing.save_tensors(path, tensors, values)


@pytest.mark.parametrize(
  ('name', 'damage', 'message'),
  [
    (checkpointing.NAME, _truncated, 'truncated'),
    (checkpointing.NAME, _without_the_actor, 'generator'),
    (checkpointing.NAME, _of_another_network, 'another network'),
    (run_folder.CONFIG_FILE, _truncated, 'config.json is damaged'),
  ],
)
def test_damaged_run(
  train: processes.Binary,
  copy: pathlib.Path,
  name: str,
  damage: Callable[[pathlib.Path], None],
  message: str,
) -> None:
  damage(copy / name)
  before = _files(copy)
  done = train(f'--run_dir={copy}', '--steps=100000', '--resume')
  assert done.code == 2
  assert message in done.error
  assert _files(copy) == before  # Above all, the policy.


def test_checkpoint_without_its_run_is_not_taken_over(
  train: processes.Binary, copy: pathlib.Path
) -> None:
  (copy / run_folder.CONFIG_FILE).unlink()
  before = _files(copy)
  done = train(f'--run_dir={copy}', *_TINY, '--steps=100000')
  assert done.code == 2
  assert 'already holds a run' in done.error
  assert _files(copy) == before


# Trainings that begin with a policy.


@pytest.fixture(scope='module')
def known(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """A policy of two modes."""
  folder = tmp_path_factory.mktemp('known')
  untrained.save_with_encoder(folder, ['idle', 'walk_forward'], {'steps': 7})
  return folder


_FINE = (
  '--num_worlds=8',
  '--threads=1',
  '--ppo_rollout_length=4',
  '--modes=idle,leap_forward,walk_forward',
)


@pytest.fixture(scope='module')
def grown(
  train: processes.Binary,
  known: pathlib.Path,
  tmp_path_factory: pytest.TempPathFactory,
) -> pathlib.Path:
  """A run that has begun with that policy; not to be written to."""
  folder = tmp_path_factory.mktemp('runs') / 'grown'
  flags = f'--run_dir={folder}', f'--init_from={known}', f'--steps={_STEPS}'
  done = train(*flags, *_FINE)
  assert done.code == 0, done.stderr
  return folder


def test_policy_gains_a_mode(known: pathlib.Path, grown: pathlib.Path) -> None:
  before, after = pretrained.load(known), pretrained.load(grown)
  assert after.mode_set.names == ('idle', 'leap_forward', 'walk_forward')
  old = after.mode_set.subset(before.mode_set.names)
  assert old.latents.tolist() == before.mode_set.latents.tolist()
  assert after.hidden_sizes == before.hidden_sizes
  run = after.provenance['run']
  assert run['init_from'] == str(known)
  assert run['sampling']['focus'] == 'leap_forward'
  assert after.provenance['steps'] == _STEPS
  assert after.provenance['initial']['steps'] == 7
  assert float(after.network.normaliser.count) == _STEPS
  assert all(float(row['loss/kickstarting']) > 0 for row in _rows(grown))


def test_weights_are_taken_over(
  train: processes.Binary, known: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  """In steps that are too small to be seen."""
  rates = [f'--ppo_{kind}learning_rate=1e-12' for kind in ('', 'min_', 'max_')]
  flags = f'--run_dir={tmp_path}/run', f'--init_from={known}'
  done = train(*flags, *_FINE, *rates, f'--steps={_ITERATION}')
  assert done.code == 0, done.stderr
  before, after = (
    pretrained.load(folder).network for folder in (known, tmp_path / 'run')
  )
  for part in ('policy', 'value'):
    for one, other in zip(
      getattr(before, part).parameters(),
      getattr(after, part).parameters(),
      strict=True,
    ):
      torch.testing.assert_close(one, other, atol=1e-9, rtol=0)
  assert float(after.normaliser.count) == _ITERATION


def test_run_that_began_with_a_policy_goes_on_bit_for_bit(
  train: processes.Binary, grown: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  """Killed before there was a checkpoint; the policy is gone meanwhile."""
  folder, kept = tmp_path / 'parts', run_folder.RunFolder(grown)
  shutil.copytree(kept.initial, folder / run_folder.INITIAL)
  shutil.copytree(kept.encoder, folder / run_folder.ENCODER)
  shutil.copy(kept.config, folder)
  done = train(f'--run_dir={folder}', '--resume', f'--steps={_STEPS}')
  assert done.code == 0, done.stderr
  expected, _ = checkpointing.load_tensors(grown / checkpointing.NAME)
  found, _ = checkpointing.load_tensors(folder / checkpointing.NAME)
  assert expected.keys() == found.keys()
  for key, value in expected.items():
    assert torch.equal(value, found[key]), key


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--init_from=pi7'], 'pi7'),
    (['--init_from={tmp}/one_hot'], 'one-hot commands'),
    (['--ppo_hidden_sizes=8'], '--ppo_hidden_sizes'),
    (['--modes=idle,walk_left'], 'walk_right'),
    (['--mode_file={tmp}/idle.yaml'], 'by the name of'),
    (['--mode_file={tmp}/stay.yaml', '--modes=idle,stay'], 'same base motion'),
  ],
  ids=lambda value: value if isinstance(value, str) else ' '.join(value),
)
def test_bad_input_to_begin_with(
  train: processes.Binary,
  known: pathlib.Path,
  tmp_path: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  untrained.save(
    tmp_path / 'one_hot', ['idle'], pretrained.load(known).config, {}
  )
  for name, height in (('idle', 0.4), ('stay', 0.5)):
    (tmp_path / f'{name}.yaml').write_text(
      _STANDING.format(name, height=height)
    )
  before = _files(tmp_path)
  done = train(
    f'--run_dir={tmp_path / "run"}',
    f'--init_from={known}',
    *_FINE,
    *(flag.format(tmp=tmp_path) for flag in flags),
  )
  assert done.code == 2, done.stderr
  assert message in done.error
  assert _files(tmp_path) == before


def test_run_begins_with_no_other_policy_when_it_goes_on(
  train: processes.Binary, grown: pathlib.Path, known: pathlib.Path
) -> None:
  before = _files(grown)
  done = train(f'--run_dir={grown}', '--resume', '--init_from=pi2')
  assert done.code == 2
  assert 'init_from' in done.error
  assert _files(grown) == before
  # The same again is no contradiction; there is nothing left to do.
  done = train(
    f'--run_dir={grown}',
    '--resume',
    f'--init_from={known}',
    *_FINE,
    '--steps=1',
  )
  assert done.code == 0, done.stderr
