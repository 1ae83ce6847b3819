"""Tests of dmc_multimode.evaluation.episodes."""

from unittest import mock

import numpy as np

from dmc_multimode.evaluation import episodes as evaluation_episodes
from tests.agents import toy


def test_summary() -> None:
  found = evaluation_episodes.summary(np.array([1.0, 3.0]))
  assert found == {'mean': 2.0, 'std': 1.0}


class Scripted(toy.TargetEnvironment):
  """World i ends after i + 1 steps; the last one by its time limit."""

  def __init__(self) -> None:
    super().__init__(3, lambda seen: seen, lambda rng, n: np.zeros((n, 1)))
    self.steps = 0
    self.actions: list[float] = []

  def reset(self) -> np.ndarray:
    self.steps = 0
    return np.zeros((3, 1), np.float32)

  def step(self, actions: np.ndarray) -> toy.TimeStep:
    ended = np.array([self.steps])
    self.steps += 1
    self.actions.append(actions[0, 0])
    causes = np.array([0 if self.steps == 3 else 2])
    results = toy.Results(
      ended, ended, ended, 0.1 * self.steps + 0 * ended, ended + 1, causes
    )
    seen = np.full((3, 1), self.steps, np.float32)
    last = np.arange(3) == ended
    return toy.TimeStep(
      np.zeros(3), np.ones(3), last, seen, seen[ended], results
    )

  def measure(self) -> dict[str, np.ndarray]:
    return {'x': np.array([10.0, 20.0, 30.0]) + self.steps}


def test_run_episodes() -> None:
  environment, progress = Scripted(), mock.Mock()
  found = evaluation_episodes.run_episodes(
    environment, lambda seen: seen + 1, progress
  )
  assert environment.steps == progress.call_count == 3
  assert environment.actions == [1.0, 2.0, 3.0]  # Of what was seen before.
  np.testing.assert_allclose(found.returns, [0.1, 0.2, 0.3])
  np.testing.assert_array_equal(found.lengths, [1, 2, 3])
  np.testing.assert_array_equal(found.survived, [False, False, True])
  expected = [[11, 21, 31], [12, 22, 32], [13, 23, 33]]
  np.testing.assert_array_equal(found.traces['x'], expected)
  rows = found.rows(np.array([2, 0]))
  np.testing.assert_array_equal(rows.lengths, [3, 1])
  np.testing.assert_array_equal(rows.traces['x'][0], [31, 11])
