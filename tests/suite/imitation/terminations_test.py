"""Tests of dmc_multimode.suite.imitation.terminations."""

import numpy as np
import pytest

from dmc_multimode.suite.imitation import terminations

_DEFAULT = terminations.TerminationLimits()
_NEAR = terminations.TerminationLimits(distance=0.2)
_FALLS = terminations.falls_alone(_DEFAULT)


@pytest.mark.parametrize(
  ('limits', 'distance', 'angle', 'reward', 'height', 'finite', 'expected'),
  [
    (_DEFAULT, 0.1, 0.0, 0.9, 0.5, True, 'none'),
    (_DEFAULT, 0.35, 0.9999, 0.3, 0.22, True, 'none'),
    (_DEFAULT, 0.3501, 0.0, 0.9, 0.5, True, 'position_error'),
    (_DEFAULT, 0.1, 1.0001, 0.9, 0.5, True, 'orientation_error'),
    (_DEFAULT, 0.1, -1.0001, 0.9, 0.5, True, 'orientation_error'),
    (_DEFAULT, 0.1, 0.0, 0.2999, 0.5, True, 'low_reward'),
    (_DEFAULT, 0.1, 0.0, 0.9, 0.2199, True, 'base_height'),
    (_DEFAULT, 0.1, 0.0, 0.9, 0.5, False, 'non_finite'),
    (_DEFAULT, 0.1, 2.0, 0.1, 0.5, True, 'orientation_error'),
    (_DEFAULT, 0.5, 2.0, 0.1, 0.5, True, 'position_error'),
    (_DEFAULT, 0.5, 2.0, 0.1, 0.1, True, 'base_height'),
    (_DEFAULT, 0.5, 2.0, 0.1, 0.1, False, 'non_finite'),
    (_NEAR, 0.3, 0.0, 0.9, 0.5, True, 'position_error'),
    (_FALLS, 9.0, np.pi, 0.0, 0.5, True, 'none'),
    (_FALLS, 9.0, np.pi, 0.0, 0.2, True, 'base_height'),
  ],
)
def test_causes(
  limits: terminations.TerminationLimits,
  distance: float,
  angle: float,
  reward: float,
  height: float,
  finite: bool,
  expected: str,
) -> None:
  """Of the second world; the first one is well."""
  cause = terminations.termination_cause(
    np.array([0.0, distance]),
    np.sin(np.array([0.0, angle]) / 2) ** 2,
    np.array([1.0, reward]),
    np.array([0.5, height]),
    np.array([True, finite]),
    limits,
  )
  assert [terminations.CAUSES[each] for each in cause] == ['none', expected]
