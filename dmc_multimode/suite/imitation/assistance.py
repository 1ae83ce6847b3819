"""Help with jumps onto blocks while they are being learned.

From rest, half a jump onto a block pays no more than none. So at take-off the
robot is given a share of the velocity that it should have by then: all of it
at first, so that it practises flights and landings from rest, and less and less
as long as a third of the episodes that end on a block survive.
"""

from typing import Mapping

import numpy as np

_MEMORY = 0.995  # The mean follows about the last 200 episodes.
_ENOUGH = 1 / 3  # Share of survivors above which help fades.


class TakeoffAssistance:
  """The share of a take-off's velocity that the robot is given."""

  def __init__(self, steps: int, helped: np.ndarray):
    """Begins with all of it.

    Args:
      steps: control steps over which help fades, of those in which enough
        episodes survive; 0 for no help.
      helped: which modes are helped, [M].
    """
    self._steps = steps
    self._helped = np.asarray(helped, dtype=bool)
    self._survival = 0.0
    self.share = 1.0 if steps and self._helped.any() else 0.0

  def boost(self, velocity: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Returns what to add to velocities at take-off, m/s, [N, 3].

    It points along the wanted velocity and never leads beyond it.

    Args:
      velocity: of the trunk, world m/s, [N, 3].
      wanted: what it should be, not zero, world m/s, [N, 3].
    """
    reached = np.sum(velocity * wanted, axis=1) / np.sum(wanted**2, axis=1)
    return np.clip(1 - reached, 0, self.share)[:, None] * wanted

  def update(self, final: np.ndarray, survived: np.ndarray) -> None:
    """Takes finished episodes: their last modes and whether they survived."""
    for value in survived[self._helped[final]]:
      self._survival += (1 - _MEMORY) * (value - self._survival)

  def advance(self, steps: int) -> None:
    """Goes on by so many control steps of all worlds together."""
    if self.share > 0 and self._survival > _ENOUGH:
      self.share = max(self.share - steps / self._steps, 0.0)

  def state(self) -> dict[str, np.ndarray]:
    """Returns what `restore` needs."""
    return {
      'survival': np.array(self._survival),
      'share': np.array(self.share),
    }

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """Takes over a `state`."""
    self._survival = float(state['survival'])
    self.share = float(state['share'])
