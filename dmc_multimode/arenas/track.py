"""Composer arena of a pool of boxes, moved without recompilation.

Each segment is a mocap body with one box geom. Two facts make that work: a
mocap body's pose is part of the state, whereas moving a static geom leaves its
bounding volumes stale and silently disables its contacts; and a box's new size
must reach `geom_rbound`, `geom_aabb` and `bvh_aabb` too.
"""

from typing import Any, Mapping, Sequence

from dm_control import composer
from dm_control.composer import variation
import numpy as np

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib

_START = -20.0  # Metres: the ground begins this far behind the origin.
_RUN_OUT = 20.0  # Metres of ground behind the last obstacle.
_STRETCHES = 'obstacle_course'  # What an endless track is made of,
_STRETCH = 8.0  # metres each.
_SIGHT = 4.0  # Metres ahead of the robot where an endless track has obstacles.
_BEHIND = 3.0  # Metres behind it where they stay.
COLOURS = ('.70 .74 .78 1', '.62 .67 .72 1')


class Track(composer.Arena):
  """Box segments along x; the robot starts at the origin, facing +x."""

  def _build(
    self,
    layout: layouts.Layout,
    num_segments: int,
    adaptive: bool = False,
    name: str = 'track',
  ) -> None:
    """Builds the pool of boxes.

    Args:
      layout: the pieces from x = 0 on, or a function that draws them. The first
        piece also extends behind the origin, the last one is extended ahead.
      num_segments: size of the pool. Segments beyond those of the layout serve
        for the ledges of modes such as launch.
      adaptive: places a ledge, such as a block, where a commanded mode needs
        it, as in training; otherwise the track stays as drawn.
      name: of the arena.

    Raises:
      ValueError: `num_segments` is not positive, or `generate` fails.
    """
    super()._build(name=name)
    if num_segments < 1:
      raise ValueError(f'num_segments must be positive, got {num_segments}.')
    self._layout = layout
    self._fixed = not callable(layout) and not any(
      isinstance(size, variation.Variation) for p in layout for size in p
    )
    self._num_segments = num_segments
    self.adaptive = adaptive
    self._drawn: terrain_lib.Terrain | None = None
    self._add_visuals()
    self._geoms = [self._add_segment(i) for i in range(num_segments)]
    # So that the MJCF is the track's from the start.
    self.regenerate(np.random.RandomState(0))

  def _add_visuals(self) -> None:
    self._set_visual_options()
    self._texture('sky', 'skybox', [0.75, 0.84, 0.92], [0.95, 0.96, 0.98], 128)
    grid = self._texture(
      'grid', '2d', [0.92, 0.93, 0.94], [0.80, 0.83, 0.86], 256
    )
    self._material = self._mjcf_root.asset.add(
      'material', name='grid', texture=grid, texuniform=True, texrepeat=[2, 2]
    )
    self._add_light_and_camera()

  def _texture(
    self,
    name: str,
    kind: str,
    first: Sequence[float],
    second: Sequence[float],
    size: int,
  ) -> Any:
    """Adds a texture of two colours, a gradient in the sky."""
    return self._mjcf_root.asset.add(
      'texture',
      name=name,
      type=kind,
      builtin='gradient' if kind == 'skybox' else 'checker',
      rgb1=first,
      rgb2=second,
      width=size,
      height=size,
    )

  def _set_visual_options(self) -> None:
    root = self._mjcf_root
    root.visual.headlight.set_attributes(
      ambient=[0.32] * 3, diffuse=[0.22] * 3, specular=[0.05] * 3
    )
    root.visual.map.znear = 0.005

  def _add_light_and_camera(self) -> None:
    root = self._mjcf_root
    # From behind, so that walls ahead are lit; shadows come from the robot's
    # own light, because those of a fixed light end after a few metres.
    root.worldbody.add(
      'light',
      pos=[0, 0, 6],
      dir=[0.6, 0.1, -1],
      directional=True,
      castshadow=False,
      diffuse=[0.2] * 3,
      specular=[0] * 3,
    )
    root.worldbody.add(
      'camera',
      name='overview',
      pos=[1.0, -5.5, 2.0],
      xyaxes=[1, 0, 0, 0, 0.3, 1],
    )

  def _add_segment(self, index: int) -> Any:
    body = self._mjcf_root.worldbody.add(
      'body', name=f'segment_{index}', mocap=True
    )
    return body.add(
      'geom',
      name=f'segment_{index}',
      type='box',
      material=self._material,
      rgba=COLOURS[index % len(COLOURS)],
      contype=0,
      conaffinity=1,
      friction=[0.9, 0.005, 0.0001],
    )

  @property
  def is_random(self) -> bool:
    """True if draws differ."""
    return not self._fixed

  @property
  def num_segments(self) -> int:
    """Size of the pool of boxes."""
    return self._num_segments

  @property
  def ground_geoms(self) -> tuple[Any, ...]:
    """Geoms of the boxes, in the order of the segments."""
    return tuple(self._geoms)

  @property
  def terrain(self) -> terrain_lib.Terrain:
    """Current terrain, a batch of one."""
    return self._terrain

  @property
  def size(self) -> tuple[float, float]:
    """Half extents of the level ground around the origin, metres.

    Tasks such as `GoToTarget` put walkers and targets there, at a height of 0:
    what lies behind the first edge is not for that.
    """
    ahead = float(self._terrain.ends[0, 0])
    return min(-_START, ahead), terrain_lib.HALF_WIDTH

  def generate(
    self, random_state: np.random.RandomState
  ) -> terrain_lib.Terrain:
    """Draws a terrain (a batch of one) without touching any physics.

    Raises:
      ValueError: the layout has more pieces than the pool has boxes, a size of
        it is out of bounds, or a piece has no positive length, a negative gap,
        or a size that is not finite.
    """
    if self._fixed and self._drawn is not None:
      return self._drawn
    pieces = layouts.draw(self._layout, random_state)
    if not 0 < len(pieces) <= self._num_segments:
      raise ValueError(
        f'A layout of {len(pieces)} pieces does not fit {self._num_segments} '
        'segments.'
      )
    self._drawn = _place(
      [
        layouts.Piece(
          *(
            float(variation.evaluate(s, random_state=random_state))
            for s in piece
          )
        )
        for piece in pieces
      ],
      self._num_segments,
    )
    return self._drawn

  def apply(self, physics: Any, terrain: terrain_lib.Terrain) -> None:
    """Moves and resizes the boxes of a Composer physics to `terrain`."""
    self._terrain = terrain
    centres, halves = terrain_lib.boxes(terrain)
    geoms = physics.bind(self._geoms)
    bodies = physics.bind([geom.parent for geom in self._geoms])
    bodies.mocap_pos = centres[0]
    bodies.pos = centres[0]  # The poses after a reset of the physics.
    model, geom_ids = physics.model, np.asarray(geoms.element_id)
    body_ids = model.geom_bodyid[geom_ids]
    write_sizes(
      halves[0],
      geom_ids,
      model.body_bvhadr[body_ids],
      model.geom_size,
      model.geom_rbound,
      model.geom_aabb,
      model.bvh_aabb,
    )

  def regenerate(self, random_state: np.random.RandomState) -> None:
    """Draws a new terrain and puts the boxes of the MJCF there.

    As dm_control's tasks call it, before a compilation. To change the terrain
    of a physics, `apply` what `generate` returns.

    Raises:
      ValueError: as `generate`.
    """
    self._terrain = self.generate(random_state)
    centres, halves = terrain_lib.boxes(self._terrain)
    for geom, centre, half in zip(
      self._geoms, centres[0], halves[0], strict=True
    ):
      geom.parent.pos, geom.size = centre, half

  def after_compile(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Moves the boxes to the current terrain, which `apply` may have set."""
    del random_state  # A recompilation must not change the terrain.
    self.apply(physics, self._terrain)


class EndlessTrack(Track):
  """A track without an end: its layout is drawn again ahead of the robot."""

  def extended(
    self,
    terrain: terrain_lib.Terrain,
    x: float,
    random_state: np.random.RandomState,
  ) -> terrain_lib.Terrain | None:
    """Returns the terrain with obstacles farther ahead, if it needs them.

    Args:
      terrain: a batch of one, this track's.
      x: of the robot, world metres.
      random_state: source of the obstacles.

    Returns:
      The terrain, without what lies far behind; None while there is enough
      ahead.
    """
    starts, ends, tops = (field[0] for field in terrain)
    last = int(np.flatnonzero(np.isfinite(starts))[-1])
    if starts[last] - x > _SIGHT:
      return None
    kept = np.flatnonzero(ends[: last + 1] > x - _BEHIND)
    drawn = layouts.draw(self._layout, random_state)
    more = _place([layouts.Piece(*map(float, p)) for p in drawn], len(drawn))
    begin, base = starts[last], tops[last]
    result = terrain_lib.empty(1, self.num_segments)
    count = len(kept)
    total = count + len(drawn) - 1
    result.starts[0, :total] = [*starts[kept], *(begin + more.starts[0, 1:])]
    result.ends[0, :total] = [*ends[kept[:-1]], *(begin + more.ends[0])]
    result.tops[0, :total] = [*tops[kept], *(base + more.tops[0, 1:])]
    result.starts[0, 0] = min(result.starts[0, 0], x + _START)
    return result


def write_sizes(
  halves: np.ndarray,
  geom_ids: np.ndarray,
  bvh_ids: np.ndarray,
  geom_size: np.ndarray,
  geom_rbound: np.ndarray,
  geom_aabb: np.ndarray,
  bvh_aabb: np.ndarray,
) -> None:
  """Writes box sizes and every bounding volume that depends on them, in place.

  Args:
    halves: half-sizes in metres, [..., S, 3].
    geom_ids: the boxes' geoms, [S].
    bvh_ids: the leaf nodes of their bodies' bounding-volume trees, [S].
    geom_size, geom_rbound, geom_aabb, bvh_aabb: the model's fields, with the
      leading axes of `halves`.
  """
  geom_size[..., geom_ids, :] = halves
  geom_rbound[..., geom_ids] = np.linalg.norm(halves, axis=-1)
  geom_aabb[..., geom_ids, 3:] = halves
  bvh_aabb[..., bvh_ids, 3:] = halves


def _place(
  pieces: Sequence[layouts.Piece], num_segments: int
) -> terrain_lib.Terrain:
  """Returns the terrain of consecutive pieces."""
  result = terrain_lib.empty(1, num_segments)
  x = 0.0
  for i, piece in enumerate(pieces):
    if not (piece.length > 0 and piece.gap >= 0 and np.isfinite(piece).all()):
      raise ValueError(
        f'Piece {i} needs length > 0 and gap >= 0, all finite: {piece}.'
      )
    x += float(piece.gap)
    result.starts[0, i] = x if i else _START
    x += float(piece.length)
    result.ends[0, i] = x
    result.tops[0, i] = piece.height
  result.ends[0, len(pieces) - 1] += _RUN_OUT
  return result


_LEAST_SEGMENTS = 6  # Of a named track, so that small ones compile alike.


def make(
  name: str,
  num_segments: int | None = None,
  sizes: Mapping[str, layouts.Number] | None = None,
) -> Track:
  """Returns the named track.

  Only 'flat' is adaptive; the other tracks stay as drawn.

  Args:
    name: flat, gap, plateau, block, block_down, gap_block, stairs,
      stepping_stones, slope, rough, parkour, obstacle_course, gaps_and_blocks,
      or one that was registered; or several, joined by +.
    num_segments: size of the pool of boxes; by default as many as the layout
      can have pieces, and at least 6.
    sizes: of the layout; see its function in `layouts`.

  Raises:
    ValueError: the name or a size is unknown, and the message lists the known
      ones; or a size is invalid.
  """
  if num_segments is None:
    num_segments = max(_LEAST_SEGMENTS, layouts.most_pieces(name, sizes))
  return Track(layouts.make(name, sizes), num_segments, adaptive=name == 'flat')


def endless(difficulty: float = 0.5) -> EndlessTrack:
  """Returns an obstacle course that never ends.

  Args:
    difficulty: of the obstacles; see `layouts.obstacle_course`.

  Raises:
    ValueError: the difficulty is out of bounds.
  """
  sizes = {'difficulty': difficulty, 'length': _STRETCH}
  # What is left behind and ahead, and a stretch more.
  segments = 2 * layouts.most_pieces(_STRETCHES, sizes)
  return EndlessTrack(layouts.make(_STRETCHES, sizes), segments, name='endless')
