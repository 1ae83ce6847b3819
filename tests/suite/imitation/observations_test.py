"""Tests of dmc_multimode.suite.imitation.observations."""

from typing import Any

import numpy as np
import pytest

from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import observations

_EVERY = (*observations.EXTRA_NAMES, observations.DISTURBANCES.name)
_C = np.sqrt(0.5)
_JOINTS = np.arange(10) / 10
_SCANNED = np.minimum(np.linspace(-0.6, 0.9, 16), 0.6)
_EXCHANGED = np.roll(_JOINTS, 5)  # Left and right legs.
_QPOS = np.concatenate([[5.0, 6.0, 0.9], [_C, 0.0, 0.0, _C], _JOINTS])
_QVEL = np.concatenate([[0.0, 2.0, 3.0], [0.1, 0.2, 0.3], _JOINTS + 20])


def _yaw(degrees: float) -> np.ndarray:
  half = np.radians(degrees) / 2
  return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


def _policy_sees(
  heading: float = 0.0, qpos: np.ndarray = _QPOS
) -> dict[str, np.ndarray]:
  """Of a robot that faces +y, which is where it goes, 0.5 m over its plane."""
  return observations.observe(
    observations.policy_view(
      qpos[None],
      _QVEL[None],
      support=np.array([0.4]),
      heading=np.array([heading]),
      phase=np.array([0.25]),
      command=np.array([[7.0, 8.0, 9.0, 10.0]]),
      displacement=np.array([[0.3, -0.8]]),
      clock_rate=np.array([1.5]),
      actions=np.stack([_JOINTS + 30, _JOINTS])[None],
      ground=np.linspace(-0.6, 0.9, 16)[None],
    ),
    observations.EXTRA_NAMES,
  )


def _critic_sees(
  heading: float = 0.0, countdown: float = 0.6, distance: float = 0.25
) -> dict[str, np.ndarray]:
  """Of a robot that is 0.1 m ahead, 0.2 m to the left and 0.3 m too low.

  Ahead of it, behind a gap of 0.2 m, the ground is 0.1 m lower.
  """
  return observations.observe_privileged(
    observations.CriticView(
      position=np.array([[5.1, 6.2, 0.2]]),
      reference=np.array([[5.0, 6.0, 0.5]]),
      heading=np.array([heading]),
      contact=np.array([[1.0, 0.0]]),
      countdown=np.array([countdown]),
      next_command=np.array([[7.0, 8.0, 9.0, 10.0]]),
      edge=np.array([5.1 + distance]),
      rise=np.array([-0.1]),
      gap=np.array([0.2]),
      disturbances={
        name: np.array([number])
        for name, number in zip(disturbances.nominal(1), range(8), strict=True)
      },
    ),
    _EVERY,
  )


# One row a term: its numbers, and those of the mirror image; the latents' and
# the clock's depend on the modes.
_TERMS: dict[str, tuple[Any, Any]] = {
  'clock': ((1.0, 0.0), (1.0, 0.0)),
  'command': ((7.0, 8.0, 9.0, 10.0), (7.0, 8.0, 9.0, 10.0)),
  'height': ((0.5,), (0.5,)),
  'orientation': ((_C, 0.0, 0.0, _C), (_C, 0.0, 0.0, -_C)),
  'joints_pos': (_JOINTS, _EXCHANGED),
  'velocity': ((2.0, 0.0, 3.0), (2.0, 0.0, 3.0)),
  'angular_velocity': ((0.1, 0.2, 0.3), (-0.1, 0.2, -0.3)),
  'joints_vel': (_JOINTS + 20, _EXCHANGED + 20),
  'displacement': ((0.3, -0.5), (0.3, 0.5)),  # Saturated.
  'clock_rate': ((1.5,), (1.5,)),
  'previous_action': (_JOINTS + 30, _EXCHANGED + 30),
  'ground_scan': (_SCANNED, _SCANNED),  # Saturated.
  'position_error': ((0.1, 0.2, -0.3), (0.1, -0.2, -0.3)),
  'contact': ((1.0, 0.0), (0.0, 1.0)),
  'countdown': ((0.6,), (0.6,)),
  'next_command': ((7.0, 8.0, 9.0, 10.0), (7.0, 8.0, 9.0, 10.0)),
  'ground_ahead': ((0.25, -0.1, 0.2), (0.25, -0.1, 0.2)),
  'disturbances': (range(7), range(7)),
}


def test_terms_by_hand() -> None:
  parts = {**_policy_sees(), **_critic_sees()}
  terms = observations.terms(True, _EVERY)
  assert [term.name for term in terms] == list(_TERMS)
  assert list(parts) == list(_TERMS)
  for name, (expected, _) in _TERMS.items():
    np.testing.assert_allclose(parts[name], [expected], atol=1e-12)


def test_mirror_image_by_hand() -> None:
  order, signs, latents = observations.mirror(4, True, _EVERY)
  flat = observations.flatten({**_policy_sees(), **_critic_sees()})[0]
  expected = np.concatenate([mirrored for _, mirrored in _TERMS.values()])
  np.testing.assert_allclose(signs * flat[order], expected, atol=1e-6)
  np.testing.assert_array_equal(order[order], np.arange(len(order)))
  assert latents == (2, 72)


def test_sensors_miss_some_of_the_ground() -> None:
  extra = ('ground_scan',)
  errors = observations.SensorErrors(4, extra)
  drawn = errors.draw(2000, 2.0, np.random.RandomState(0))
  scan = observations.part('ground_scan', 4, False, extra)
  missed = np.isnan(drawn)
  assert missed[:, scan].mean() == pytest.approx(0.04, abs=0.005)
  assert missed.sum() == missed[:, scan].sum()
  seen = observations.with_errors(np.full(drawn.shape, 3.0), drawn)
  assert (seen[missed] == 0).all()
  np.testing.assert_allclose(seen[~missed], 3.0 + drawn[~missed])


def test_layout() -> None:
  parts = {**_policy_sees(), **_critic_sees()}
  sizes = [(name, part.shape[1]) for name, part in parts.items()]
  extra = _EVERY
  assert tuple(sizes) == observations.layout(4, True, extra)
  assert tuple(sizes[:8]) == observations.layout(4)
  assert (observations.size(4), observations.size(11)) == (37, 44)
  assert observations.size(4, True, extra) == sum(size for _, size in sizes)
  flat = observations.flatten(_policy_sees())
  assert (flat.shape, flat.dtype) == ((1, 66), np.float32)
  for name, length in observations.layout(4, True, extra):
    place = observations.part(name, 4, True, extra)
    assert place.stop - place.start == length
  some = observations.layout(4, extra=['clock_rate'])
  assert some == (*observations.layout(4), ('clock_rate', 1))
  noise = observations.SensorErrors(4, extra).noise
  np.testing.assert_array_equal(noise[[0, 6, 11, 37]], [0, 0.01, 0.01, 0.01])
  with pytest.raises(ValueError, match="unknown observation 'lidar'; there"):
    observations.check_extra(['lidar'])


@pytest.mark.parametrize(
  ('phase', 'expected'),
  [(0.0, (0, 1)), (0.25, (1, 0)), (0.5, (0, -1)), (1.0, (0, 1))],
)
def test_clock(phase: float, expected: tuple[float, float]) -> None:
  clock = observations.clock(np.array([phase]))
  np.testing.assert_allclose(clock, [expected], atol=1e-12)


@pytest.mark.parametrize(
  ('quaternion', 'heading', 'expected'),
  [
    (_yaw(90), 90, _yaw(0)),
    (_yaw(90), 0, _yaw(90)),
    (_yaw(0), 90, _yaw(-90)),
    (_yaw(170), -170, _yaw(-20)),
    # One sign and unit length.
    (-3 * _yaw(40), 0, _yaw(40)),
    # Rolled by 90 degrees in the world, seen by one who faces +y: a pitch.
    # (cos 45, 0, 0, -sin 45) x (c, c, 0, 0) = (.5, .5, -.5, -.5)
    (np.array([_C, _C, 0.0, 0.0]), 90, (0.5, 0.5, -0.5, -0.5)),
  ],
)
def test_heading_frame(
  quaternion: np.ndarray, heading: float, expected: np.ndarray
) -> None:
  turned = observations.heading_frame(
    quaternion[None], np.radians([float(heading)])
  )
  np.testing.assert_allclose(turned[0], expected, atol=1e-12)


def test_policy_sees_the_orientation_in_the_commanded_heading() -> None:
  """And the displacement, and nothing else; who diverged is upright."""
  ahead, turned = _policy_sees(), _policy_sees(heading=np.pi / 2)
  turned_by = turned.pop('orientation')
  np.testing.assert_allclose(turned_by, [[1, 0, 0, 0]], atol=1e-12)
  displaced = turned.pop('displacement')
  np.testing.assert_allclose(displaced, [[-0.5, -0.3]], atol=1e-12)
  for name, part in turned.items():
    np.testing.assert_array_equal(part, ahead[name])
  lost = _policy_sees(qpos=np.full(17, np.nan))['orientation']
  np.testing.assert_array_equal(lost, [[1, 0, 0, 0]])


@pytest.mark.parametrize(
  ('view', 'name', 'expected'),
  [
    ({'heading': 0.0}, 'position_error', (0.1, 0.2, -0.3)),
    # Whoever faces +y has what was to the left ahead.
    ({'heading': np.pi / 2}, 'position_error', (0.2, -0.1, -0.3)),
    ({'heading': np.pi}, 'position_error', (-0.1, -0.2, -0.3)),
    # (0.1 + 0.2) / sqrt 2 and (0.2 - 0.1) / sqrt 2.
    ({'heading': np.pi / 4}, 'position_error', (0.2121320, 0.0707107, -0.3)),
    ({'countdown': 0.0}, 'countdown', (0.0,)),
    ({'countdown': 1.53}, 'countdown', (1.5,)),
    ({'countdown': np.inf}, 'countdown', (1.5,)),
    ({'distance': 0.01}, 'ground_ahead', (0.01, -0.1, 0.2)),
    ({'distance': 0.99, 'heading': 2.0}, 'ground_ahead', (0.99, -0.1, 0.2)),
    # What is far ahead looks level.
    ({'distance': 1.01}, 'ground_ahead', (1.0, 0.0, 0.0)),
    ({'distance': np.inf}, 'ground_ahead', (1.0, 0.0, 0.0)),
  ],
)
def test_critic_sees(
  view: dict[str, float], name: str, expected: tuple[float, ...]
) -> None:
  parts = _critic_sees(**view)
  np.testing.assert_allclose(parts[name], [expected], atol=1e-7)
