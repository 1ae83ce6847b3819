"""Kinematics of the legs in a plane, and lateral sway."""

import numpy as np

from dmc_multimode.utils import constants

_LINK = 0.22  # Metres: thigh and calf alike.
_CROUCH = np.deg2rad(54.0)  # Thigh from the vertical at zero angles, radians.
LOWEST, HIGHEST = 0.37, 0.67  # Metres: knees and reach set the bounds.
_HIP_PITCH, _KNEE, _ANKLE = 2, 3, 4  # Of each leg's five joints.
_HALF_WIDTH = 0.09  # Metres: of the feet from the trunk's middle.
LIFT = 0.06  # Metres: of a swinging foot in the middle of a step.


def placing(
  forward: np.ndarray,
  height: np.ndarray,
  forward_rate: np.ndarray,
  height_rate: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
  """Returns joint angles and rates for given places of flat soles.

  Thigh and calf are equally long, so that both lean by one angle a from the
  line between hip and ankle, which is 2 l cos(a) long.

  Args:
    forward: of the soles (left, right) from under their hips, metres, [N, 2].
    height: of the trunk over the soles, metres, [N, 2]; clipped to the legs'
      reach.
    forward_rate, height_rate: rates of these, m/s, [N, 2].

  Returns:
    Joint angles, radians, and velocities, rad/s, [N, 10] each.
  """
  shift = (
    2 * _LINK * np.cos(_CROUCH) - constants.STAND_HEIGHT
  )  # From trunk to hip.
  down = np.clip(height, LOWEST, HIGHEST) + shift
  length = np.hypot(forward, down)
  longest = HIGHEST + shift
  bend = np.arccos(np.minimum(length, longest) / (2 * _LINK))
  swing = np.arctan2(forward, down)
  stretch = (forward * forward_rate + down * height_rate) / length
  bend_rate = -stretch / (2 * _LINK * np.sin(bend))
  swing_rate = (down * forward_rate - forward * height_rate) / length**2
  angles, rates = np.zeros((2, len(forward), 2, 5))
  for values, a, b in (
    (angles, bend - _CROUCH, swing),
    (rates, bend_rate, swing_rate),
  ):
    values[:, :, _HIP_PITCH] = a - b
    values[:, :, _KNEE] = -2 * a
    values[:, :, _ANKLE] = a + b
  return angles.reshape(-1, 10), rates.reshape(-1, 10)


def stepping(
  speed: np.ndarray,
  swinging: np.ndarray,
  time: np.ndarray,
  length: np.ndarray,
  highest: float = LIFT,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
  """Returns places and velocities of a gait's feet during a step.

  The trunk passes the stance foot in the middle of the step, when the swing
  foot is highest.

  Args:
    speed: of the trunk, forward, m/s, [N].
    swinging: mask of the feet in the air while others stand, [N, F].
    time: since the middle of the step, seconds, [N].
    length: of the step, seconds, [N].
    highest: of a swinging foot in the middle of a step, metres.

  Returns:
    Distances of the soles ahead of their hips and heights over the ground,
    metres, and the rates of both, m/s, [N, F] each; zero for robots without a
    swing foot.
  """
  steps = swinging.any(axis=1)
  way = np.where(swinging, 1.0, -1.0) * (steps * speed)[:, None]
  phase = (np.pi * time / length)[:, None]
  lift = np.where(swinging, highest * np.cos(phase), 0.0)
  pace = (np.pi / length)[:, None]
  lift_rate = np.where(swinging, -highest * pace * np.sin(phase), 0.0)
  return way * time[:, None], lift, way, lift_rate


def sway(
  swinging: np.ndarray,
  time: np.ndarray,
  length: np.ndarray,
  half_width: float = _HALF_WIDTH,
  stand_height: float = constants.STAND_HEIGHT,
) -> np.ndarray:
  """Returns the lateral velocity of the trunk during a step, m/s, [N].

  The trunk is a linear inverted pendulum (Kajita et al. 2001) over the stance
  foot: it moves from the middle between the feet towards that foot and, by the
  end of the step, back.

  Args:
    swinging, time, length: as for `stepping`, of two feet.
    half_width: of the feet from the trunk's middle, metres.
    stand_height: of the trunk, metres.

  Returns:
    Velocity to the left, m/s, [N]; zero for robots without a swing foot.
  """
  rate = np.sqrt(constants.GRAVITY / stand_height)
  side = swinging[:, 1].astype(float) - swinging[:, 0]  # Left stance: 1.
  scale = half_width * rate / np.cosh(rate * length / 2)
  return -side * scale * np.sinh(rate * time)
