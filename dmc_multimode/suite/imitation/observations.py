"""What the policy sees: pure functions with a leading batch axis.

The flat observation is [clock (2), command (n_m), state (31)], in the order of
`layout`. Orientation and heading-dependent quantities are relative to the
commanded heading, never to the world.
"""

from typing import Mapping

import numpy as np
from scipy.spatial import transform

NUM_JOINTS = 10
_STATE_SIZES = (
  ('height', 1),
  ('orientation', 4),
  ('joints_pos', NUM_JOINTS),
  ('velocity', 3),
  ('angular_velocity', 3),
  ('joints_vel', NUM_JOINTS),
)
STATE_SIZE = sum(size for _, size in _STATE_SIZES)  # 31


def layout(command_size: int) -> tuple[tuple[str, int], ...]:
  """Returns (name, size) of every part of the flat observation, in order."""
  return (('clock', 2), ('command', command_size)) + _STATE_SIZES


def clock(phase: np.ndarray) -> np.ndarray:
  """Returns [sin 2 pi phase, cos 2 pi phase], [B, 2]."""
  angle = 2 * np.pi * phase
  return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def heading_frame(quaternion: np.ndarray, heading: np.ndarray) -> np.ndarray:
  """Expresses world orientations in frames turned by `heading` about z.

  Args:
    quaternion: (w, x, y, z), [B, 4].
    heading: radians, [B].

  Returns:
    Unit quaternions with w >= 0, [B, 4].
  """
  c, s = np.cos(heading / 2), np.sin(heading / 2)
  # Numbers that lie together are worked on much faster.
  w, x, y, z = np.ascontiguousarray(quaternion.T)
  # The product of the inverse heading (c, 0, 0, -s) and the quaternion.
  turned = np.stack(
    [c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w]
  )
  turned /= np.linalg.norm(turned, axis=0)
  turned *= np.where(turned[0] < 0, -1.0, 1.0)
  return np.ascontiguousarray(turned.T)


def finite_rows(values: np.ndarray) -> np.ndarray:
  """Whether all numbers of each row [B, N] are finite, [B]."""
  # All are, as a rule; and a sum is not finite where what it sums is not.
  with np.errstate(over='ignore', invalid='ignore'):
    total = values.sum()
  if np.isfinite(total):
    return np.ones(len(values), dtype=bool)
  return np.isfinite(values).all(axis=1)


def observe(
  qpos: np.ndarray,
  qvel: np.ndarray,
  support: np.ndarray,
  heading: np.ndarray,
  phase: np.ndarray,
  command: np.ndarray,
) -> dict[str, np.ndarray]:
  """Returns the parts of the observation by name, in the order of `layout`.

  Args:
    qpos: free joint (world position in metres, quaternion), then the joints in
      radians, [B, 17].
    qvel: free joint (world linear velocity in m/s, angular velocity in the
      trunk frame in rad/s), then the joints in rad/s, [B, 16].
    support: height of the support plane under the trunk, metres, [B].
    heading: commanded heading, radians, [B].
    phase: in [0, 1], [B].
    command: latent of the commanded mode, [B, n_m].
  """
  # A world that diverged has no orientation; identity keeps the others going.
  quaternion = np.where(
    finite_rows(qpos[:, 3:7])[:, None], qpos[:, 3:7], (1.0, 0.0, 0.0, 0.0)
  )
  trunk = transform.Rotation.from_quat(quaternion, scalar_first=True)
  return {
    'clock': clock(phase),
    'command': command,
    'height': qpos[:, 2:3] - support[:, None],
    'orientation': heading_frame(quaternion, heading),
    'joints_pos': qpos[:, 7:],
    'velocity': trunk.apply(qvel[:, :3], inverse=True),
    'angular_velocity': qvel[:, 3:6],
    'joints_vel': qvel[:, 6:],
  }


def flatten(parts: Mapping[str, np.ndarray]) -> np.ndarray:
  """Concatenates the parts to float32 vectors, [B, 33 + n_m]."""
  return np.concatenate(list(parts.values()), axis=-1, dtype=np.float32)
