"""Terrain as segments along x: pure functions with a leading batch axis.

A terrain is a row of box segments, sorted by their starts. The support
plane under a point is the top of the last segment that starts at or before it,
so that over a gap it stays that of the segment before the gap.
"""

from typing import NamedTuple

import numpy as np

BOX_THICKNESS = 1.0  # Metres from the top of a segment to its underside.
HALF_WIDTH = 4.0  # Metres to either side of the track's axis.
_PARKED = -100.0  # Height of the boxes that a terrain does not use, metres.


class Terrain(NamedTuple):
  """Segments of B terrains, S each; unused ones start at infinity.

  Attributes:
    starts: x of the starts, metres, [B, S], rising along S.
    ends: x of the ends, metres, [B, S].
    tops: heights of the upper faces, metres, [B, S].
  """

  starts: np.ndarray
  ends: np.ndarray
  tops: np.ndarray

  def rows(self, ids: np.ndarray) -> 'Terrain':
    """Returns the terrains `ids` as copies."""
    return Terrain(*(field[ids].copy() for field in self))

  def write(self, ids: np.ndarray, other: 'Terrain') -> None:
    """Overwrites the terrains `ids` in place with those of `other`."""
    for mine, theirs in zip(self, other, strict=True):
      mine[ids] = theirs


def empty(num_worlds: int, num_segments: int) -> Terrain:
  """Returns terrains without any segment."""
  shape = (num_worlds, num_segments)
  return Terrain(
    np.full(shape, np.inf), np.full(shape, np.inf), np.zeros(shape)
  )


def support_height(terrain: Terrain, x: np.ndarray) -> np.ndarray:
  """Returns the support heights at `x`, metres, [B].

  Args:
    terrain: B terrains.
    x: world positions in metres, [B].
  """
  rows = np.arange(len(terrain.starts))
  return terrain.tops[rows, _segment_under(terrain, x)]


def segment_start(terrain: Terrain, x: np.ndarray) -> np.ndarray:
  """Returns the start of the segment under `x`, [B], world metres, [B]."""
  return terrain.starts[np.arange(len(x)), _segment_under(terrain, x)]


def profile(
  terrain: Terrain, x: np.ndarray, nothing: float = -np.inf
) -> np.ndarray:
  """Returns the heights of the ground at places of each world, metres, [B, K].

  Args:
    terrain: B terrains.
    x: world positions, metres, [B, K].
    nothing: height where there is no ground, metres.
  """
  at = x[:, :, None]
  starts, ends, tops = (field[:, None] for field in terrain)
  top = np.where((starts <= at) & (at <= ends), tops, -np.inf).max(axis=-1)
  return np.where(np.isfinite(top), top, nothing)


def overhang(
  terrain: Terrain, x: np.ndarray, reach: float, even: float
) -> np.ndarray:
  """Returns how far feet hang over edges, 0, 0.5 or 1, [B, K].

  That is the share of their two ends under which the ground is higher or lower
  than under their middle, or missing.

  Args:
    terrain: B terrains.
    x: of the middle of the feet, world metres, [B, K].
    reach: from the middle to either end, metres.
    even: differences of height that do not count, metres.
  """
  places = np.concatenate([x, x - reach, x + reach], axis=1)
  heights = profile(terrain, places, nothing=_PARKED)
  middle, heel, toe = np.split(heights, 3, axis=1)
  off = [np.abs(end - middle) > even for end in (heel, toe)]
  return np.mean(off, axis=0)


def clearance_height(
  terrain: Terrain, x: np.ndarray, reach: float
) -> np.ndarray:
  """Returns the highest top within `reach` metres of `x`, metres, [B]."""
  near = (terrain.starts <= x[:, None] + reach) & (
    terrain.ends >= x[:, None] - reach
  )
  near[np.arange(len(x)), _segment_under(terrain, x)] = True
  return np.where(near, terrain.tops, -np.inf).max(axis=1)


def next_segment(
  terrain: Terrain, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns start, rise and gap of the segment after that under `x`.

  Args:
    terrain: B terrains.
    x: world positions in metres, [B].

  Returns:
    Start of the next segment, world metres, infinite if there is none, [B]; its
    height over the support plane under `x`, metres, [B]; and the width of the
    gap before it, metres, [B].
  """
  rows, under = np.arange(len(x)), _segment_under(terrain, x)
  following = np.minimum(under + 1, terrain.starts.shape[1] - 1)
  start = np.where(following > under, terrain.starts[rows, following], np.inf)
  exists = np.isfinite(start)
  rise = terrain.tops[rows, following] - terrain.tops[rows, under]
  end = np.where(exists, terrain.ends[rows, under], 0.0)
  gap = np.where(exists, start, 0.0) - end
  return start, np.where(exists, rise, 0.0), gap


def with_ledge(
  terrain: Terrain,
  x: np.ndarray,
  edge: np.ndarray,
  height: np.ndarray | float,
  gap: np.ndarray | float = 0.0,
) -> Terrain:
  """Returns terrains with a ledge ahead of `x`, and level ground behind it.

  The segment under `x` is cut before `edge`, one new segment reaches to the
  former end of the terrain, and the segments ahead are dropped. Where all
  segments are in use, the first is given up, and the second reaches back to its
  start: whoever stands on the last of at least three does not notice.

  Args:
    terrain: B terrains.
    x: positions in metres, [B].
    edge: position of the ledge in metres, [B], ahead of `x`.
    height: of the new segment over the support plane under `x`, in metres, [B]
      or one for all.
    gap: width of a gap before the ledge, metres, [B] or one for all.

  Raises:
    ValueError: all of less than three segments are in use.
  """
  rows, under = np.arange(len(x)), _segment_under(terrain, x)
  count = terrain.starts.shape[1]
  full = under + 1 >= count
  if full.any():
    if count < 3:
      raise ValueError(
        f'The track has only {count} segments, all in use; build it with more '
        'to command another mode that steps up or down.'
      )
    terrain = _without_first(terrain, full)
    under = under - full
  starts, ends, tops = (field.copy() for field in terrain)
  used = np.where(np.isinf(ends), -np.inf, ends)
  last = np.maximum(used.max(axis=1), edge + 1.0)
  behind = np.arange(starts.shape[1]) > under[:, None]
  starts[behind], ends[behind], tops[behind] = np.inf, np.inf, 0.0
  ends[rows, under] = edge - gap
  starts[rows, under + 1] = edge
  ends[rows, under + 1] = last
  tops[rows, under + 1] = tops[rows, under] + height
  return Terrain(starts, ends, tops)


def _without_first(terrain: Terrain, rows: np.ndarray) -> Terrain:
  """Gives up the first segments of the terrains `rows`, a mask, [B]."""
  starts, ends, tops = (field.copy() for field in terrain)
  for field, unused in ((starts, np.inf), (ends, np.inf), (tops, 0.0)):
    field[rows, :-1] = field[rows, 1:]
    field[rows, -1] = unused
  starts[rows, 0] = terrain.starts[rows, 0]
  return Terrain(starts, ends, tops)


def levelled(terrain: Terrain, x: np.ndarray) -> Terrain:
  """Removes segments ahead of `x`: extends the one under `x` to the end."""
  starts, ends, tops = (field.copy() for field in terrain)
  rows, under = np.arange(len(x)), _segment_under(terrain, x)
  used = np.where(np.isinf(ends), -np.inf, ends)
  ends[rows, under] = used.max(axis=1)
  behind = np.arange(starts.shape[1]) > under[:, None]
  starts[behind], ends[behind], tops[behind] = np.inf, np.inf, 0.0
  return Terrain(starts, ends, tops)


def levelled_behind(terrain: Terrain, x: np.ndarray) -> Terrain:
  """Removes segments behind `x`: extends the one under `x` to the start."""
  places = np.arange(terrain.starts.shape[1])
  kept = places + _segment_under(terrain, x)[:, None]
  beyond = kept >= len(places)
  kept = np.minimum(kept, len(places) - 1)
  starts, ends, tops = (
    np.where(beyond, unused, np.take_along_axis(field, kept, axis=1))
    for field, unused in zip(terrain, (np.inf, np.inf, 0.0), strict=True)
  )
  starts[:, 0] = terrain.starts[:, 0]
  return Terrain(starts, ends, tops)


def boxes(terrain: Terrain) -> tuple[np.ndarray, np.ndarray]:
  """Returns centres and half-sizes of the boxes, metres, both [B, S, 3]."""
  used = np.isfinite(terrain.starts)
  starts = np.where(used, terrain.starts, 0.0)
  ends = np.where(used, terrain.ends, 1.0)
  top = np.where(used, terrain.tops, _PARKED)
  zeros = np.zeros_like(starts)
  half_thickness = BOX_THICKNESS / 2
  centres = np.stack(
    [(starts + ends) / 2, zeros, top - half_thickness], axis=-1
  )
  halves = np.stack(
    [(ends - starts) / 2, zeros + HALF_WIDTH, zeros + half_thickness], axis=-1
  )
  return centres, halves


def _segment_under(terrain: Terrain, x: np.ndarray) -> np.ndarray:
  """Returns the index of the last segment that starts at or before x, [B]."""
  under = np.zeros(len(x), dtype=np.int64)
  # A loop over columns: numpy is slow at sums of short rows.
  for start in terrain.starts.T[1:]:
    under += start <= x
  return under
