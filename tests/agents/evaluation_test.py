"""Tests of dmc_multimode.agents.evaluation."""

from typing import Any
from unittest import mock

import numpy as np
import pytest

from dmc_multimode.agents import evaluation
from tests.agents import toy

_TIMESTEP = 0.1  # Seconds: ten steps a second.


def _episodes(lengths: list[int], **traces: Any) -> evaluation.Episodes:
  """Traces [T, B, ...]; those not given say that nothing happened."""
  steps, worlds = np.asarray(next(iter(traces.values()))).shape[:2]
  still = {
    'position': np.zeros((steps, worlds, 3)),
    'reference': np.zeros((steps, worlds, 3)),
    'support': np.zeros((steps, worlds)),
    'contact': np.ones((steps, worlds, 2)),
  }
  count = np.array(lengths)
  return evaluation.Episodes(
    np.zeros(worlds), count == steps, count, {**still, **traces}
  )


def _metrics(duration: float = 0.5, **traces: Any) -> dict[str, float]:
  """Of one world that survives."""
  batch = {name: np.asarray(trace)[:, None] for name, trace in traces.items()}
  steps = len(next(iter(batch.values())))
  return evaluation.body_metrics(
    _episodes([steps], **batch), np.array([duration]), _TIMESTEP
  )


def test_velocity_without_the_first_second() -> None:
  time = _TIMESTEP * np.arange(31)
  x = np.where(time < 1.0, 0.0, 0.6 * (time - 1.0))
  position = np.stack([x, -0.5 * x, 0.5 + 0 * x], axis=1)
  reference = np.stack([0.7 * time, 0 * time, 0 * time + 0.5], axis=1)
  found = _metrics(position=position, reference=reference)
  assert found['velocity'] == pytest.approx(0.6)
  assert found['lateral_velocity'] == pytest.approx(-0.3)
  assert found['reference_velocity'] == pytest.approx(0.7)
  assert found['drift'] == pytest.approx(np.hypot(1.2, 0.6))
  assert found['final_height'] == 0.5
  errors = np.linalg.norm(position - reference, axis=1)
  assert found['position_error'] == pytest.approx(errors.mean())


def test_heights_by_cycle() -> None:
  # Two cycles of five steps, and two steps of a third that does not count.
  z = np.array([1.5, 1.4, 1.7, 1.6, 1.5, 1.5, 1.3, 1.8, 1.5, 1.5, 9.0, 1.5])
  position = np.stack([0 * z, 0 * z, z], axis=1)
  found = _metrics(position=position, support=np.ones(12))
  assert found['apex'] == pytest.approx((0.7 + 0.8) / 2)
  assert found['rise'] == pytest.approx((0.3 + 0.5) / 2)
  assert found['height'] == pytest.approx(z.mean() - 1.0)
  assert found['final_height'] == 1.5


def test_flight_is_the_longest_time_without_any_foot() -> None:
  left = [1, 0, 0, 1, 1, 0, 0, 0, 1, 0]
  right = [1, 1, 0, 0, 1, 0, 0, 0, 1, 0]
  found = _metrics(contact=np.stack([left, right], axis=1))
  # One step in the first cycle; three, then another one, in the second.
  assert found['flight'] == pytest.approx(_TIMESTEP * (1 + 3) / 2)
  assert found['single_support'] == pytest.approx(2 / 10)


def test_what_follows_the_end_does_not_count() -> None:
  position = np.zeros((30, 2, 3))
  position[:, 0, 0] = np.arange(30)  # 10 m/s.
  position[5:] = np.nan
  position[:, 1] = 0.0
  found = evaluation.body_metrics(
    _episodes([5, 30], position=position), np.array([0.5, 0.5]), _TIMESTEP
  )
  # Ended before the first second: the velocity is that of the last step.
  assert found['velocity'] == pytest.approx((10.0 + 0.0) / 2)
  assert found['drift'] == pytest.approx(4.0 / 2)


@pytest.mark.parametrize('length', [1, 2])
def test_shortest_episodes(length: int) -> None:
  position = np.zeros((30, 1, 3))
  found = evaluation.body_metrics(
    _episodes([length], position=position), np.array([0.5]), _TIMESTEP
  )
  assert np.isfinite(list(found.values())).all()


def test_summary() -> None:
  found = evaluation.summary(np.array([1.0, 3.0]))
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
  found = evaluation.run_episodes(environment, lambda seen: seen + 1, progress)
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
