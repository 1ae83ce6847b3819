"""Layouts of tracks, declared as sequences of pieces.

A new track is a function here and its row in `_FIXED` or, if it draws, in
`_RANDOM`. A function's arguments are its sizes, in metres unless it says
otherwise, with their defaults; one that draws takes a generator before them.

Layouts begin on ground of height 0 and end on ground, so that one can follow
another, as the obstacles of `obstacle_course` do.

Names joined by '+', such as 'parkour+rough', are a layout, too: each draw is
one of theirs.
"""

import functools
import inspect
from typing import Callable, Iterator, Mapping, NamedTuple, Sequence

import numpy as np

from dmc_multimode.arenas import pieces

Number = pieces.Number
Piece = pieces.Piece
Layout = Sequence[Piece] | Callable[[np.random.RandomState], Sequence[Piece]]


def flat() -> Sequence[Piece]:
  """Returns level ground."""
  return (Piece(pieces.LAST),)


def gap(distance: Number = 0.8, width: Number = 0.45) -> Sequence[Piece]:
  """Returns a gap of `width` metres, `distance` metres ahead."""
  return (Piece(distance), Piece(pieces.LAST, gap=width))


def plateau(
  distance: Number = 0.7, length: Number = 0.6, height: Number = 0.2
) -> Sequence[Piece]:
  """Returns a plateau to climb and to descend from."""
  return (Piece(distance), Piece(length, height), Piece(pieces.LAST))


def block(distance: Number = 0.8, height: Number = 0.4) -> Sequence[Piece]:
  """Returns a block to launch onto, to the end of the track."""
  return (Piece(distance), Piece(pieces.LAST, height))


def block_down(distance: Number = 0.8, height: Number = 0.4) -> Sequence[Piece]:
  """Returns the end of a block to stand on, `height` metres over the rest."""
  return (Piece(distance), Piece(pieces.LAST, -height))


def gap_block(
  distance: Number = 0.6,
  width: Number = 0.45,
  landing: Number = 0.6,
  height: Number = 0.4,
) -> Sequence[Piece]:
  """Returns a gap, `landing` metres of ground, then a block."""
  return (
    Piece(distance),
    Piece(landing, gap=width),
    Piece(pieces.LAST, height),
  )


def stairs(
  distance: Number = 0.7,
  height: float = 0.3,
  rise: float = 0.1,
  tread: float = 0.25,
  landing: float = 0.4,
) -> Sequence[Piece]:
  """Returns stairs up to a landing, and the same stairs down.

  Args:
    distance: to the first rise, metres.
    height: of the landing, metres.
    rise: of a stair at most, metres: all are equal, and as few as can be.
    tread: length of a stair, metres.
    landing: its length, metres.

  Raises:
    ValueError: `height` is not 1 to 100 rises.
  """
  return pieces.stairs(
    distance, height, pieces.rises(height, rise), tread, landing
  )


def stepping_stones(
  distance: Number = 0.8,
  length: float = 1.5,
  stone: float = 0.3,
  width: float = 0.2,
) -> Sequence[Piece]:
  """Returns stones with gaps before, between and behind them.

  Args:
    distance: to the first gap, metres.
    length: of all stones, each with the gap before it, metres: as many as fit.
    stone: length of a stone, metres.
    width: of a gap, metres.

  Raises:
    ValueError: not 1 to 100 stones fit.
  """
  count = pieces.fitting(length, stone + width)
  stones = [Piece(stone, gap=width)] * count
  return (Piece(distance), *stones, Piece(pieces.LAST, gap=width))


_SLOPE_RISE = 0.04  # Metres: less than feet clear in a walk.


def slope(
  distance: Number = 0.7,
  height: float = 0.2,
  length: float = 0.8,
  landing: float = 0.4,
) -> Sequence[Piece]:
  """Returns a slope up to a landing, and the same slope down.

  Boxes of a track are horizontal: a slope is made of thin treads, with rises of
  at most 4 cm between them, and passes through the middle of each.

  Args:
    distance: to the foot of the slope, metres.
    height: of the landing, metres.
    length: of the slope along x, metres.
    landing: its length, metres.

  Raises:
    ValueError: `height` is not over 0 and at most 4 m.
  """
  count = pieces.rises(height, _SLOPE_RISE)
  tread = length / count
  return pieces.stairs(
    distance + tread / 2, height, count, tread, landing + tread
  )


def rough(
  random_state: np.random.RandomState,
  distance: Number = 0.7,
  length: float = 1.6,
  height: float = 0.03,
  tread: float = 0.2,
) -> Sequence[Piece]:
  """Returns treads of random heights.

  Args:
    random_state: source of the heights.
    distance: to the first tread, metres.
    length: of all treads, metres: as many as fit.
    height: most of a tread over or under the level ground, metres.
    tread: length of a tread, metres.

  Raises:
    ValueError: `height` is not 0 to 1 m, or not 1 to 100 treads fit.
  """
  pieces.check_size('height', height, 0.0, 1.0)
  count = pieces.fitting(length, tread)
  heights = random_state.uniform(-height, height, count)
  treads = [Piece(tread, float(top)) for top in heights]
  return (Piece(distance), *treads, Piece(pieces.LAST))


_PARKOUR_OBSTACLES = 3
_PARKOUR_GAP = (0.2, 0.45)  # Metres.
_PARKOUR_PLATEAU = (0.05, 0.2)  # Metres.
_PARKOUR_BLOCK = (0.2, 0.4)  # Metres.
_RUN = (0.6, 1.0)  # Metres between obstacles.


def parkour(random_state: np.random.RandomState) -> Sequence[Piece]:
  """Returns a gap, a plateau and a block of random size in random order."""
  run = lambda: random_state.uniform(*_RUN)
  drawn, ground = [Piece(run())], 0.0
  for kind in random_state.permutation(_PARKOUR_OBSTACLES):
    if kind == 0:
      drawn.append(Piece(run(), ground, random_state.uniform(*_PARKOUR_GAP)))
    elif kind == 1:
      rise = random_state.uniform(*_PARKOUR_PLATEAU)
      drawn += [Piece(run(), ground + rise), Piece(run(), ground)]
    else:
      ground += random_state.uniform(*_PARKOUR_BLOCK)
      drawn.append(Piece(run(), ground))
  return drawn


_LENGTHS = (2.0, 40.0)  # Metres: room for an obstacle, and not too many bodies.


class _Obstacle(NamedTuple):
  """A layout in a chain, in sizes from the easiest to the hardest.

  Attributes:
    name: of the layout.
    sizes: the easiest and the hardest, metres, where they are not its defaults.
  """

  name: str
  sizes: Mapping[str, tuple[float, float]]

  def draw(
    self, random_state: np.random.RandomState, shares: tuple[float, float]
  ) -> Sequence[Piece]:
    """Returns the pieces, with a run before the obstacle.

    Args:
      random_state: source of the run, the sizes, and what the layout draws.
      shares: bounds of the share that is drawn of the way from a size's easiest
        to its hardest.
    """
    sizes: dict[str, Number] = {'distance': random_state.uniform(*_RUN)}
    for size, (easiest, hardest) in self.sizes.items():
      share = random_state.uniform(*shares)
      sizes[size] = easiest + (hardest - easiest) * share
    return draw(make(self.name, sizes), random_state)


class _Chain(NamedTuple):
  """Obstacles that follow one another in random order.

  Attributes:
    obstacles: of which it is made.
    spacing: metres of the chain for each of its pieces, on average, at least.
  """

  obstacles: Sequence[_Obstacle]
  spacing: float

  def most_pieces(self, length: float, **sizes: Number) -> int:
    """Returns the most pieces in `length` metres; see `draw`."""
    del sizes
    pieces.check_size('length', length, *_LENGTHS)
    return 1 + int(length / self.spacing)

  def draw(
    self,
    random_state: np.random.RandomState,
    shares: tuple[float, float],
    length: float,
  ) -> Sequence[Piece]:
    """Returns rounds of all obstacles, until none finds room any more.

    Args:
      random_state: source of the order and of the obstacles.
      shares: see `_Obstacle.draw`.
      length: of the chain up to the ground behind the last obstacle, metres.

    Raises:
      ValueError: `length` is out of bounds.
    """
    most, chain, complete = self.most_pieces(length), flat(), False
    while not complete:
      complete = True
      for i in random_state.permutation(len(self.obstacles)):
        longer = pieces.joined(
          chain, self.obstacles[i].draw(random_state, shares)
        )
        if pieces.extent(longer) <= length and len(longer) <= most:
          chain, complete = longer, False
    return chain


_COURSE = _Chain(
  (
    _Obstacle('gap', {'width': (0.1, 0.5)}),
    _Obstacle('plateau', {'height': (0.05, 0.3)}),
    _Obstacle('block', {'height': (0.1, 0.45)}),
    _Obstacle('block_down', {'height': (0.1, 0.4)}),
    _Obstacle('stairs', {'height': (0.1, 0.36), 'rise': (0.05, 0.12)}),
    _Obstacle('stepping_stones', {'stone': (0.4, 0.25), 'width': (0.1, 0.25)}),
    _Obstacle('slope', {'height': (0.06, 0.24)}),
    _Obstacle('rough', {'height': (0.01, 0.05)}),
  ),
  spacing=0.22,
)
_LEAST_SHARE = 0.7  # Of the difficulty: that of the easiest obstacle.


def obstacle_course(
  random_state: np.random.RandomState,
  difficulty: float = 0.5,
  length: float = 4.0,
) -> Sequence[Piece]:
  """Returns obstacles of all kinds in random order.

  No kind comes again before every other that finds room has come. Sizes grow
  with the difficulty: gaps from 0.1 to 0.5 m, blocks from 0.1 m to 0.45 m up
  and 0.4 m down, and the others likewise.

  Args:
    random_state: source of order, sizes and distances.
    difficulty: 0 to 1, the hardest.
    length: metres that obstacles fill, as many as find room.

  Raises:
    ValueError: `difficulty` or `length` is out of bounds.
  """
  pieces.check_size('difficulty', difficulty, 0.0, 1.0)
  shares = _LEAST_SHARE * difficulty, difficulty
  return _COURSE.draw(random_state, shares, length)


_GAPS_AND_BLOCKS = _Chain(
  (
    _Obstacle('gap', {'width': (0.2, 0.35)}),
    _Obstacle('plateau', {'length': (0.3, 0.5), 'height': (0.2, 0.35)}),
  ),
  spacing=0.4,
)


def gaps_and_blocks(
  random_state: np.random.RandomState, length: float = 9.0
) -> Sequence[Piece]:
  """Returns gaps and short blocks in random order, with runs between them.

  Gaps are 0.2 to 0.35 m wide, blocks 0.3 to 0.5 m long and 0.2 to 0.35 m high.

  Args:
    random_state: source of order, sizes and distances.
    length: metres that obstacles fill, as many as find room.

  Raises:
    ValueError: `length` is out of bounds.
  """
  return _GAPS_AND_BLOCKS.draw(random_state, (0.0, 1.0), length)


class _Random(NamedTuple):
  """A layout that is drawn.

  Attributes:
    function: of a generator and the sizes.
    most_pieces: of all sizes; returns the most pieces that the function draws.
  """

  function: Callable[..., Sequence[Piece]]
  most_pieces: Callable[..., int]


_FIXED: dict[str, Callable[..., Sequence[Piece]]] = {
  'flat': flat,
  'gap': gap,
  'plateau': plateau,
  'block': block,
  'block_down': block_down,
  'gap_block': gap_block,
  'stairs': stairs,
  'stepping_stones': stepping_stones,
  'slope': slope,
}
_RANDOM: dict[str, _Random] = {
  'rough': _Random(
    rough, lambda length, tread, **_: 2 + pieces.fitting(length, tread)
  ),
  'parkour': _Random(parkour, lambda: 5),
  'obstacle_course': _Random(obstacle_course, _COURSE.most_pieces),
  'gaps_and_blocks': _Random(gaps_and_blocks, _GAPS_AND_BLOCKS.most_pieces),
}
NAMES = (*_FIXED, *_RANDOM)  # Of this module's own.
_OR = '+'  # Joins names of layouts, one of which is drawn.


def register(
  name: str,
  function: Callable[..., Sequence[Piece]],
  most_pieces: Callable[..., int] | None = None,
) -> None:
  """Makes a layout of one's own known by a name, in this process.

  Args:
    name: by which `plan`, `record` and the others find it.
    function: of its sizes, keyword arguments with defaults; of a layout that
      draws, of a generator before them.
    most_pieces: of all sizes, returns the most pieces that a layout that draws
      can have; None for a layout that does not draw.

  Raises:
    ValueError: the name is taken by another function.
  """
  known = _RANDOM[name].function if name in _RANDOM else _FIXED.get(name)
  if known not in (None, function):
    raise ValueError(f'There is an arena {name!r} already.')
  if most_pieces is None:
    _FIXED[name] = function
  else:
    _RANDOM[name] = _Random(function, most_pieces)


def make(name: str, sizes: Mapping[str, Number] | None = None) -> Layout:
  """Returns the named layout: its pieces, or a function that draws them.

  Args:
    name: one of `NAMES`, or of those of `register`; or several, joined by '+'.
    sizes: arguments of the layout's function; its defaults otherwise. Of
      several layouts, each takes those that it has.

  Raises:
    ValueError: the name or a size is unknown, and the message lists the known
      ones; or a size is invalid, which a layout that draws says when it does.
  """
  sizes = sizes or {}
  _check_sizes(name, sizes)
  made = [_make_one(part, own) for part, own in _parts(name, sizes)]
  if len(made) == 1:
    return made[0]
  return lambda random_state: draw(
    made[random_state.randint(len(made))], random_state
  )


def _make_one(name: str, sizes: Mapping[str, Number]) -> Layout:
  """Returns one layout."""
  if name in _RANDOM:
    return functools.partial(_RANDOM[name].function, **sizes)
  return _FIXED[name](**sizes)


def _parts(
  name: str, sizes: Mapping[str, Number]
) -> Iterator[tuple[str, Mapping[str, Number]]]:
  """Yields each layout of a name, and those of the sizes that it has."""
  for part in name.split(_OR):
    known = default_sizes(part)
    yield part, {size: at for size, at in sizes.items() if size in known}


def _check_sizes(name: str, sizes: Mapping[str, Number]) -> None:
  """Raises ValueError if a layout or one of its sizes is unknown."""
  known = default_sizes(name)
  for size in sizes:
    if size not in known:
      raise ValueError(
        f'The arena {name!r} has no size {size!r}; it has '
        f'{", ".join(known) or "none"}.'
      )


@functools.cache
def default_sizes(name: str) -> Mapping[str, float]:
  """Returns the sizes of a layout, in metres unless its function says else.

  Of several layouts, joined by '+', a size has the default of the first that
  has it.

  Raises:
    ValueError: the name is unknown; the message lists the known ones.
  """
  sizes: dict[str, float] = {}
  names = (*_FIXED, *_RANDOM)
  for part in name.split(_OR):
    if part not in names:
      raise ValueError(
        f'Unknown arena {part!r}; arenas are {", ".join(names)}.'
      )
    function = _RANDOM[part].function if part in _RANDOM else _FIXED[part]
    for p in inspect.signature(function).parameters.values():
      if p.default is not p.empty:
        sizes.setdefault(p.name, p.default)
  return sizes


def most_pieces(name: str, sizes: Mapping[str, Number] | None = None) -> int:
  """Returns the most pieces that the named layout can have; see `make`."""
  _check_sizes(name, sizes or {})
  return max(_most_of_one(part, own) for part, own in _parts(name, sizes or {}))


def _most_of_one(name: str, sizes: Mapping[str, Number]) -> int:
  """Returns the most pieces that one layout can have."""
  layout = _make_one(name, sizes)
  if not callable(layout):
    return len(layout)
  return _RANDOM[name].most_pieces(**{**default_sizes(name), **sizes})


def draw(
  layout: Layout, random_state: np.random.RandomState
) -> Sequence[Piece]:
  """Returns the pieces of a layout.

  Args:
    layout: pieces, or a function that draws them.
    random_state: source of what is drawn.

  Raises:
    ValueError: a size of a layout that draws is invalid.
  """
  return layout(random_state) if callable(layout) else layout
