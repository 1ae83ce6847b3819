"""Layouts of tracks, declared as sequences of pieces.

A new track is a function here and its row in `_FUNCTIONS`.
"""

import inspect
from typing import Callable, Mapping, NamedTuple, Sequence, TypeAlias

from dm_control.composer import variation
import numpy as np

Number: TypeAlias = float | variation.Variation


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


Layout = Sequence[Piece] | Callable[[np.random.RandomState], Sequence[Piece]]


def flat() -> Sequence[Piece]:
  """Returns level ground."""
  return (Piece(length=20.0),)


def gap(distance: Number = 0.8, width: Number = 0.45) -> Sequence[Piece]:
  """Returns a gap of `width` metres, `distance` metres ahead."""
  return (Piece(distance), Piece(20.0, gap=width))


def plateau(
  distance: Number = 0.7, length: Number = 0.6, height: Number = 0.2
) -> Sequence[Piece]:
  """Returns a plateau to climb and to descend from."""
  return (Piece(distance), Piece(length, height), Piece(20.0))


def block(distance: Number = 0.8, height: Number = 0.4) -> Sequence[Piece]:
  """Returns a block to launch onto, to the end of the track."""
  return (Piece(distance), Piece(20.0, height))


def gap_block(
  distance: Number = 0.6,
  width: Number = 0.45,
  landing: Number = 0.6,
  height: Number = 0.4,
) -> Sequence[Piece]:
  """Returns a gap, `landing` metres of ground, then a block."""
  return (Piece(distance), Piece(landing, gap=width), Piece(20.0, height))


_PARKOUR_OBSTACLES = 3
_PARKOUR_GAP = (0.2, 0.45)  # Metres.
_PARKOUR_PLATEAU = (0.05, 0.2)  # Metres.
_PARKOUR_BLOCK = (0.2, 0.4)  # Metres.
_PARKOUR_RUN = (0.6, 1.0)  # Metres between obstacles.


def parkour(random_state: np.random.RandomState) -> Sequence[Piece]:
  """Returns gaps, plateaus and blocks of random size in random order."""
  run = lambda: random_state.uniform(*_PARKOUR_RUN)
  pieces, ground = [Piece(run())], 0.0
  for kind in random_state.permutation(_PARKOUR_OBSTACLES):
    if kind == 0:
      pieces.append(Piece(run(), ground, random_state.uniform(*_PARKOUR_GAP)))
    elif kind == 1:
      rise = random_state.uniform(*_PARKOUR_PLATEAU)
      pieces += [Piece(run(), ground + rise), Piece(run(), ground)]
    else:
      ground += random_state.uniform(*_PARKOUR_BLOCK)
      pieces.append(Piece(run(), ground))
  return pieces


_FUNCTIONS: Mapping[str, Callable[..., Sequence[Piece]]] = {
  'flat': flat,
  'gap': gap,
  'plateau': plateau,
  'block': block,
  'gap_block': gap_block,
}
NAMES = (*_FUNCTIONS, 'parkour')


def make(name: str, sizes: Mapping[str, Number] | None = None) -> Layout:
  """Returns the named layout.

  Args:
    name: one of `NAMES`.
    sizes: arguments of the layout's function, metres; its defaults otherwise.

  Raises:
    ValueError: the name or a size is unknown; the message lists the known ones.
  """
  if name not in NAMES:
    raise ValueError(f'Unknown arena {name!r}; arenas are {", ".join(NAMES)}.')
  function = _FUNCTIONS.get(name)
  known = list(inspect.signature(function).parameters) if function else []
  for size in sizes or {}:
    if size not in known:
      raise ValueError(
        f'The arena {name!r} has no size {size!r}; it has '
        f'{", ".join(known) or "none"}.'
      )
  return function(**(sizes or {})) if function else parkour
