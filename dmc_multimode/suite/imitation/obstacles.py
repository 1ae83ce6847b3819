"""Obstacles on the way of a mode in training: pure draws.

A policy trained on level ground, with blocks exactly where the references have
them, trips over everything else. So in a training some commands meet an
obstacle that their mode can master: a gap under its flight, a block of another
height or at another distance, a low ledge ahead of a gait. The policy does not
observe the obstacle; it learns to be robust. Lengths below are those of the
mini biped.
"""

from typing import NamedTuple

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib

_FORWARD = 0.1  # Metres a cycle: slower modes meet no obstacle.
_FOOTHOLD = 0.15  # Metres ahead of the trunk where the ground never changes.

# Of a flight over level ground, metres.
_GAP_WIDTH = (0.1, 0.65)
_GAP_OF_FLIGHT = 1.4  # Of the trunk's way in flight: the legs swing ahead.
_GAP_SHIFT = (-0.06, 0.06)
_LANDING_RISE = (-0.15, 0.1)
_LEVEL_SHARE = 0.5
# Of a jump onto a block, metres; edges and gaps are before its touch-down.
_BLOCK_EDGE = (0.2, 0.42)
_BLOCK_SHARE = (0.0, 1.0)  # Of the height that the mode is made for.
_BLOCK_GAP = (-0.2, 0.3)
# Of a gait, metres.
_LEDGE_DISTANCE = (0.15, 1.2)
_LEDGE_RISE = (-0.2, 0.04)


class Obstacles(NamedTuple):
  """The next obstacles of N robots; all in metres.

  Attributes:
    edge: distance from the anchor to the start of the next segment, [N];
      infinite for no obstacle.
    height: of that segment over the ground here, [N].
    gap: width of the gap before that segment, [N].
  """

  edge: np.ndarray
  height: np.ndarray
  gap: np.ndarray


class ObstacleSource:
  """Draws obstacles that suit the modes of a set."""

  def __init__(self, mode_set: mode_set_lib.ModeSet, size: float = 1.0):
    """Derives the obstacles that each mode of `mode_set` can master.

    Args:
      mode_set: the modes.
      size: of the robot, in those of the mini biped.
    """
    self._size = size
    motions, bank = mode_set.motions, mode_set.bank
    ledges = [motion.ledge for motion in motions]
    self._climbing = np.array([ledge is not None for ledge in ledges])
    self._rises = np.array([ledge.height if ledge else 0.0 for ledge in ledges])
    self._lengths = bank.displacements[:, 0]
    self._forward = self._lengths > _FORWARD * size
    flights = np.array([_flight(motion) for motion in motions])
    self._flights = flights.mean(axis=1)
    widest = _GAP_OF_FLIGHT * (flights[:, 1] - flights[:, 0])
    self._widest = np.clip(
      np.nan_to_num(widest), _GAP_WIDTH[0] * size, _GAP_WIDTH[1] * size
    )

  def draw(
    self,
    modes: np.ndarray,
    ahead: np.ndarray,
    random_state: np.random.RandomState,
  ) -> Obstacles:
    """Returns obstacles for N robots whose modes begin.

    Args:
      modes: their modes, [N].
      ahead: distances of the references from their anchors, metres, [N].
      random_state: source of sizes and places.
    """
    count, size = len(modes), self._size
    uniform = lambda bounds: random_state.uniform(bounds[0], bounds[1], count)
    metres = lambda bounds: size * uniform(bounds)
    gait = Obstacles(
      ahead + metres(_LEDGE_DISTANCE), metres(_LEDGE_RISE), np.zeros(count)
    )
    width = uniform((_GAP_WIDTH[0] * size, self._widest[modes]))
    cycle = np.maximum(random_state.randint(2, size=count), ahead > 0)
    middle = self._flights[modes] + cycle * self._lengths[modes]
    level = random_state.uniform(size=count) < _LEVEL_SHARE
    flight = Obstacles(
      middle + width / 2 + metres(_GAP_SHIFT),
      np.where(level, 0.0, metres(_LANDING_RISE)),
      width,
    )
    edge, share = metres(_BLOCK_EDGE), uniform(_BLOCK_SHARE)
    block = Obstacles(
      edge,
      share * self._rises[modes],
      np.clip(metres(_BLOCK_GAP), 0.0, edge - _FOOTHOLD * size),
    )
    flying = self._forward[modes] & np.isfinite(self._flights[modes])
    walking = self._forward[modes] & ~flying
    nothing = Obstacles(
      np.full(count, np.inf), np.zeros(count), np.zeros(count)
    )
    kinds = [self._climbing[modes], flying, walking]
    return Obstacles(
      *(
        np.select(kinds, [a, b, c], d)
        for a, b, c, d in zip(block, flight, gait, nothing, strict=True)
      )
    )


def _flight(motion: motion_lib.ReferenceMotion) -> tuple[float, float]:
  """Returns x of take-off and touch-down from the anchor, metres, or nan."""
  if motion.contacts is None:
    return np.nan, np.nan
  airborne = np.flatnonzero(~motion.contacts.any(axis=1))
  if not len(airborne):
    return np.nan, np.nan
  last = min(airborne[-1] + 1, len(motion.phases) - 1)
  begin, end = motion.positions[[airborne[0], last], 0]
  return float(begin), float(end)
