"""Tests of dmc_multimode.suite.privileged."""

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np

from dmc_multimode.suite.imitation import privileged


def _observe(
  heading: float = 0.0, countdown: float = 0.6, distance: float = 0.25
) -> dict[str, np.ndarray]:
  """Of a robot that is 0.1 m ahead, 0.2 m to the left and 0.3 m too low.

  Ahead of it, behind a gap of 0.2 m, the ground is 0.1 m lower.
  """
  return dict(
    privileged.observe(
      position=np.array([[5.1, 6.2, 0.2]]),
      reference=np.array([[5.0, 6.0, 0.5]]),
      heading=np.array([heading]),
      contact=np.array([[1.0, 0.0]]),
      countdown=np.array([countdown]),
      next_command=np.array([[7.0, 8.0, 9.0]]),
      edge=np.array([5.1 + distance]),
      rise=np.array([-0.1]),
      gap=np.array([0.2]),
    )
  )


class LayoutTest(parameterized.TestCase):
  @parameterized.parameters((1, 10), (4, 13), (11, 20))
  def test_size(self, command_size: int, expected: int) -> None:
    self.assertEqual(privileged.size(command_size), expected)

  def test_parts_are_laid_out_so(self) -> None:
    parts = [(name, part.shape[1]) for name, part in _observe().items()]
    self.assertEqual(parts, list(privileged.layout(3)))
    self.assertEqual(
      parts,
      [
        ('position_error', 3),
        ('contact', 2),
        ('countdown', 1),
        ('next_command', 3),
        ('ground_ahead', 3),
      ],
    )


class ObserveTest(parameterized.TestCase):
  @parameterized.parameters(
    (0, (0.1, 0.2, -0.3)),
    # Whoever faces +y has what was to the left ahead.
    (90, (0.2, -0.1, -0.3)),
    (180, (-0.1, -0.2, -0.3)),
    (-90, (-0.2, 0.1, -0.3)),
    # (0.1 + 0.2) / sqrt 2 and (0.2 - 0.1) / sqrt 2.
    (45, (0.2121320, 0.0707107, -0.3)),
  )
  def test_position_error_is_in_the_commanded_heading(
    self, degrees: float, expected: tuple[float, float, float]
  ) -> None:
    parts = _observe(heading=np.radians(degrees))
    np.testing.assert_allclose(parts['position_error'], [expected], atol=1e-7)

  @parameterized.parameters(
    (0.0, 0.0), (0.6, 0.6), (1.5, 1.5), (1.53, 1.5), (np.inf, 1.5)
  )
  def test_countdown_is_cut_off(
    self, countdown: float, expected: float
  ) -> None:
    parts = _observe(countdown=countdown)
    np.testing.assert_array_equal(parts['countdown'], [[expected]])

  def test_the_rest_is_handed_on(self) -> None:
    parts = _observe(heading=1.0, countdown=np.inf)
    np.testing.assert_array_equal(parts['contact'], [[1.0, 0.0]])
    np.testing.assert_array_equal(parts['next_command'], [[7.0, 8.0, 9.0]])

  @parameterized.parameters(0.01, 0.25, 0.99)
  def test_ground_ahead(self, distance: float) -> None:
    """Distance, height and gap; where the commanded heading is matters not."""
    for heading in (0.0, 2.0):
      parts = _observe(heading, distance=distance)
      np.testing.assert_allclose(
        parts['ground_ahead'], [[distance, -0.1, 0.2]], atol=1e-12
      )

  @parameterized.parameters(1.01, 5.0, np.inf)
  def test_what_is_far_ahead_looks_level(self, distance: float) -> None:
    parts = _observe(distance=distance)
    np.testing.assert_array_equal(parts['ground_ahead'], [[1.0, 0.0, 0.0]])

  def test_sight_ends_at_one_metre(self) -> None:
    parts = privileged.observe(
      position=np.zeros((1, 3)),
      reference=np.zeros((1, 3)),
      heading=np.zeros(1),
      contact=np.zeros((1, 2)),
      countdown=np.zeros(1),
      next_command=np.zeros((1, 4)),
      edge=np.ones(1),
      rise=np.full(1, 0.4),
      gap=np.full(1, 0.3),
    )
    np.testing.assert_array_equal(parts['ground_ahead'], [[1.0, 0.0, 0.0]])

  def test_worlds_are_told_apart(self) -> None:
    """Each world has its own error, heading, countdown and ground."""
    parts = privileged.observe(
      position=np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 2.0]]),
      reference=np.zeros((2, 3)),
      heading=np.array([0.0, np.pi / 2]),
      contact=np.array([[1.0, 0.0], [0.0, 0.0]]),
      countdown=np.array([np.inf, 0.3]),
      next_command=np.array([[0.0], [1.0]]),
      edge=np.array([1.5, np.inf]),
      rise=np.array([0.4, 0.0]),
      gap=np.array([0.25, 0.0]),
    )
    np.testing.assert_allclose(
      np.concatenate(list(parts.values()), axis=1),
      [
        [1.0, 0.0, 0.0, 1.0, 0.0, 1.5, 0.0, 0.5, 0.4, 0.25],
        [0.0, -1.0, 2.0, 0.0, 0.0, 0.3, 1.0, 1.0, 0.0, 0.0],
      ],
      atol=1e-12,
    )


if __name__ == '__main__':
  absltest.main()
