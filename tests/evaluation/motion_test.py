"""Tests of dmc_multimode.evaluation.motion, motion_metrics and switching."""

import types
from typing import Any, Sequence

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.evaluation import motion
from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.evaluation import scores
from dmc_multimode.evaluation import switching
from dmc_multimode.modes import library
from dmc_multimode.modes import schedule as schedule_lib

_STEPS, _TIMESTEP = 8, 0.01  # Of the physics; two in a control step.
_WEIGHT = 100.0


def _column(width: int, *values: float) -> np.ndarray:
  """The values in the first of so many columns, [N, width]."""
  return np.pad(
    np.array(values, dtype=float)[:, None], ((0, 0), (0, width - 1))
  )


def _corner(
  x: Sequence[float], depths: Sequence[float], z: Sequence[float] = (0,)
) -> dict[str, np.ndarray]:
  """The third corner of the left sole goes there; the others are outside."""
  corners = np.zeros((len(x), 2, 4, 3))
  corners[:, 0, 2, 0], corners[:, 0, 2, 2] = x, z
  result = np.full((len(x), 2, 4), -0.001)
  result[:, 0, 2] = depths
  return {'corners': corners, 'depths': result}


def _trace(**fields: Any) -> motion_metrics.MotionTrace:
  """Nothing happens, but for these fields."""
  still = {
    'actions': np.zeros((_STEPS // 2, 10)),
    'joints': np.zeros((_STEPS, 10)),
    'joint_speeds': np.zeros((_STEPS, 10)),
    'torques': np.zeros((_STEPS, 10)),
    'loads': np.zeros((_STEPS, 2)),
    'corners': np.zeros((_STEPS, 2, 4, 3)),
    'depths': np.zeros((_STEPS, 2, 4)),
    'trunk': np.zeros((_STEPS, 3)),
    'limits': np.tile([[-0.5], [0.25]], 10),
    'travels': True,
    'weight': _WEIGHT,
    'control_timestep': 2 * _TIMESTEP,
    'physics_timestep': _TIMESTEP,
  }
  return motion_metrics.MotionTrace(**{**still, **fields})


_SECONDS = 0.02 * np.arange(100)
_TWO_AND_TEN_HZ = np.sin(4 * np.pi * _SECONDS) + 0.5 * np.sin(
  20 * np.pi * _SECONDS
)
# A tap that bounces; the touch-down after a swing comes with 1.2 m/s along x
# and 1.6 m/s down.
_LANDING = _corner(
  [9, 9, 9, 9, 9, 0.0, 0.012, 9],
  [1, -1, 1, -1, -1, -1, 1, 1],
  [9, 9, 9, 9, 9, 0.016, 0.0, 9],
)
_SLIDING = {
  'loads': _column(2, 0, 11, 11, 11, 9, 11, 11, 0),
  **_corner(
    [7, 0.0, 0.01, 0.03, 7, 0.0, 0.03, 7],
    [2e-3, 3e-3, 4e-3, 5e-3, 6e-3, 7e-3, 8e-3, 9e-3],
  ),
}


@pytest.mark.parametrize(
  ('name', 'fields', 'expected'),
  [
    # Of 30 changes.
    ('action_change', {'actions': _column(10, 0, 0.1, 0.1, -0.2)}, 0.4 / 30),
    (
      'action_change_p99',
      {'actions': _column(10, 0, 0.1, 0.1, -0.2)},
      0.1 + 0.71 * 0.2,
    ),
    ('fast_action_power', {'actions': _column(10, *_TWO_AND_TEN_HZ)}, 0.2),
    ('fast_action_power', {}, 0.0),
    ('torque_rms', {'torques': np.tile([3.0, -4.0], (8, 5))}, 12.5**0.5),
    ('torque_peak', {'torques': np.tile([3.0, -4.0], (8, 5))}, 4.0),
    (  # Braking gives nothing back.
      'power',
      {
        'torques': np.tile([2.0, -2.0], (8, 5)),
        'joint_speeds': np.full((8, 10), 3.0),
      },
      30.0,
    ),
    (
      'cost_of_transport',
      {
        'torques': np.tile([2.0, -2.0], (8, 5)),
        'joint_speeds': np.full((8, 10), 3.0),
        'trunk': _column(3, *np.linspace(0.0, 0.3, 8)),
      },
      30 * 0.08 / (100 * 0.3),
    ),
    ('cost_of_transport', {'travels': False}, None),
    ('touch_down_speed', _LANDING, 2.0),
    ('touch_down_speed_p99', _LANDING, 2.0),
    ('touch_down_speed', {}, None),
    ('slip', _SLIDING, (1.0 + 2.0 + 3.0) / 3),
    # From 3 to 8 mm where the foot bears a load.
    ('penetration_p99', _SLIDING, 3 + 0.99 * 5),
    ('limit_excess', {'joints': _column(10, *[-0.6] * 8)}, np.rad2deg(0.1)),
    (
      'hip_yaw_at_limit',
      {'joints': _column(10, 0, 0, 0.25, 0.3, *[0] * 4)},
      1 / 8,
    ),
    ('peak_force', {'loads': np.tile([120.0, 80.0], (8, 1))}, 2.0),
    ('stance_asymmetry', {'loads': np.array([[9, 9], [9, 9], [9, 0]])}, 1 / 5),
    ('drift_60s', {'trunk': _column(3, 5.0, 5.3, 4.9)}, 0.3),
  ],
)
def test_metrics(
  name: str, fields: dict[str, Any], expected: float | None
) -> None:
  (metric,) = (row for row in motion_metrics.TABLE if row.name == name)
  found = motion_metrics.value(metric, [_trace(**fields)])
  assert found == (expected and pytest.approx(expected, rel=1e-3))


def test_depths() -> None:
  """Ground to x = 1, a gap to 1.5, a block of 0.4 m, and an unused segment."""
  starts, ends, tops = (
    np.array([row]) for row in ([-9, 1.5, np.inf], [1, 9, np.inf], [0, 0.4, 0])
  )
  x = [0.0, 0.0, 0.99, 1.2, 1.52, 3.0]
  z = [0.1, -0.02, -0.02, -0.02, 0.1, 0.3]
  points = np.stack([x, np.zeros(6), z], axis=-1)
  found = motion.depths(points[None], starts, ends, tops)[0]
  np.testing.assert_allclose(found[[1, 2, 4, 5]], [0.02, 0.01, 0.02, 0.1])
  assert found[0] == pytest.approx(-0.1) and found[3] < 0


def test_a_shipped_policy(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(motion, '_LONG', 2.0)
  policy = pretrained.load('pi2')
  evaluator = scores.make_evaluator(policy, quiet=True)
  found: dict[str, Any] = {**motion.evaluate(evaluator, episodes=1)}
  assert tuple(found) == policy.mode_set.names
  for row in found.values():
    assert list(row) == [metric.name for metric in motion_metrics.TABLE]
    assert 0 < row['torque_rms'] < row['torque_peak'] <= 30.001
    assert row['peak_force'] > 0.99
  idle, walk = found['idle'], found['walk_forward']
  assert (idle['cost_of_transport'], walk['drift_60s']) == (None, None)
  assert 0 < idle['drift_60s'] < 0.1 and idle['power'] < 0.2 * walk['power']
  assert 0.1 < walk['cost_of_transport'] < 5
  assert 0.2 < walk['touch_down_speed'] < 5
  assert idle['action_change'] < 0.05 < walk['action_change']
  # To record changes nothing.
  plan = schedule_lib.single(np.array([1]))
  plain, recorded = (
    evaluator.run(plan, '', recorder) for recorder in (None, motion.Recorder())
  )
  assert plain.returns == recorded.returns


def test_random_schedules() -> None:
  schedule = switching.random_schedule(
    library.mode_set('pi2'), 50, 20.0, np.random.RandomState(0)
  )
  used = np.isfinite(schedule.starts)
  assert 18 <= schedule.starts[used].max() < 20
  assert (np.diff(schedule.modes) != 0).all()
  intervals = np.diff(np.where(used, schedule.starts, 0))[used[:, 1:]]
  assert 0.5 <= intervals.min() < 0.6 and 1.9 < intervals.max() <= 2.0


def test_switching(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(switching, 'SECONDS', 1.5)
  evaluator = scores.make_evaluator(pretrained.load('pi2'), quiet=True)
  found = switching.evaluate(evaluator, 6)
  assert found['from_ground'] == {'survival': 1.0, 'falls': {}}
  # A robot that holds one pose falls, whatever it is told.
  policy: Any = types.SimpleNamespace(
    mode_set=evaluator.mode_set,
    select_action=lambda seen: np.ones((len(seen), 10)),
  )
  evaluator.policy = policy
  found = switching.evaluate(evaluator, 6)
  for kind in ('any_moment', 'from_ground'):
    survival, falls = found[kind]['survival'], found[kind]['falls']
    assert survival < 0.5
    assert sum(falls.values()) == round(6 * (1 - survival))
