"""Tests of benchmarks.learning.adapters."""

import types
from typing import Any

import pytest

from dmc_multimode.suite.imitation import batched_env
from tests.benchmarks import modules

adapters = modules.load('learning.adapters')
_PACKAGES = {'sb3': 'stable_baselines3', 'rsl_rl': 'rsl_rl'}


def test_returns_of_the_first_and_the_last_tenth() -> None:
  worlds: Any = types.SimpleNamespace(
    steps=100, ends=[4, 10, 11, 90, 91, 100], returns=[0.1, 0.3, 9, 9, 0.5, 0.7]
  )
  row = adapters.row('ours', worlds)
  assert (row['steps'], row['episodes']) == (100, 6)
  assert row['return_first'] == pytest.approx(0.2)
  assert row['return_last'] == pytest.approx(0.6)
  assert row['ratio'] == pytest.approx(3.0)


@pytest.mark.parametrize('name', adapters.LEARNERS)
def test_learns_in_recorded_worlds(name: str) -> None:
  pytest.importorskip(_PACKAGES[name], reason='The extra `bench`.')
  worlds = adapters.RecordedWorlds('walk_forward', 2, seed=0)
  assert batched_env.BatchedImitation in type(worlds).__mro__
  adapters.LEARNERS[name](worlds, 128, 0)
  assert worlds.steps == 128
  assert 0 < len(worlds.returns) == len(worlds.ends)
  assert 0 < min(worlds.returns) <= max(worlds.returns) < 0.5
