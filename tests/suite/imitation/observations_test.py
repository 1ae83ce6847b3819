"""Tests of dmc_multimode.suite.observations."""

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np

from dmc_multimode.suite.imitation import observations


def _yaw(degrees: float) -> np.ndarray:
  half = np.radians(degrees) / 2
  return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


def _observe(
  qpos: np.ndarray, qvel: np.ndarray, heading: float = 0.0
) -> dict[str, np.ndarray]:
  return observations.observe(
    qpos[None],
    qvel[None],
    support=np.array([0.4]),
    heading=np.array([heading]),
    phase=np.array([0.25]),
    command=np.array([[7.0, 8.0, 9.0, 10.0]]),
  )


class PartsTest(parameterized.TestCase):
  @parameterized.parameters(
    (0.0, (0, 1)), (0.25, (1, 0)), (0.5, (0, -1)), (1.0, (0, 1))
  )
  def test_clock(self, phase: float, expected: tuple[float, float]) -> None:
    clock = observations.clock(np.array([phase]))
    np.testing.assert_allclose(clock, [expected], atol=1e-12)

  @parameterized.parameters(
    (90, 90, 0), (90, 0, 90), (0, 90, -90), (170, -170, -20)
  )
  def test_heading_frame(
    self, yaw: float, heading: float, expected: float
  ) -> None:
    turned = observations.heading_frame(
      _yaw(yaw)[None], np.radians([float(heading)])
    )
    np.testing.assert_allclose(turned[0], _yaw(expected), atol=1e-12)

  def test_heading_turns_the_axis_of_a_tilt(self) -> None:
    # Rolled by 90 degrees in the world, seen by one who faces +y: a pitch.
    c = np.sqrt(0.5)
    turned = observations.heading_frame(
      np.array([[c, c, 0.0, 0.0]]), np.array([np.pi / 2])
    )
    # (cos 45, 0, 0, -sin 45) x (c, c, 0, 0) = (.5, .5, -.5, -.5)
    np.testing.assert_allclose(turned, [[0.5, 0.5, -0.5, -0.5]])

  def test_orientation_has_one_sign_and_unit_length(self) -> None:
    turned = observations.heading_frame(-3 * _yaw(40)[None], np.zeros(1))
    np.testing.assert_allclose(turned[0], _yaw(40))

  @parameterized.parameters(
    ((0.0, 1.0), (2.0, 3.0), (True, True)),
    ((0.0, np.nan), (2.0, 3.0), (False, True)),
    ((0.0, np.inf), (-np.inf, 3.0), (False, False)),
    ((0.0, 1e308), (1e308, 3.0), (True, True)),  # Their sum alone is not.
  )
  def test_finite_rows(
    self,
    first: tuple[float, float],
    second: tuple[float, float],
    expected: tuple[bool, bool],
  ) -> None:
    finite = observations.finite_rows(np.array([first, second]))
    np.testing.assert_array_equal(finite, expected)


class ObserveTest(parameterized.TestCase):
  def setUp(self) -> None:
    super().setUp()
    self.qpos = np.concatenate([[5.0, 6.0, 0.9], _yaw(90), np.arange(10) / 10])
    self.qvel = np.concatenate(
      [[0.0, 2.0, 3.0], [0.1, 0.2, 0.3], np.arange(10) + 20.0]
    )

  def test_layout(self) -> None:
    layout = observations.layout(4)
    self.assertEqual(sum(size for _, size in layout), 37)
    self.assertEqual(observations.STATE_SIZE, 31)
    parts = _observe(self.qpos, self.qvel)
    self.assertEqual(
      [(name, part.shape[1]) for name, part in parts.items()], list(layout)
    )

  def test_flat_vector(self) -> None:
    flat = observations.flatten(_observe(self.qpos, self.qvel))
    self.assertEqual(flat.shape, (1, 37))
    self.assertEqual(flat.dtype, np.float32)
    c = np.sqrt(0.5)
    expected = np.concatenate(
      [
        [1.0, 0.0],  # Clock.
        [7.0, 8.0, 9.0, 10.0],  # Command.
        [0.5],  # Height over the support.
        [c, 0.0, 0.0, c],
        np.arange(10) / 10,
        [2.0, 0.0, 3.0],  # The trunk faces +y, and +y is where it goes.
        [0.1, 0.2, 0.3],  # Already in the trunk's frame.
        np.arange(10) + 20.0,
      ]
    )
    np.testing.assert_allclose(flat[0], expected, atol=1e-6)

  def test_heading_turns_the_orientation_alone(self) -> None:
    ahead = _observe(self.qpos, self.qvel)
    turned = _observe(self.qpos, self.qvel, heading=np.pi / 2)
    np.testing.assert_allclose(
      turned['orientation'], [[1, 0, 0, 0]], atol=1e-12
    )
    for name, part in ahead.items():
      if name != 'orientation':
        np.testing.assert_array_equal(part, turned[name])

  def test_diverged_world_raises_nothing(self) -> None:
    qpos = np.full(17, np.nan)
    parts = _observe(qpos, self.qvel)
    np.testing.assert_array_equal(parts['orientation'], [[1, 0, 0, 0]])

  def test_inputs_stay_as_they_are(self) -> None:
    qpos, qvel = self.qpos.copy(), self.qvel.copy()
    _observe(self.qpos, self.qvel, heading=1.0)
    np.testing.assert_array_equal(self.qpos, qpos)
    np.testing.assert_array_equal(self.qvel, qvel)


if __name__ == '__main__':
  absltest.main()
