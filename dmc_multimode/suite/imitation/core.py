"""The imitation task without an engine, for a batch of worlds.

The Composer task drives one world of this, the batched environment many: both
hand in positions, velocities and contacts and get back rewards, terminations,
observations and where to put the terrain. The task means the same in both
because it is the same code.

A control step is, in this order: physics; `advance` (clock, reward and
termination against the mode that was in force); `switch` (a command that is due
re-anchors the reference); `observe` (what the next action sees).
"""

from typing import Mapping, NamedTuple

import numpy as np
from scipy.spatial import transform

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import reference as reference_lib
from dmc_multimode.suite.imitation import commands
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import obstacles
from dmc_multimode.suite.imitation import privileged
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.walkers import kinematics

_SLOWEST_START = 0.5  # Share of the reference's velocity.
_FOOT_REACH = 0.12  # Metres ahead and behind the trunk that feet may cover.
_LEAST_ALONG = 0.5  # Share of the way of a step that is along x, at least.
_STRIDE = 0.45  # Metres ahead of the trunk where a foot may stand already.
_LANDED = 0.2  # Metres past an edge where no foot is before it any more.
_ANYWHERE = np.eye(7 + observations.NUM_JOINTS)[3]  # Qpos: unturned.


class Outcome(NamedTuple):
  """What a control step led to, [B] each.

  Attributes:
    reward: in [0, 1].
    terms: the weighted terms of the reward by name.
    errors: distances from the reference.
    reference: that was in force.
    cause: index into `terminations.CAUSES`, 0 where the episode goes on.
  """

  reward: np.ndarray
  terms: dict[str, np.ndarray]
  errors: rewards.TrackingErrors
  reference: reference_lib.Reference
  cause: np.ndarray


class ImitationCore:
  """Task state of B worlds and the rules that move it."""

  def __init__(
    self,
    mode_set: mode_set_lib.ModeSet,
    config: task_config.ImitationConfig,
    num_worlds: int,
    num_segments: int,
    adaptive_terrain: bool,
    max_knots: int,
  ):
    """Allocates the state; every world must be started before use.

    Args:
      mode_set: the modes.
      config: of the task.
      num_worlds: B.
      num_segments: places for segments in each terrain.
      adaptive_terrain: whether steps are put where commanded modes need them.
      max_knots: the most commands that a schedule may hold.
    """
    self.config = config
    self.limits = config.limits
    self.tracker = commands.ModeTracker(
      mode_set, config.control_timestep, num_worlds, max_knots
    )
    self.terrain = terrain_lib.empty(num_worlds, num_segments)
    self.contact = np.zeros((num_worlds, 2))
    self.obstacle_share = config.obstacle_share_after(0)
    self._obstacles = obstacles.ObstacleSource(mode_set)
    self._adaptive = adaptive_terrain
    self._steps = [motion.ledge for motion in mode_set.motions]

  def start(
    self,
    ids: np.ndarray,
    episodes: episodes_lib.Episodes,
    terrain: terrain_lib.Terrain,
    random_state: np.random.RandomState,
  ) -> tuple[np.ndarray, np.ndarray]:
    """Begins new episodes in the worlds `ids`.

    Args:
      ids: worlds, [N].
      episodes: what they practise, N of them.
      terrain: their N terrains.
      random_state: source of the initial state's noise.

    Returns:
      Initial qpos [N, 17] and qvel [N, 16].
    """
    count = len(ids)
    on_reference = random_state.uniform(size=count) < (
      self.config.reference_starts
    )
    phase = random_state.uniform(size=count) * on_reference
    self.terrain.write(ids, terrain)
    support = terrain_lib.support_height(terrain, np.zeros(count))
    self.tracker.reset(ids, episodes.schedule, phase, support)
    self._prepare_ground(ids, episodes.initial, np.zeros(count), random_state)
    self.contact[ids] = 0.0
    return self._initial_state(ids, on_reference, random_state)

  def _initial_state(
    self,
    ids: np.ndarray,
    on_reference: np.ndarray,
    random_state: np.random.RandomState,
  ) -> tuple[np.ndarray, np.ndarray]:
    """Poses the robots of `ids` on their references, with noise."""
    config, count = self.config, len(ids)
    position, orientation, velocity = self.tracker.start_pose(ids)
    position[:, 2] += self._lifted(position[:, 0], ids)
    # Slower than the reference as well: a flight that falls short teaches what
    # a perfect one, which only a perfect take-off leads to, cannot.
    pace = random_state.uniform(_SLOWEST_START, 1.0, size=count)
    velocity *= (pace * on_reference)[:, None]
    x = position[:, 0]
    clear = terrain_lib.clearance_height(self.terrain.rows(ids), x, _FOOT_REACH)
    airborne = self.tracker.airborne(ids)
    # In flight the legs are drawn up; even so they must clear a block below.
    lowest = np.where(airborne, kinematics.CROUCH_HEIGHT, kinematics.LOWEST)
    position[:, 2] = np.maximum(position[:, 2], clear + lowest)
    swinging, time, length = self.tracker.swing_timing(ids)
    swinging &= on_reference[:, None]
    forward, lift, forward_rate, lift_rate = kinematics.stepping(
      velocity[:, 0], swinging, time, length
    )
    velocity[:, 1] += pace * kinematics.sway(swinging, time, length)
    height = np.where(
      airborne, kinematics.CROUCH_HEIGHT, position[:, 2] - clear
    )
    climb = np.where(airborne, 0.0, velocity[:, 2])
    angles, rates = kinematics.placing(
      forward,
      height[:, None] - lift,
      forward_rate,
      climb[:, None] - lift_rate,
    )
    joints = observations.NUM_JOINTS
    tilt = config.tilt_noise * random_state.standard_normal((count, 2))
    angles += config.joint_noise * random_state.standard_normal((count, joints))
    qpos = np.concatenate(
      [position, _tilted(orientation, tilt), angles], axis=1
    )
    qvel = config.velocity_noise * random_state.standard_normal(
      (count, 6 + joints)
    )
    qvel[:, :3] += velocity
    qvel[:, 6:] += rates
    return qpos, qvel

  def advance(
    self, qpos: np.ndarray, qvel: np.ndarray, contact: np.ndarray
  ) -> Outcome:
    """Moves the clocks on and judges the state that the physics reached.

    Args:
      qpos, qvel: generalised positions [B, 17] and velocities [B, 16].
      contact: feet on the ground (left, right), 0 or 1, [B, 2].
    """
    config = self.config
    self.contact[:] = contact
    self.tracker.advance()
    finite = observations.finite_rows(qpos) & observations.finite_rows(qvel)
    # A world that diverged is nowhere; anywhere keeps the others going.
    safe = qpos if finite.all() else np.where(finite[:, None], qpos, _ANYWHERE)
    reference = self.reference(safe[:, 0])
    errors = rewards.tracking_errors(
      safe[:, :3],
      observations.heading_frame(safe[:, 3:7], self.tracker.state.heading),
      contact,
      reference.position,
      reference.orientation,
      reference.contact,
      reference.has_contact,
    )
    terms = rewards.reward_terms(errors, config.gains)
    reward = np.where(finite, sum(terms.values()), 0.0)
    height = safe[:, 2] - self.support(safe[:, 0])
    cause = terminations.termination_cause(
      errors.position,
      errors.orientation,
      reward,
      height,
      finite,
      self.limits,
    )
    return Outcome(reward, terms, errors, reference, cause)

  def reference(
    self, x: np.ndarray, ids: np.ndarray | slice = slice(None)
  ) -> reference_lib.Reference:
    """Returns the references of the worlds `ids`, over the ground at `x`.

    A motion is made for level ground, or for the one step that it climbs. Where
    the ground under the trunk is another, the motion is carried up or down with
    it.

    Args:
      x: of the trunks, world metres, [N].
      ids: worlds, [N]; all by default.
    """
    reference = self.tracker.reference(ids)
    reference.position[:, 2] += self._lifted(x, ids)
    return reference

  def _lifted(
    self, x: np.ndarray, ids: np.ndarray | slice = slice(None)
  ) -> np.ndarray:
    """How much higher the ground at `x` is than motions expect it, [N]."""
    terrain = self._ground(ids)
    support = terrain_lib.support_height(terrain, x)
    return support - self.tracker.expected_support(x, ids)

  def switch(
    self, qpos: np.ndarray, random_state: np.random.RandomState
  ) -> np.ndarray:
    """Carries out the commands that are due.

    Returns:
      The worlds whose terrain changed, [N].
    """
    return self.command(*self.tracker.due(), qpos, random_state)

  def command(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    qpos: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Starts new modes where the robots are.

    Args:
      ids: worlds, [N].
      modes: their new modes, [N].
      qpos: of all worlds, [B, 17].
      random_state: of the places of steps.

    Returns:
      The worlds whose terrain changed.
    """
    if not len(ids):
      return ids
    position = qpos[ids, :3]
    support = terrain_lib.support_height(self.terrain.rows(ids), position[:, 0])
    self.tracker.command(ids, modes, position, support)
    return self._prepare_ground(ids, modes, position[:, 0], random_state)

  def _prepare_ground(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    x: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Puts what the modes that begin in `ids` call for, or are to meet, ahead.

    Args:
      ids: worlds, [N].
      modes: the modes that begin, [N].
      x: of their anchors, metres, [N].
      random_state: of places and obstacles.

    Returns:
      The worlds whose terrain changed.
    """
    changed = np.zeros(0, dtype=np.int64)
    if self._adaptive:
      changed = np.union1d(
        self._level_behind(ids, modes, x),
        self._place_steps(ids, modes, x, random_state),
      )
      if self.obstacle_share:
        changed = np.union1d(
          changed, self._place_obstacles(ids, modes, x, random_state)
        )
    for mode in np.unique(modes):
      step = self._steps[mode]
      if step is not None:
        mine = modes == mode
        start, _, _ = terrain_lib.next_segment(
          self.terrain.rows(ids[mine]), x[mine]
        )
        self.tracker.expect_step(ids[mine], start, step.height)
    return changed

  def _level_behind(
    self, ids: np.ndarray, modes: np.ndarray, x: np.ndarray
  ) -> np.ndarray:
    """Takes away the step behind those whose modes go backwards.

    Returns:
      The worlds whose terrain changed.
    """
    terrain = terrain_lib.Terrain(*(field[ids] for field in self.terrain))
    begins = terrain_lib.segment_start(terrain, x)
    has_step = begins > terrain.starts[:, 0]
    goes_back = self.tracker.bank.displacements[modes, 0] < 0
    mine = goes_back & has_step & (x - begins > _LANDED)
    self.terrain.write(
      ids[mine], terrain_lib.levelled_behind(terrain.rows(mine), x[mine])
    )
    return ids[mine]

  def _place_steps(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    x: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Puts the steps that `modes` call for where their references need them.

    Returns:
      The worlds whose terrain changed.
    """
    changed = []
    # The ground changes along x alone, a turned robot goes along its heading.
    along = np.cos(self.tracker.state.heading[ids])
    along = np.maximum(along, _LEAST_ALONG)
    for mode in np.unique(modes):
      step = self._steps[mode]
      if step is None:
        continue
      mine = modes == mode
      noise = self.config.edge_noise * random_state.uniform(-1, 1, mine.sum())
      self.terrain.write(
        ids[mine],
        terrain_lib.with_step(
          self.terrain.rows(ids[mine]),
          x[mine],
          x[mine] + step.edge * along[mine] + noise,
          step.height,
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
    """Puts obstacles ahead of some of `ids`, and level ground of the others.

    Returns:
      The worlds whose terrain changed.
    """
    step, rise, _ = terrain_lib.next_segment(self.terrain.rows(ids), x)
    made = np.array([s is not None for s in self._steps])[modes]
    # A step on which a foot may stand already must not vanish under it.
    free = made | (rise == 0) | (step - x > _STRIDE)
    ids, modes, x, made = ids[free], modes[free], x[free], made[free]
    local = self.tracker.bank.sample(modes, self.tracker.state.phase[ids])
    drawn = self._obstacles.draw(modes, local.position[:, 0], random_state)
    chosen = random_state.uniform(size=len(ids)) < self.obstacle_share
    chosen &= np.isfinite(drawn.edge)
    level = ~chosen & ~made
    self.terrain.write(
      ids[level],
      terrain_lib.levelled(self.terrain.rows(ids[level]), x[level]),
    )
    self.terrain.write(
      ids[chosen],
      terrain_lib.with_step(
        self.terrain.rows(ids[chosen]),
        x[chosen],
        x[chosen] + drawn.edge[chosen],
        drawn.height[chosen],
        drawn.gap[chosen],
      ),
    )
    return ids[level | chosen]

  def footing(
    self, reference: reference_lib.Reference, soles: np.ndarray
  ) -> np.ndarray:
    """How well the feet do what the reference's do, see `rewards`, [B].

    Args:
      reference: that is in force.
      soles: world positions of the soles (left, right), metres, [B, 2, 3].
    """
    grounds = [self.support(soles[:, foot, 0]) for foot in range(2)]
    return rewards.footing(
      self.contact,
      soles[:, :, 2] - np.stack(grounds, axis=1),
      reference.contact,
      reference.has_contact,
    )

  def _ground(self, ids: np.ndarray | slice) -> terrain_lib.Terrain:
    """Returns the terrains of the worlds `ids`, not copied for a slice."""
    return terrain_lib.Terrain(*(field[ids] for field in self.terrain))

  def support(self, x: np.ndarray) -> np.ndarray:
    """Returns the height of the support plane under every world's x, [B]."""
    return terrain_lib.support_height(self.terrain, x)

  def observe(
    self,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ids: np.ndarray | slice = slice(None),
  ) -> dict[str, np.ndarray]:
    """Returns the parts of the observation by name; see `observations`.

    Args:
      qpos, qvel: of the worlds `ids`, [N, 17] and [N, 16].
      ids: worlds, [N]; all by default.
    """
    state = self.tracker.state
    terrain = self._ground(ids)
    return observations.observe(
      qpos,
      qvel,
      terrain_lib.support_height(terrain, qpos[:, 0]),
      state.heading[ids],
      state.phase[ids],
      self.tracker.commands()[ids],
    )

  def observe_privileged(
    self, qpos: np.ndarray, ids: np.ndarray | slice = slice(None)
  ) -> Mapping[str, np.ndarray]:
    """Returns what only a value function sees; see `privileged`.

    Args:
      qpos: of the worlds `ids`, [N, 17].
      ids: worlds, [N]; all by default.
    """
    countdown, following = self.tracker.upcoming(ids)
    x = qpos[:, 0]
    terrain = self._ground(ids)
    return privileged.observe(
      qpos[:, :3],
      self.reference(x, ids).position,
      self.tracker.state.heading[ids],
      self.contact[ids],
      countdown,
      following,
      *terrain_lib.next_segment(terrain, x),
    )


def _tilted(quaternion: np.ndarray, tilt: np.ndarray) -> np.ndarray:
  """Turns orientations [N, 4] by small roll and pitch angles [N, 2]."""
  from_quat = transform.Rotation.from_quat
  noise = transform.Rotation.from_rotvec(
    np.column_stack([tilt, np.zeros(len(tilt))])
  )
  return (from_quat(quaternion, scalar_first=True) * noise).as_quat(
    scalar_first=True
  )
