"""The same seed, the same result: in another process, by any thread count.

Elsewhere: both engines agree (suite/imitation/batched_env_test.py); `evaluate`
writes the same bytes on one rank and on two (bin/evaluate_test.py); a killed
training goes on bit for bit, on one thread and in several processes
(bin/train_test.py, bin/train_distributed_test.py).
"""

import hashlib
import subprocess
import sys

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.modes import library
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env

_STEPS = 40


def rollout(threads: int) -> str:
  """Returns a hash of everything that random actions lead to."""
  worlds = batched_env.BatchedImitation(
    multimode_biped.make_task(library.mode_set('pi2')), 12, 3, threads
  )
  found = hashlib.sha256(worlds.reset().tobytes())
  random, ended = np.random.RandomState(0), 0
  for _ in range(_STEPS):
    action = worlds.standing_action() + random.uniform(-0.4, 0.4, (12, 10))
    step = worlds.step(action)
    ended += len(step.results.worlds)
    for value in (step.observation, step.reward, step.discount, step.last):
      found.update(value.tobytes())
  for value in worlds.state().values():
    found.update(np.ascontiguousarray(value).tobytes())
  assert ended  # New episodes are drawn, too.
  return found.hexdigest()


@pytest.fixture(scope='module')
def expected() -> str:
  return rollout(1)


@pytest.mark.parametrize('threads', [2, 4])
def test_physics_is_the_same_by_any_number_of_threads(
  expected: str, threads: int
) -> None:
  assert rollout(threads) == expected


def test_physics_is_the_same_in_another_process(expected: str) -> None:
  code = f'import runpy; print(runpy.run_path({__file__!r})["rollout"](2))'
  done = subprocess.run(
    [sys.executable, '-c', code], capture_output=True, text=True, check=True
  )
  assert done.stdout.split()[-1] == expected


@pytest.mark.parametrize('name', pretrained.names(installed=True))
def test_seeds_are_in_the_metrics(name: str) -> None:
  """Of the evaluation, and of the training with all that it draws."""
  metrics = pretrained.load(name).metrics
  assert isinstance(metrics['seed'], int)
  run = metrics['provenance']['run']
  assert isinstance(run['seed'], int)
  assert {'threads', 'num_worlds', 'ppo', 'sampling', 'task'} <= run.keys()
