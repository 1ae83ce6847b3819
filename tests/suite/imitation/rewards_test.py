"""Tests of dmc_multimode.suite.rewards: Eq. 3 by hand."""

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np

from dmc_multimode.suite.imitation import rewards

_UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0]])


def _yawed(degrees: float) -> np.ndarray:
  half = np.radians(degrees) / 2
  return np.array([[np.cos(half), 0.0, 0.0, np.sin(half)]])


def _errors(
  position: tuple[float, ...] = (0.0, 0.0, 0.0),
  orientation: np.ndarray = _UPRIGHT,
  contact: tuple[float, ...] = (0.0, 0.0),
  has_contact: bool = True,
) -> rewards.TrackingErrors:
  """Errors from a reference at the origin, upright, with no contact."""
  return rewards.tracking_errors(
    np.array([position]),
    orientation,
    np.array([contact]),
    np.zeros((1, 3)),
    _UPRIGHT,
    np.zeros((1, 2)),
    np.array([has_contact]),
  )


class TrackingErrorsTest(parameterized.TestCase):
  def test_position_is_the_distance(self) -> None:
    np.testing.assert_allclose(_errors((0.3, 0.0, -0.4)).position, [0.5])

  @parameterized.parameters(
    (0, 0.0), (60, 0.25), (-60, 0.25), (90, 0.5), (180, 1.0), (360, 0.0)
  )
  def test_orientation_is_squared_sine_of_half_the_angle(
    self, degrees: float, expected: float
  ) -> None:
    error = _errors(orientation=_yawed(degrees)).orientation
    np.testing.assert_allclose(error, [expected], atol=1e-12)

  def test_both_signs_of_a_quaternion_are_one_orientation(self) -> None:
    np.testing.assert_array_equal(
      _errors(orientation=_yawed(50)).orientation,
      _errors(orientation=-_yawed(50)).orientation,
    )

  def test_rounding_gives_no_negative_error(self) -> None:
    error = _errors(orientation=_UPRIGHT * (1 + 1e-9)).orientation
    np.testing.assert_array_equal(error, [0.0])

  @parameterized.parameters(
    ((0.0, 0.0), True, 0.0),
    ((1.0, 0.0), True, 1.0),
    ((1.0, 1.0), True, 2**0.5),
    ((1.0, 1.0), False, 0.0),
  )
  def test_contact(
    self, contact: tuple[float, float], has_contact: bool, expected: float
  ) -> None:
    error = _errors(contact=contact, has_contact=has_contact).contact
    np.testing.assert_allclose(error, [expected])


class RewardTermsTest(parameterized.TestCase):
  def test_by_hand(self) -> None:
    errors = rewards.TrackingErrors(
      np.array([0.0, 0.2]), np.array([0.0, 0.25]), np.array([0.0, 1.0])
    )
    gains = rewards.RewardGains(0.35, 0.35, 0.3)
    terms = rewards.reward_terms(errors, gains)
    # exp(-1), exp(-1.25) and exp(-2) times the weights.
    np.testing.assert_allclose(terms['position'], [0.35, 0.128758], rtol=1e-5)
    np.testing.assert_allclose(
      terms['orientation'], [0.35, 0.100277], rtol=1e-5
    )
    np.testing.assert_allclose(terms['contact'], [0.3, 0.0406006], rtol=1e-5)

  def test_defaults_are_those_of_table_i(self) -> None:
    gains = rewards.RewardGains()
    self.assertEqual(gains, (0.5, 0.5, 0.0, 5.0, 5.0, 2.0))
    self.assertEqual(gains.highest, 1.0)

  def test_perfect_step_pays_the_highest(self) -> None:
    gains = rewards.RewardGains(0.3, 0.2, 0.1)
    terms = rewards.reward_terms(_errors(), gains)
    np.testing.assert_allclose(sum(terms.values()), [gains.highest])

  def test_inputs_stay_as_they_are(self) -> None:
    position, orientation = np.array([[0.3, 0.0, 0.1]]), _yawed(30)
    before = position.copy(), orientation.copy()
    rewards.tracking_errors(
      position,
      orientation,
      np.ones((1, 2)),
      np.zeros((1, 3)),
      _UPRIGHT,
      np.zeros((1, 2)),
      np.ones(1, dtype=bool),
    )
    np.testing.assert_array_equal(position, before[0])
    np.testing.assert_array_equal(orientation, before[1])


class FootingTest(parameterized.TestCase):
  @parameterized.parameters(
    # Left stance: both down, as wanted, lower, both up, the wrong foot up.
    ((1.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.0),
    ((1.0, 0.0), (0.0, 0.05), (1.0, 0.0), 1.0),
    ((1.0, 0.0), (0.0, 0.02), (1.0, 0.0), 0.4),
    ((0.0, 0.0), (0.02, 0.05), (1.0, 0.0), 0.0),
    ((0.0, 1.0), (0.07, 0.0), (1.0, 0.0), 0.0),
    # Flight: by the height of both, within bounds.
    ((0.0, 0.0), (0.01, 0.03), (0.0, 0.0), 0.12),
    ((0.0, 0.0), (9.0, 9.0), (0.0, 0.0), 1.0),
    ((0.0, 0.0), (-0.3, 0.05), (0.0, 0.0), 0.0),
    # Both down.
    ((1.0, 1.0), (0.0, 0.0), (1.0, 1.0), 1.0),
    ((1.0, 0.0), (0.0, 0.2), (1.0, 1.0), 0.0),
  )
  def test_by_hand(
    self,
    contact: tuple[float, float],
    clearance: tuple[float, float],
    wanted: tuple[float, float],
    expected: float,
  ) -> None:
    found = lambda prescribed: rewards.footing(
      np.array([contact]),
      np.array([clearance]),
      np.array([wanted]),
      np.array([prescribed]),
    )
    np.testing.assert_allclose(found(True), np.array([expected]))
    np.testing.assert_array_equal(found(False), np.array([1.0]))


if __name__ == '__main__':
  absltest.main()
