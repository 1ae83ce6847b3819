"""What the value function may see besides: pure, with a leading batch axis.

The policy knows neither where the robot is nor what comes next, yet both decide
the return: the distance from the reference is paid for in every step, and a
command that is due soon changes everything. A value function that is only used
in training may know them (an asymmetric critic, Pinto et al. 2017), which takes
their variance out of the advantages.
"""

from typing import Mapping

import numpy as np

_HORIZON = 1.5  # Seconds: commands later than this matter little.
_SIGHT = 1.0  # Metres: what is farther ahead matters little.


def layout(command_size: int) -> tuple[tuple[str, int], ...]:
  """Returns (name, size) of every part, in order."""
  return (
    ('position_error', 3),
    ('contact', 2),
    ('countdown', 1),
    ('next_command', command_size),
    ('ground_ahead', 3),
  )


def size(command_size: int) -> int:
  """Returns how many numbers there are."""
  return sum(length for _, length in layout(command_size))


def observe(
  position: np.ndarray,
  reference: np.ndarray,
  heading: np.ndarray,
  contact: np.ndarray,
  countdown: np.ndarray,
  next_command: np.ndarray,
  edge: np.ndarray,
  rise: np.ndarray,
  gap: np.ndarray,
) -> Mapping[str, np.ndarray]:
  """Returns the parts by name, in the order of `layout`.

  Args:
    position, reference: of the trunk, world metres, [B, 3].
    heading: commanded heading, radians, [B].
    contact: feet on the ground (left, right), 0 or 1, [B, 2].
    countdown: seconds until the next command, infinite without one, [B].
    next_command: its latent, [B, n_m].
    edge: where the next segment of the ground starts, world metres, infinite
      without one, [B].
    rise: its height over the ground here, metres, [B].
    gap: of nothing before it, metres, [B].
  """
  x, y, z = (position - reference).T
  c, s = np.cos(heading), np.sin(heading)
  return {
    'position_error': np.stack([c * x + s * y, c * y - s * x, z], axis=-1),
    'contact': contact,
    'countdown': np.minimum(countdown, _HORIZON)[:, None],
    'next_command': next_command,
    'ground_ahead': _ground_ahead(edge - position[:, 0], rise, gap),
  }


def _ground_ahead(
  distance: np.ndarray, rise: np.ndarray, gap: np.ndarray
) -> np.ndarray:
  """Distance, height and gap of what is near; what is far looks level."""
  near = distance < _SIGHT
  parts = np.minimum(distance, _SIGHT), near * rise, near * gap
  return np.stack(parts, axis=-1)
