"""Tests of dmc_multimode.bin.train."""

import csv
import itertools
import json
import pathlib
import shutil
import signal
import time
from typing import Any, Callable

import pytest
import torch

from dmc_multimode import pretrained
from dmc_multimode.agents import checkpointing
from dmc_multimode.experiments import run_folder
from tests.bin import processes
from tests.bin import short_run
from tests.bin import untrained

_ITERATION, _STEPS = short_run.ITERATION, short_run.STEPS
_TINY = (*short_run.FLAGS, '--threads=1')
_ROW_EVERY = 5 * _ITERATION  # Between rows of the logs.
# A checkpoint after every iteration; stalls with the eighth rollout at hand.
_STALLING = """
import functools, time
from dmc_multimode.agents import runner
runner.TrainingConfig = functools.partial(
  runner.TrainingConfig, checkpoint_seconds=1e-9
)
loop = runner.TrainingLoop
collect = loop._collect
loop._collect = lambda self: (
  collect(self), self.iterations == 8 and time.sleep(300)
)
"""
_BAD_MODE = """\
name: wait
kind: steady
duration: -1
keyframes: [{phase: 0, position: [0, 0, 1]}, {phase: 1, position: [0, 0, 1]}]
"""

_STANDING = """\
name: stay
kind: steady
duration: 0.6
half_cycle_symmetric: true
keyframes:
  - {phase: 0, position: [0, 0, 0.5], contacts: [1, 1]}
  - {phase: 1, position: [0, 0, 0.5], contacts: [1, 1]}
"""

_Files = dict[str, bytes]


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


@pytest.mark.slow
def test_killed_run_goes_on_bit_for_bit(
  train: processes.Binary, run_dir: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  folder = tmp_path / 'killed'
  where = f'--run_dir={folder}'
  process = train.start(where, f'--steps={_STEPS}', *_TINY, before=_STALLING)
  # A row is written, and the next iterations are under way.
  _wait_for(lambda: (folder / 'metrics.csv').exists() and _rows(folder))
  _wait_for((folder / checkpointing.PREVIOUS).exists)
  processes.send(process, signal.SIGKILL)
  assert train.wait().code == -signal.SIGKILL

  done = train(where, '--resume')  # To its own length.
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
  train: processes.Binary, tmp_path: pathlib.Path
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
  assert run_folder.RunFolder(folder).load()[0].steps == _STEPS
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


@pytest.mark.slow
def test_interrupt_stops_with_a_checkpoint(
  train: processes.Binary, tmp_path: pathlib.Path
) -> None:
  folder = tmp_path / 'interrupted'
  process = train.start(f'--run_dir={folder}', *_TINY, '--steps=1000000')
  _wait_for(lambda: (folder / 'metrics.csv').exists() and _rows(folder))
  processes.send(process, signal.SIGINT)
  done = train.wait()
  assert done.code == 0, done.stderr
  assert 'Traceback' not in done.stderr
  assert f'the policy is in {folder / "policy"}' in done.stdout
  _, values, note = checkpointing.Checkpointer(folder).load()
  assert not note and values['steps'] >= _ROW_EVERY
  assert pretrained.load(folder).provenance['steps'] == values['steps']


# Bad input. Nothing is left behind, and a run that is there stays as it was.


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--mode_file={tmp}/bad.yaml'], 'bad.yaml:3:'),
    (['--steps=0'], 'steps'),
    (['--ppo_symmetry=augment', '--modes=walk_left'], 'walk_right'),
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
    (['--resume', '--num_worlds=16'], 'num_worlds=8, not 16.'),
    (['--resume', '--ppo_clip=0.1'], 'ppo_clip=0.2, not 0.1.'),
    (['--resume', '--threads=2'], '"threads": 2 into config.json of a copy'),
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


def test_more_threads_than_cores(
  train: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """Are warned of, and can be got rid of as the warning says."""
  folder = tmp_path / 'home' / 'run'
  home = f'import os; os.environ["HOME"] = {str(folder.parent)!r}'
  train.start(
    '--run_dir=~/run', *_TINY, '--threads=64', '--steps=32', before=home
  )
  done = train.wait()
  assert done.code == 0, done.stderr
  assert 'warning: 64 threads have' in done.stderr
  config = folder / run_folder.CONFIG_FILE
  config.write_text(config.read_text().replace('"threads": 64', '"threads": 1'))
  done = train(f'--run_dir={folder}', '--resume', '--steps=64')
  assert done.code == 0, done.stderr
  assert 'Resuming at 32' in done.stdout and 'warning' not in done.stderr


@pytest.mark.parametrize('name', [checkpointing.NAME, run_folder.CONFIG_FILE])
def test_damaged_run(
  train: processes.Binary, copy: pathlib.Path, name: str
) -> None:
  path = copy / name
  path.write_bytes(path.read_bytes()[:-100])
  before = _files(copy)
  done = train(f'--run_dir={copy}', '--steps=100000', '--resume')
  assert done.code == 2
  assert name in done.error
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
    (['--mode_file={tmp}/stay.yaml', '--modes=idle,stay'], 'same base motion'),
  ],
)
def test_bad_input_to_begin_with(
  train: processes.Binary,
  known: pathlib.Path,
  tmp_path: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  (tmp_path / 'stay.yaml').write_text(_STANDING)
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
