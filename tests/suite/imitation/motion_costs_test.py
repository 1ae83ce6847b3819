"""Tests of dmc_multimode.suite.imitation.motion_costs."""

from typing import Any

import numpy as np
import pytest

from dmc_multimode.suite.imitation import motion_costs

_LIMITS = np.tile([-0.5, 1.0], (10, 1))
_QUIET: dict[str, Any] = {
  'actions': np.zeros((1, 3, 10)),
  'joints': np.zeros((1, 10)),
  'limits': _LIMITS,
  'contact': np.array([[1.0, 1.0]]),
  'clearance': np.zeros((1, 2)),
  'overhang': np.zeros((1, 2)),
  'sole_velocity': np.zeros((1, 2)),
  'width': np.array([0.18]),
  'stance_width': 0.18,
  'steady': np.array([False]),
  'grounded': np.array([True]),
  'straight': np.array([False]),
}


def _actions(*values: float) -> np.ndarray:
  """Joint targets, the newest first; only one joint of ten moves."""
  return np.array(values)[None, :, None] * np.eye(10)[0]


@pytest.mark.parametrize(
  ('name', 'changes', 'expected'),
  [
    ('action_change', {'actions': _actions(0.3, 0.1, 7.0)}, 0.04 / 10),
    ('action_acceleration', {'actions': _actions(0.3, 0.1, 0.2)}, 0.09 / 10),
    ('action_acceleration', {'actions': _actions(0.3, 0.2, 0.1)}, 0.0),
    # 1.5 m/s faster than 0.5 m/s, on the ground; one foot rises.
    ('touch_down', {'sole_velocity': np.array([[-2.0, 3.0]])}, 2.25),
    (
      'touch_down',
      {
        'sole_velocity': np.array([[-2.0, 0.0]]),
        'grounded': np.array([False]),
      },
      0.0,
    ),
    (
      'touch_down',
      {
        'sole_velocity': np.array([[-2.0, 0.0]]),
        'clearance': np.array([[0.03, 0.0]]),
      },
      2.25 / np.e,
    ),
    # 3 degrees before one limit, 0.1 rad over one, and in between.
    ('joint_limit', {'joints': 0.999 * np.eye(10)[:1]}, 0.263),
    ('joint_limit', {'joints': -0.6 * np.eye(10)[:1]}, 2.3213),
    ('joint_limit', {'joints': 0.9 * np.eye(10)[:1]}, 0.0),
    # A toe over the edge; the other foot, wholly beyond it, is in the air.
    (
      'foothold',
      {
        'overhang': np.array([[0.5, 1.0]]),
        'contact': np.array([[1.0, 0.0]]),
      },
      0.25,
    ),
    (
      'lifted_foot',
      {'contact': np.array([[1.0, 0.0]]), 'steady': np.array([True])},
      0.5,
    ),
    ('lifted_foot', {'contact': np.array([[1.0, 0.0]])}, 0.0),
    (
      'straddle',
      {'width': np.array([0.27]), 'straight': np.array([True])},
      0.25,
    ),
    (
      'straddle',
      {'width': np.array([-0.1]), 'straight': np.array([True])},
      1.0,
    ),
    ('straddle', {'width': np.array([0.27])}, 0.0),
  ],
)
def test_costs_by_hand(
  name: str, changes: dict[str, Any], expected: float
) -> None:
  motion = motion_costs.Motion(**{**_QUIET, **changes})
  found = motion_costs.COSTS[name](motion)
  np.testing.assert_allclose(found, [expected], atol=1e-3)
  weights = motion_costs.CostWeights(**{name: 2.0})
  np.testing.assert_allclose(motion_costs.total(motion, weights), 2.0 * found)


def test_quiet_motion_costs_nothing() -> None:
  motion = motion_costs.Motion(**_QUIET)
  assert motion_costs.total(motion, motion_costs.QUIET) == 0
  assert motion_costs.QUIET.active and not motion_costs.NONE.active
