"""Pieces of tracks, and how obstacles are put together of them."""

import math
import numbers
from typing import Callable, NamedTuple, Sequence, TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:  # Composer imports slowly, and names of tracks are flags.
  from dm_control.composer import variation

Number: TypeAlias = 'float | variation.Variation'

LAST = 20.0  # Metres: length of the ground behind the last obstacle.
_MOST_PARTS = 100  # Of an obstacle: each is a body of the compiled model.
_EXACT = 1e-9  # Of a part: rounding.


class Piece(NamedTuple):
  """One stretch of a track; every size may be a dm_control Variation.

  Attributes:
    length: metres along x.
    height: of the top over the ground at the start, metres.
    gap: width of the gap before the piece, metres.
  """

  length: Number
  height: Number = 0.0
  gap: Number = 0.0


def stairs(
  distance: Number, height: float, count: int, tread: float, landing: float
) -> Sequence[Piece]:
  """Returns `count` equal rises to a landing, and as many down.

  Args:
    distance: to the first rise, metres.
    height: of the landing, metres.
    count: number of rises.
    tread: length of a stair between two rises, metres.
    landing: its length, metres.
  """
  treads = [Piece(tread, height * i / count) for i in range(1, count)]
  return (
    Piece(distance),
    *treads,
    Piece(landing, height),
    *reversed(treads),
    Piece(LAST),
  )


def joined(before: Sequence[Piece], after: Sequence[Piece]) -> Sequence[Piece]:
  """Returns a layout of two: the second begins on the last piece of the first.

  Args:
    before: its last piece becomes as long as the first of `after`.
    after: begins at a height of 0, and without a gap.
  """
  *kept, ground = before
  first, *rest = after
  return (
    *kept,
    ground._replace(length=first.length),
    *(piece._replace(height=ground.height + piece.height) for piece in rest),
  )


def extent(layout: Sequence[Piece]) -> float:
  """Returns where the last piece of a layout begins, metres."""
  return sum(p.length for p in layout[:-1]) + sum(p.gap for p in layout)


def rises(height: float, rise: float) -> int:
  """Returns the least number of equal rises, of at most `rise` metres each.

  Raises:
    ValueError: they are not 1 to 100.
  """
  return _count(height, rise, lambda parts: math.ceil(parts - _EXACT))


def fitting(length: float, part: float) -> int:
  """Returns how many parts of `part` metres fit into a length, metres.

  Raises:
    ValueError: they are not 1 to 100.
  """
  return _count(length, part, lambda parts: math.floor(parts + _EXACT))


def _count(whole: float, part: float, rounded: Callable[[float], int]) -> int:
  """Returns whole / part, rounded; raises ValueError if it is out of bounds."""
  if all(isinstance(size, numbers.Real) and size > 0 for size in (whole, part)):
    if whole / part <= _MOST_PARTS and (count := rounded(whole / part)):
      return count
  raise ValueError(
    f'{whole} m in parts of {part} m must make 1 to {_MOST_PARTS} parts.'
  )


def check_size(name: str, size: float, least: float, most: float) -> None:
  """Raises ValueError unless a size is a number within its bounds."""
  if not (isinstance(size, numbers.Real) and least <= size <= most):
    raise ValueError(f'{name} must be {least:g} to {most:g}, got {size}.')
