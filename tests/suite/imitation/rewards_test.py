"""Tests of dmc_multimode.suite.imitation.rewards."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from dmc_multimode.modes import reference
from dmc_multimode.suite.imitation import rewards

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def _yawed(degrees: float) -> tuple[float, ...]:
  half = np.radians(degrees) / 2
  return (np.cos(half), 0.0, 0.0, np.sin(half))


def _errors(
  position: tuple[float, ...] = (0.0, 0.0, 0.0),
  orientation: tuple[float, ...] = _UPRIGHT,
  contact: tuple[float, ...] = (0.0, 0.0),
  has_contact: bool = True,
) -> dict[str, np.ndarray]:
  """Errors from a reference at the origin, upright, with no contact."""
  robot = rewards.RobotState(
    np.array([[*position, *_UPRIGHT, *[0.0] * 10]]),
    np.zeros((1, 16)),
    np.array([orientation]),
    np.array([contact]),
  )
  return rewards.tracking_errors(
    robot,
    reference.Reference(
      np.zeros((1, 3)),
      np.array([_UPRIGHT]),
      np.zeros((1, 2)),
      np.array([has_contact]),
    ),
  )


# One row a term at least: its name, the robot beside the reference, the error.
@pytest.mark.parametrize(
  ('term', 'robot', 'expected'),
  [
    ('position', {'position': (0.3, 0.0, -0.4)}, 0.5),
    ('orientation', {}, 0.0),
    ('orientation', {'orientation': _yawed(60)}, 0.25),
    ('orientation', {'orientation': _yawed(-60)}, 0.25),
    ('orientation', {'orientation': _yawed(90)}, 0.5),
    ('orientation', {'orientation': _yawed(180)}, 1.0),
    # Both signs of a quaternion are one orientation.
    ('orientation', {'orientation': _yawed(360)}, 0.0),
    # Rounding gives no negative error.
    ('orientation', {'orientation': (1 + 1e-9, 0.0, 0.0, 0.0)}, 0.0),
    ('contact', {'contact': (1.0, 0.0)}, 1.0),
    ('contact', {'contact': (1.0, 1.0)}, 2**0.5),
    ('contact', {'contact': (1.0, 1.0), 'has_contact': False}, 0.0),
  ],
)
def test_errors_by_hand(
  term: str, robot: dict[str, Any], expected: float
) -> None:
  errors = _errors(**robot)
  np.testing.assert_allclose(errors.pop(term), [expected], atol=1e-12)
  np.testing.assert_array_equal(list(errors.values()), 0.0)


def test_terms_by_hand() -> None:
  errors = {
    'position': np.array([0.0, 0.2]),
    'orientation': np.array([0.0, 0.25]),
    'contact': np.array([0.0, 1.0]),
  }
  gains = rewards.RewardGains().with_weights(
    position=0.35, orientation=0.35, contact=0.3
  )
  terms = rewards.reward_terms(errors, gains)
  # exp(-1), exp(-1.25) and exp(-2) times the weights.
  np.testing.assert_allclose(terms['position'], [0.35, 0.128758], rtol=1e-5)
  np.testing.assert_allclose(terms['orientation'], [0.35, 0.100277], rtol=1e-5)
  np.testing.assert_allclose(terms['contact'], [0.3, 0.0406006], rtol=1e-5)


def test_precision_by_hand() -> None:
  errors = {
    'position': np.array([0.0, 0.02]),
    'orientation': np.array([0.0, 0.01]),
    'contact': np.array([1.0, 1.0]),  # Does not matter, nor do the weights.
  }
  found = rewards.precision(errors, rewards.RewardGains())
  # exp(-5 (5 x 0.02 + 5 x 0.01)).
  np.testing.assert_allclose(found, [1.0, 0.4723666], rtol=1e-6)


def test_defaults_are_those_of_table_i() -> None:
  gains = rewards.RewardGains()
  assert [dataclasses.astuple(gains)[i] for i in range(3)] == [
    (0.5, 5.0),
    (0.5, 5.0),
    (0.0, 2.0),
  ]
  assert gains.highest == 1.0
  # Which is what a perfect step pays.
  other = gains.with_weights(position=0.3, orientation=0.2, contact=0.1)
  terms = rewards.reward_terms(_errors(), other)
  np.testing.assert_allclose(sum(terms.values()), [other.highest])
