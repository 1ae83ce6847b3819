"""Edits of the ground when modes begin: ledges, obstacles, levelling.

A mode such as launch is made for a ledge, a rise of the ground at a distance;
on adaptive terrain the ledge is placed where the mode needs it. In a training
some commands also meet an obstacle, see `obstacles`.
"""

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.suite.imitation import commands
from dmc_multimode.suite.imitation import obstacles

_LEAST_ALONG = 0.5  # Share of the way to a ledge that is along x, at least.
# Lengths of the mini biped.
_STRIDE = 0.45  # Metres ahead of the trunk where a foot may stand already.
_LANDED = 0.2  # Metres past an edge at which both feet are past it.


class TerrainEvents:
  """Prepares the ground of B worlds for the modes that begin in them.

  Attributes:
    obstacle_share: share of the commands that meet an obstacle, in [0, 1].
  """

  def __init__(
    self,
    mode_set: mode_set_lib.ModeSet,
    terrain: terrain_lib.Terrain,
    tracker: commands.ModeTracker,
    edge_noise: float,
    obstacle_share: float,
    adaptive: bool,
    size: float = 1.0,
  ):
    """Keeps the terrain and tracker to edit, and the ledges of the modes.

    Args:
      mode_set: the modes.
      terrain: of all worlds; it is edited in place.
      tracker: of all worlds; its expected ledges are set.
      edge_noise: half-width of the noise on the place of a ledge, metres.
      obstacle_share: initial share of the commands that meet an obstacle.
      adaptive: puts ledges where commanded modes need them; otherwise the
        terrain stays as it is.
      size: of the robot, in those of the mini biped.
    """
    self.obstacle_share = obstacle_share
    self._terrain, self._tracker = terrain, tracker
    self._edge_noise, self._adaptive = edge_noise, adaptive
    self._obstacles = obstacles.ObstacleSource(mode_set, size)
    self._stride, self._landed = _STRIDE * size, _LANDED * size
    self._ledges = [motion.ledge for motion in mode_set.motions]

  def prepare(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    x: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Edits the ground of `ids`: ledges that modes need, and obstacles.

    Args:
      ids: worlds, [N].
      modes: the modes that begin, [N].
      x: of their anchors, metres, [N].
      random_state: source of noise and obstacles.

    Returns:
      The worlds whose terrain changed.
    """
    changed = np.zeros(0, dtype=np.int64)
    if self._adaptive:
      changed = np.union1d(
        self._level_behind(ids, modes, x),
        self._place_ledges(ids, modes, x, random_state),
      )
      if self.obstacle_share:
        changed = np.union1d(
          changed, self._place_obstacles(ids, modes, x, random_state)
        )
    for mode in np.unique(modes):
      ledge = self._ledges[mode]
      if ledge is not None:
        mine = modes == mode
        start, _, _ = terrain_lib.next_segment(
          self._terrain.rows(ids[mine]), x[mine]
        )
        self._tracker.expect_ledge(ids[mine], start, ledge.height)
    return changed

  def _level_behind(
    self, ids: np.ndarray, modes: np.ndarray, x: np.ndarray
  ) -> np.ndarray:
    """Levels the ground behind robots whose modes go backwards.

    Returns:
      The worlds whose terrain changed.
    """
    goes_back = self._tracker.bank.displacements[modes, 0] < 0
    ids, x = ids[goes_back], x[goes_back]
    terrain = self._terrain.rows(ids)
    begins = terrain_lib.segment_start(terrain, x)
    has_ledge = begins > terrain.starts[:, 0]
    mine = has_ledge & (x - begins > self._landed)
    if mine.any():
      self._terrain.write(
        ids[mine], terrain_lib.levelled_behind(terrain.rows(mine), x[mine])
      )
    return ids[mine]

  def _place_ledges(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    x: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Places the ledges of `modes` where their references have them.

    Returns:
      The worlds whose terrain changed.
    """
    changed = []
    # The ground changes along x alone, a turned robot goes along its heading.
    along = np.cos(self._tracker.state.heading[ids])
    along = np.maximum(along, _LEAST_ALONG)
    for mode in np.unique(modes):
      ledge = self._ledges[mode]
      if ledge is None:
        continue
      mine = modes == mode
      noise = self._edge_noise * random_state.uniform(-1, 1, mine.sum())
      self._terrain.write(
        ids[mine],
        terrain_lib.with_ledge(
          self._terrain.rows(ids[mine]),
          x[mine],
          x[mine] + ledge.edge * along[mine] + noise,
          ledge.height,
        ),
      )
      changed.append(ids[mine])
    return np.concatenate(changed) if changed else np.zeros(0, dtype=np.int64)

  def _place_obstacles(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    x: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Places obstacles ahead of some of `ids`, level ground ahead of others.

    Returns:
      The worlds whose terrain changed.
    """
    terrain = self._terrain
    edge, rise, _ = terrain_lib.next_segment(terrain.rows(ids), x)
    made = np.array([ledge is not None for ledge in self._ledges])[modes]
    # A ledge on which a foot may stand already must not vanish under it.
    free = made | (rise == 0) | (edge - x > self._stride)
    ids, modes, x, made = ids[free], modes[free], x[free], made[free]
    local = self._tracker.bank.sample(modes, self._tracker.state.phase[ids])
    drawn = self._obstacles.draw(modes, local.position[:, 0], random_state)
    chosen = random_state.uniform(size=len(ids)) < self.obstacle_share
    chosen &= np.isfinite(drawn.edge)
    level = ~chosen & ~made
    terrain.write(
      ids[level], terrain_lib.levelled(terrain.rows(ids[level]), x[level])
    )
    terrain.write(
      ids[chosen],
      terrain_lib.with_ledge(
        terrain.rows(ids[chosen]),
        x[chosen],
        x[chosen] + drawn.edge[chosen],
        drawn.height[chosen],
        drawn.gap[chosen],
      ),
    )
    return ids[level | chosen]
