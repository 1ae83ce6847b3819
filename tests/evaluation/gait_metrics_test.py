"""Tests of dmc_multimode.evaluation.gait_metrics."""

from typing import Any

import numpy as np
import pytest

from dmc_multimode.evaluation import gait_metrics

_TIMESTEP = 0.1  # Seconds: ten steps a second.


def _trace(cycle: float = 0.5, **fields: Any) -> gait_metrics.Trace:
  """Fields [T, ...]; those not given say that nothing happened."""
  steps = len(next(iter(fields.values())))
  still = {
    'position': np.zeros((steps, 3)),
    'reference': np.zeros((steps, 3)),
    'support': np.zeros(steps),
    'yaw': np.zeros(steps),
    'tilt': np.zeros((steps, 2)),
    'contact': np.ones((steps, 2)),
    'reference_contact': np.ones((steps, 2)),
  }
  return gait_metrics.Trace(
    **{**still, **fields}, timestep=_TIMESTEP, cycle=cycle
  )


def _heights(*values: float) -> np.ndarray:
  return np.outer(values, [0.0, 0.0, 1.0])


def test_velocity_without_the_first_second() -> None:
  time = _TIMESTEP * np.arange(31)
  x = np.where(time < 1.0, 0.0, 0.6 * (time - 1.0))
  position = np.stack([x, -0.5 * x, 0.5 + 0 * x], axis=1)
  reference = np.stack([0.7 * time, 0 * time, 0 * time + 0.5], axis=1)
  found = gait_metrics.metrics(_trace(position=position, reference=reference))
  assert found['velocity'] == pytest.approx(0.6)
  assert found['lateral_velocity'] == pytest.approx(-0.3)
  assert found['reference_velocity'] == pytest.approx(0.7)
  assert found['drift'] == pytest.approx(np.hypot(1.2, 0.6))
  assert found['final_height'] == 0.5
  errors = np.linalg.norm(position - reference, axis=1)
  assert found['position_error'] == pytest.approx(errors.mean())


def test_heights_by_cycle() -> None:
  # Two cycles of five steps, and two steps of a third that does not count.
  z = [1.5, 1.4, 1.7, 1.6, 1.5, 1.5, 1.3, 1.8, 1.5, 1.5, 9.0, 1.5]
  trace = _trace(position=_heights(*z), support=np.ones(12))
  found = gait_metrics.metrics(trace)
  assert found['apex'] == pytest.approx((0.7 + 0.8) / 2)
  assert found['rise'] == pytest.approx((0.3 + 0.5) / 2)
  assert found['height'] == pytest.approx(np.mean(z) - 1.0)
  assert found['final_height'] == 1.5


def test_bob_is_without_the_first_second() -> None:
  position = _heights(*[9.0] * 10, 0.5, 0.6, 0.4, 0.5, 0.5)
  assert gait_metrics.bob(_trace(position=position)) == pytest.approx(0.1)
  # On a step as on the ground.
  support = np.array([0.0] * 12 + [0.4] * 3)
  raised = position + _heights(*support)
  found = gait_metrics.bob(_trace(position=raised, support=support))
  assert found == pytest.approx(0.1)


def test_flight_is_the_longest_time_without_any_foot() -> None:
  left = [1, 0, 0, 1, 1, 0, 0, 0, 1, 0]
  right = [1, 1, 0, 0, 1, 0, 0, 0, 1, 0]
  found = gait_metrics.metrics(_trace(contact=np.stack([left, right], axis=1)))
  # One step in the first cycle; three, then another one, in the second.
  assert found['flight'] == pytest.approx(_TIMESTEP * (1 + 3) / 2)
  assert found['single_support'] == pytest.approx(2 / 10)


@pytest.mark.parametrize(
  ('left', 'right', 'expected'),
  [
    # Touch-downs in turns.
    ('..##..##..##', '##..##..##..', 1.0),
    ('..##..##..##', '..##..##..##', 0.0),
    ('..##..##..##', '############', 0.0),
    # Left, right, both, right, left: two pairs of four.
    ('..####..####..##', '....##..##..####', 0.5),
    ('############', '####....####', 0.0),
    # Taps and bounces of a single step are nothing.
    ('####.####.##..', '########.######', 0.0),
    ('...####...#...####.###', '######....#####....###', 1.0),
  ],
)
def test_alternation(left: str, right: str, expected: float) -> None:
  rows = zip(f'{"#" * 10}{left}', f'{"#" * 10}{right}', strict=False)
  contact = np.array([[foot == '#' for foot in row] for row in rows])
  assert gait_metrics.alternation(_trace(contact=contact)) == expected


def test_alternation_of_four_feet_is_the_mean_of_front_and_hind() -> None:
  steps = np.tile([[1, 0], [1, 0], [0, 1], [0, 1]], (12, 1))
  feet = lambda front, hind: _trace(contact=np.hstack([front, hind]))
  assert gait_metrics.alternation(feet(steps, steps[:, ::-1])) == 1.0
  assert gait_metrics.alternation(feet(steps, np.ones_like(steps))) == 0.5
  assert gait_metrics.alternation(feet(steps[:, :1] * [1, 1], steps)) == 0.5


def test_turn_rate_counts_whole_turns() -> None:
  yaw = -2.0 * _TIMESTEP * np.arange(60)  # Almost two turns to the right.
  wrapped = np.angle(np.exp(1j * yaw))
  assert gait_metrics.turn_rate(_trace(yaw=wrapped)) == pytest.approx(-2.0)


def test_agreement_counts_feet_once_settled() -> None:
  contact = np.ones((14, 2))
  contact[:10] = 0  # The first second.
  contact[10, 0] = contact[11] = 0  # Three of the eight that count.
  assert gait_metrics.agreement(_trace(contact=contact)) == pytest.approx(5 / 8)


def test_stance_is_on_both_feet_on_the_step() -> None:
  trace = _trace(
    position=_heights(0.5, 0.9, 0.9, 0.9, 0.8, 0.9, 0.9, 0.9, 0.9),
    support=np.array([0.0, 0.0, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4]),
    contact=np.array([[1, 1]] * 6 + [[1, 0]] + [[1, 1]] * 2),
  )
  # Not over the ground, not at 0.1 m too low, not on one foot.
  assert gait_metrics.stance(trace, 0.4, 0.5) == pytest.approx(2 * _TIMESTEP)
  assert gait_metrics.stance(trace, 0.3, 0.5) == 0.0


def test_what_follows_the_end_does_not_count() -> None:
  measured = {
    'position': np.zeros((30, 2, 3)),
    'reference': np.zeros((30, 2, 3)),
    'support': np.zeros((30, 2)),
    'yaw': np.zeros((30, 2)),
    'tilt': np.zeros((30, 2, 2)),
    'contact': np.ones((30, 2, 2)),
    'reference_contact': np.ones((30, 2, 2)),
  }
  measured['position'][:, 0, 0] = np.arange(30)  # 10 m/s.
  measured['position'][5:, 0] = np.nan
  first, second = gait_metrics.traces(measured, [5, 30], _TIMESTEP, 0.5)
  # Ended before the first second: the velocity is that of the last step.
  assert gait_metrics.metrics(first)['velocity'] == pytest.approx(10.0)
  assert gait_metrics.metrics(first)['drift'] == pytest.approx(4.0)
  assert len(second.position) == 30


@pytest.mark.parametrize('length', [1, 2])
def test_shortest_episodes(length: int) -> None:
  trace = _trace(position=np.zeros((length, 3)))
  assert np.isfinite(list(gait_metrics.metrics(trace).values())).all()


def test_lean_is_the_greatest_of_a_cycle() -> None:
  pitch = np.array([0.1, 0.3, 0.2, -0.1, 0.5, 0.1])
  trace = _trace(0.3, tilt=np.stack([0 * pitch, pitch], axis=1))
  assert gait_metrics.lean(trace, 1, 1) == pytest.approx((0.3 + 0.5) / 2)
  assert gait_metrics.lean(trace, 1, -1) == pytest.approx((-0.1 + 0.1) / 2)
  assert gait_metrics.lean(trace, 1, 1, every_cycle=False) == 0.5
  assert gait_metrics.lean(trace, 0, 1) == 0.0
