"""Tests of dmc_multimode.suite.imitation.terminations."""

import numpy as np
import pytest

from dmc_multimode.suite.imitation import terminations

_LIMITS = terminations.TerminationLimits()


@pytest.mark.parametrize(
  ('distance', 'angle', 'reward', 'height', 'finite', 'expected'),
  [
    (0.1, 0.0, 0.9, 0.5, True, 'none'),
    (0.35, 0.9999, 0.3, 0.22, True, 'none'),
    (0.3501, 0.0, 0.9, 0.5, True, 'position_error'),
    (0.1, 1.0001, 0.9, 0.5, True, 'orientation_error'),
    (0.1, -1.0001, 0.9, 0.5, True, 'orientation_error'),
    (0.1, 0.0, 0.2999, 0.5, True, 'low_reward'),
    (0.1, 0.0, 0.9, 0.2199, True, 'base_height'),
    (0.1, 0.0, 0.9, 0.5, False, 'non_finite'),
    (0.1, 2.0, 0.1, 0.5, True, 'orientation_error'),
    (0.5, 2.0, 0.1, 0.5, True, 'position_error'),
    (0.5, 2.0, 0.1, 0.1, True, 'base_height'),
    (0.5, 2.0, 0.1, 0.1, False, 'non_finite'),
  ],
)
def test_causes(
  distance: float,
  angle: float,
  reward: float,
  height: float,
  finite: bool,
  expected: str,
) -> None:
  cause = terminations.termination_cause(
    np.array([distance]),
    np.sin(np.array([angle]) / 2) ** 2,
    np.array([reward]),
    np.array([height]),
    np.array([finite]),
    _LIMITS,
  )
  assert terminations.CAUSES[cause[0]] == expected


def test_worlds_are_independent() -> None:
  cause = terminations.termination_cause(
    np.array([0.0, 1.0, 0.0]),
    np.zeros(3),
    np.array([1.0, 1.0, 0.0]),
    np.array([0.5, 0.5, 0.5]),
    np.ones(3, dtype=bool),
    _LIMITS,
  )
  np.testing.assert_array_equal(cause, [0, 1, 2])


def test_limits_are_taken() -> None:
  cause = terminations.termination_cause(
    np.array([0.3]),
    np.array([0.0]),
    np.array([0.9]),
    np.array([0.5]),
    np.array([True]),
    terminations.TerminationLimits(distance=0.2),
  )
  assert terminations.CAUSES[cause[0]] == 'position_error'


def test_only_a_fall_counts() -> None:
  cause = terminations.termination_cause(
    np.array([9.0, 9.0]),
    np.array([1.0, 1.0]),
    np.array([0.0, 0.0]),
    np.array([0.5, 0.2]),
    np.array([True, True]),
    terminations.falls_alone(_LIMITS),
  )
  assert ([terminations.CAUSES[i] for i in cause]) == ['none', 'base_height']
