"""Tests of dmc_multimode.bin.train under torchrun."""

import os
import pathlib
import signal
import subprocess
import sys
import time
from typing import Any, Callable, Sequence

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

_ROOT = pathlib.Path(__file__).parents[2]
_TIMEOUT = 300  # Seconds.
# Runs the binary; every rank notes its network at the end. With a folder named
# STALL_IN, ranks wait after the eighth iteration until they are ended, once.
_RANK = """
import functools, os, pathlib, sys, time
from dmc_multimode.agents import checkpointing
from dmc_multimode.bin import train
stall = pathlib.Path(os.environ.get('STALL_IN', '/nowhere'))
rank = os.environ.get('RANK', '0')
loop = train.runner.TrainingLoop
if stall.is_dir():
  train.runner.TrainingConfig = functools.partial(
    train.runner.TrainingConfig, checkpoint_seconds=1e-9
  )
  collect = loop._collect
  def _collect(self):
    collect(self)
    mark = stall / rank
    if self.iterations == 8 and not mark.exists():
      mark.with_suffix('.new').write_text(str(os.getpid()))
      mark.with_suffix('.new').rename(mark)
      while rank == '0':
        time.sleep(0.01)
  loop._collect = _collect
run = loop.run
def _run(self, *args):
  run(self, *args)
  weights = self._learner.network.state_dict()
  checkpointing.save_tensors(
    pathlib.Path(os.environ['NOTES']) / f'network{rank}', weights, {}
  )
loop.run = _run
train.cli()
"""


class Launch:
  """A training, and what its ranks have noted."""

  def __init__(self, folder: pathlib.Path):
    """Notes go into `folder`, the run into `folder/run`."""
    folder.mkdir()
    self.folder, self.run = folder, folder / 'run'
    self._script = folder / 'rank.py'
    self._script.write_text(_RANK)

  def start(
    self, *flags: str, launcher: Sequence[str] = (), **environment: str
  ) -> subprocess.Popen[str]:
    """Starts it, under a launcher or alone."""
    return subprocess.Popen(
      [
        sys.executable,
        *launcher,
        str(self._script),
        f'--run_dir={self.run}',
        *short_run.FLAGS,
        *flags,
      ],
      stdout=subprocess.PIPE,
      stderr=subprocess.PIPE,
      text=True,
      cwd=_ROOT,
      env={
        **os.environ,
        'PYTHONPATH': str(_ROOT),
        'NOTES': str(self.folder),
        # Restarts hang without in torch 2.13: see docs/SCALING.md.
        'TORCH_DISABLE_SHARE_RDZV_TCP_STORE': '1',
        **environment,
      },
    )

  def network(self, rank: int) -> dict[str, torch.Tensor]:
    """Returns what a rank has learned."""
    return checkpointing.load_tensors(self.folder / f'network{rank}')[0]


def _finish(process: subprocess.Popen[str]) -> tuple[str, str]:
  """Returns stdout and stderr."""
  try:
    stdout, stderr = process.communicate(timeout=_TIMEOUT)
  finally:
    process.kill()
  assert process.returncode == 0, stderr
  return stdout, stderr


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
def two(tmp_path_factory: pytest.TempPathFactory) -> Launch:
  """A run of two ranks that nothing has interrupted."""
  launch = Launch(tmp_path_factory.mktemp('two') / 'launch')
  stdout, stderr = _finish(
    launch.start(
      '--threads=2',
      f'--steps={short_run.STEPS}',
      launcher=processes.torchrun(2),
    )
  )
  # Rank 0 alone has a say.
  (line,) = stdout.splitlines()
  assert (
    line == f'{short_run.STEPS} steps; the policy is in {launch.run / "policy"}'
  )
  assert stderr.count('0.00/384') == 1
  assert 'error' not in stderr and 'Traceback' not in stderr
  return launch


@pytest.mark.slow
def test_killed_rank_begins_again_and_ends_the_same(
  two: Launch, tmp_path: pathlib.Path
) -> None:
  launch = Launch(tmp_path / 'killed')
  marks = tmp_path / 'marks'
  marks.mkdir()
  process = launch.start(
    '--threads=2',
    f'--steps={short_run.STEPS}',
    launcher=processes.torchrun(2, '--max-restarts=3'),
    STALL_IN=str(marks),
  )
  try:
    _wait_for(lambda: (marks / '0').exists() and (marks / '1').exists())
    os.kill(int((marks / '1').read_text()), signal.SIGKILL)
    stdout, _ = _finish(process)
  finally:
    process.kill()
  assert f'Resuming at {7 * short_run.ITERATION} steps.' in stdout
  for one in (launch, two):
    for rank in range(2):
      _assert_equal(one.network(rank), two.network(0))
  (found, values), (expected, others) = (
    checkpointing.load_tensors(one.run / checkpointing.NAME)
    for one in (launch, two)
  )
  _assert_equal(found, expected)
  assert values == others
  assert (values['ranks'], values['steps']) == (2, short_run.STEPS)
  worlds = [found[f'{rank}environment/physics'] for rank in ('', 'rank1/')]
  assert len(worlds[0]) == len(worlds[1]) == 4
  assert not torch.equal(*worlds)
  assert pretrained.load(two.run).provenance['steps'] == short_run.STEPS


@pytest.mark.slow
def test_two_ranks_begin_with_one_policy(tmp_path: pathlib.Path) -> None:
  """Rank 0 alone reads it; steps are too small to be seen."""
  before = untrained.save_with_encoder(
    tmp_path / 'policy', ['idle', 'walk_forward'], {}
  )
  launch = Launch(tmp_path / 'grown')
  rates = [f'--ppo_{kind}learning_rate=1e-12' for kind in ('', 'min_', 'max_')]
  _finish(
    launch.start(
      f'--init_from={tmp_path / "policy"}',
      '--noone_hot',
      '--ppo_hidden_sizes=16',
      '--modes=idle,walk_forward,leap_forward',
      '--threads=2',
      f'--steps={2 * short_run.ITERATION}',
      *rates,
      launcher=processes.torchrun(2),
    )
  )
  _assert_equal(launch.network(0), launch.network(1))
  expected = before.network.state_dict()
  for key, value in launch.network(1).items():
    if key.startswith(('policy.', 'value.')):
      torch.testing.assert_close(value, expected[key], atol=1e-9, rtol=0)
  after = pretrained.load(launch.run)
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
