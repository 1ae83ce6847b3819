"""Tests of dmc_multimode.bin.train in several processes."""

import pathlib
import signal
import time
from typing import Any, Callable

import pytest
import torch

from dmc_multimode import pretrained
from dmc_multimode.agents import checkpointing
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import launch as launch_lib
from dmc_multimode.experiments import setup
from tests.bin import processes
from tests.bin import short_run
from tests.bin import untrained

_TIMEOUT = 300  # Seconds.
_FLAGS = (*short_run.FLAGS, '--threads=2')
_STEPS = f'--steps={short_run.STEPS}'


def _note(folder: pathlib.Path) -> str:
  """Code by which every rank writes its network at the end."""
  return f"""
import os, pathlib
from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import runner
loop, rank = runner.TrainingLoop, os.environ['RANK']
run = loop.run
def _run(self, *args):
  run(self, *args)
  path = pathlib.Path({str(folder)!r}) / f'network{{rank}}'
  checkpointing.save_tensors(path, self._learner.network.state_dict(), {{}})
loop.run = _run
"""


def _stall(folder: pathlib.Path) -> str:
  """Code by which ranks wait once, after the eighth iteration, to be killed."""
  return f"""
import functools, time
os.environ['TORCHELASTIC_RUN_ID'] = 'launch'
runner.TrainingConfig = functools.partial(
  runner.TrainingConfig, checkpoint_seconds=1e-9
)
collect = loop._collect
def _collect(self):
  collect(self)
  mark = pathlib.Path({str(folder)!r}) / rank
  if self.iterations == 8 and not mark.exists():
    mark.with_suffix('.new').write_text(str(os.getpid()))
    mark.with_suffix('.new').rename(mark)
    while rank == '0':
      time.sleep(0.01)
loop._collect = _collect
"""


def _network(folder: pathlib.Path, rank: int) -> dict[str, torch.Tensor]:
  """Returns what a rank has learned."""
  return checkpointing.load_tensors(folder / f'network{rank}')[0]


def _assert_equal(one: dict[str, Any], other: dict[str, Any]) -> None:
  assert one.keys() == other.keys()
  for key, value in one.items():
    assert torch.equal(value, other[key]), key


def _wait_for(condition: Callable[[], Any]) -> None:
  deadline = time.monotonic() + _TIMEOUT
  while not condition():
    assert time.monotonic() < deadline
    time.sleep(0.01)


@pytest.fixture(scope='module')
def two(
  train: processes.Binary, tmp_path_factory: pytest.TempPathFactory
) -> pathlib.Path:
  """The folder of a run of two ranks that nothing has interrupted."""
  folder = tmp_path_factory.mktemp('two')
  flags = f'--run_dir={folder / "run"}', *_FLAGS, _STEPS
  done = train(*flags, before=_note(folder), ranks=2)
  assert done.code == 0, done.stderr
  # Rank 0 alone has a say.
  (line,) = done.stdout.splitlines()
  policy = folder / 'run' / 'policy'
  assert line == f'{short_run.STEPS} steps; the policy is in {policy}'
  assert done.stderr.count('/384 [') == 1
  assert 'error' not in done.stderr and 'Traceback' not in done.stderr
  return folder


@pytest.mark.slow
def test_killed_rank_begins_again_and_ends_the_same(
  train: processes.Binary, two: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  """As torchrun begins again: with no other flags, by the launch's id."""
  flags = f'--run_dir={tmp_path / "run"}', *_FLAGS, _STEPS
  before = _note(tmp_path) + _stall(tmp_path)
  train.start(*flags, before=before, ranks=2)
  marks = [tmp_path / rank for rank in '10']
  _wait_for(lambda: all(mark.exists() for mark in marks))
  for mark in marks:
    processes.send(int(mark.read_text()), signal.SIGKILL)
  assert train.wait().code == -signal.SIGKILL
  done = train(*flags, before=before, ranks=2)
  assert done.code == 0, done.stderr
  assert f'Resuming at {7 * short_run.ITERATION} steps.' in done.stdout
  for one in (tmp_path, two):
    for rank in range(2):
      _assert_equal(_network(one, rank), _network(two, 0))
  (found, values), (expected, others) = (
    checkpointing.load_tensors(one / 'run' / checkpointing.NAME)
    for one in (tmp_path, two)
  )
  _assert_equal(found, expected)
  assert values == others
  assert (values['ranks'], values['steps']) == (2, short_run.STEPS)
  worlds = [found[f'{rank}environment/physics'] for rank in ('', 'rank1/')]
  assert len(worlds[0]) == len(worlds[1]) == 4
  assert not torch.equal(*worlds)
  steps = pretrained.load(two / 'run').provenance['steps']
  assert steps == short_run.STEPS


def test_two_ranks_begin_with_one_policy(
  train: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """Rank 0 alone reads it; steps are too small to be seen."""
  before = untrained.save_with_encoder(
    tmp_path / 'policy', ['idle', 'walk_forward'], {}
  )
  done = train(
    f'--run_dir={tmp_path / "run"}',
    *_FLAGS,
    f'--init_from={tmp_path / "policy"}',
    '--noone_hot',
    '--modes=idle,walk_forward,leap_forward',
    f'--steps={2 * short_run.ITERATION}',
    *(f'--ppo_{kind}learning_rate=1e-12' for kind in ('', 'min_', 'max_')),
    before=_note(tmp_path),
    ranks=2,
  )
  assert done.code == 0, done.stderr
  _assert_equal(_network(tmp_path, 0), _network(tmp_path, 1))
  expected = before.network.state_dict()
  for key, value in _network(tmp_path, 1).items():
    if key.startswith(('policy.', 'value.')):
      torch.testing.assert_close(value, expected[key], atol=1e-9, rtol=0)
  after = pretrained.load(tmp_path / 'run')
  assert after.mode_set.names == ('idle', 'walk_forward', 'leap_forward')


# What is said to be wrong, and what counts as a restart.


def test_worlds_that_cannot_be_shared() -> None:
  config = run_config.RunConfig(num_worlds=9)
  setup.check_ranks(config, 3)
  with pytest.raises(ValueError, match='num_worlds 9 .* 2 of them'):
    setup.check_ranks(config, 2)


@pytest.mark.parametrize(
  ('began', 'now', 'restart'),
  [
    (None, 'job', False),
    ('job', 'job', True),
    ('other', 'job', False),
    ('', '', False),
    ('none', 'none', True),
  ],
)
def test_restarts(
  monkeypatch: pytest.MonkeyPatch,
  tmp_path: pathlib.Path,
  began: str | None,
  now: str,
  restart: bool,
) -> None:
  """A run of the same launch goes on; another launch must be asked to."""
  if began is not None:
    monkeypatch.setenv('TORCHELASTIC_RUN_ID', began)
    launch_lib.note(tmp_path / 'launch')
  monkeypatch.setenv('TORCHELASTIC_RUN_ID', now)
  assert launch_lib.is_restart(tmp_path / 'launch') == restart
