"""Leg angles for a trunk height: planar inverse kinematics, no engine."""

import numpy as np

_LINK = 0.22  # Metres: thigh and calf alike.
_CROUCH = np.deg2rad(54.0)  # Of the thigh from the vertical at zero angles.
CROUCH_HEIGHT = 0.5  # Metres: of the trunk over the soles at zero angles.
LOWEST, HIGHEST = 0.37, 0.67  # Metres: knees and reach set the bounds.
_HIP_PITCH, _KNEE, _ANKLE = 2, 3, 4  # Of each leg's five joints.


def standing(
  height: np.ndarray, climb: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Joints that put flat soles under the hips of an upright trunk.

  Thigh and calf are equally long, so that both lean by one angle a: the hip is
  2 l cos(a) above the ankle.

  Args:
    height: of the trunk over the soles, metres, [N]; cut to what legs can do.
    climb: vertical velocity of the trunk, m/s, [N].

  Returns:
    Joint angles, radians, and velocities, rad/s, that keep the soles where they
    are, [N, 10] each.
  """
  reach = 2 * _LINK * np.cos(_CROUCH)
  height = np.clip(height, LOWEST, HIGHEST)
  cosine = (reach + height - CROUCH_HEIGHT) / (2 * _LINK)
  lean = np.arccos(cosine)
  rate = -climb / (2 * _LINK * np.sin(lean))
  angles, velocities = np.zeros((2, len(height), 2, 5))
  for values, a in ((angles, lean - _CROUCH), (velocities, rate)):
    values[:, :, _HIP_PITCH] = a[:, None]
    values[:, :, _KNEE] = -2 * a[:, None]
    values[:, :, _ANKLE] = a[:, None]
  return angles.reshape(-1, 10), velocities.reshape(-1, 10)
