"""The imitation task without an engine, for a batch of worlds.

The Composer task drives one world of it, the batched environment many. Both
pass positions, velocities and contacts, and receive rewards, terminations,
observations and the terrain, so that the task is the same code in both engines.

A control step is, in this order: physics; `advance` (clock, reward and
termination against the mode that was in force); `switch` (a command that is due
re-anchors the reference); `observe` (what the next action sees).
"""

from typing import NamedTuple

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import reference as reference_lib
from dmc_multimode.suite.imitation import commands
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import motion_costs
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import resets
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.suite.imitation import terrain_events
from dmc_multimode.utils import arrays


class Outcome(NamedTuple):
  """Outcome of a control step, [B] each.

  Attributes:
    reward: in [0, 1].
    terms: the weighted terms of the reward by name.
    errors: distances from the reference, by the names of the terms.
    reference: pose of the mode that was in force.
    cause: index into `terminations.CAUSES`, 0 where the episode goes on.
  """

  reward: np.ndarray
  terms: dict[str, np.ndarray]
  errors: dict[str, np.ndarray]
  reference: reference_lib.Reference
  cause: np.ndarray


class ImitationCore:
  """Task state of B worlds, and its transitions.

  Attributes:
    config: of the task.
    tracker: commands, clocks and references.
    terrain: of every world.
    terrain_events: edits the terrain when modes begin.
    contact: feet on the ground, in the robot's order, 0 or 1, [B, F].
    actions: last joint targets, the newest first, radians, [B, H, J]; at the
      start of an episode, the joints' angles.
    distance_slack: added to the limit on the distance, metres.
    pushed: whether the episode has pushes, [B].
    recovering: seconds after a push in which robots may stray, [B]; negative
      when over.
    disturbances: values by row of `Disturbances`, [B] each.
  """

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
      adaptive_terrain: puts ledges where commanded modes need them.
      max_knots: the most commands that a schedule may hold.
    """
    mode_set = mode_set.for_feet(config.robot.num_feet)
    config.check_modes(mode_set.motions)
    self.config = config
    self.distance_slack = 0.0
    self.pushed = np.ones(num_worlds, dtype=bool)
    self.recovering = np.zeros(num_worlds)
    self.disturbances = disturbances.nominal(num_worlds)
    self.tracker = commands.ModeTracker(
      mode_set,
      config.control_timestep,
      num_worlds,
      max_knots,
      config.feasible_references,
    )
    self.terrain = terrain_lib.empty(num_worlds, num_segments)
    robot = config.robot
    self.contact = np.zeros((num_worlds, robot.num_feet))
    self.actions = np.zeros(
      (num_worlds, config.action_history, robot.num_joints)
    )
    self._anywhere = np.eye(7 + robot.num_joints)[3]  # Qpos: unturned.
    self.terrain_events = terrain_events.TerrainEvents(
      mode_set,
      self.terrain,
      self.tracker,
      config.events.edge_noise,
      config.events.obstacles.at(0),
      adaptive_terrain,
      robot.size,
    )

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
      episodes: their schedules, N of them.
      terrain: their N terrains.
      random_state: source of the initial state's noise.

    Returns:
      Initial qpos [N, 7 + J] and qvel [N, 6 + J].
    """
    count = len(ids)
    on_reference = random_state.uniform(size=count) < (
      self.config.events.reference_starts
    )
    phase = random_state.uniform(size=count) * on_reference
    self.terrain.write(ids, terrain)
    support = terrain_lib.support_height(terrain, np.zeros(count))
    self.tracker.reset(ids, episodes.schedule, phase, support)
    self.terrain_events.prepare(
      ids, episodes.initial, np.zeros(count), random_state
    )
    self.contact[ids] = 0.0
    qpos, qvel = resets.initial_state(
      self.tracker,
      self.terrain.rows(ids),
      self.config,
      ids,
      on_reference,
      random_state,
    )
    from_rest = ~on_reference
    self.tracker.match_pace(ids[from_rest], qvel[from_rest, :3])
    self.actions[ids] = qpos[:, None, 7:]
    fraction = self.config.events.push_fraction
    if fraction < 1:
      self.pushed[ids] = random_state.uniform(size=count) < fraction
    return qpos, qvel

  def act(self, actions: np.ndarray) -> None:
    """Remembers the joint targets of a control step, radians, [B, J]."""
    self.actions[:, 1:] = self.actions[:, :-1].copy()
    self.actions[:, 0] = actions

  @property
  def push_slack(self) -> np.ndarray:
    """Added to the limit on the distance after pushes, metres, [B]."""
    return self.config.events.push_slack * (self.recovering > 0)

  @property
  def push_probability(self) -> np.ndarray:
    """Probability of a push in a control step, [B]."""
    config = self.config
    rate = config.control_timestep / config.events.push_interval
    return rate * self.pushed

  def advance(
    self, qpos: np.ndarray, qvel: np.ndarray, contact: np.ndarray
  ) -> Outcome:
    """Advances the clocks; returns the outcome of the state reached.

    Args:
      qpos, qvel: generalised positions [B, 7 + J] and velocities [B, 6 + J].
      contact: feet on the ground, in the robot's order, 0 or 1, [B, F].
    """
    config = self.config
    self.contact[:] = contact
    self.tracker.advance()
    finite = arrays.finite_rows(qpos) & arrays.finite_rows(qvel)
    # A world that diverged has no position; any finite one keeps the others
    # going.
    safe = (
      qpos if finite.all() else np.where(finite[:, None], qpos, self._anywhere)
    )
    reference = self.reference(safe[:, 0])
    orientation = observations.heading_frame(
      safe[:, 3:7], self.tracker.state.heading
    )
    errors = rewards.tracking_errors(
      rewards.RobotState(safe, qvel, orientation, contact), reference
    )
    terms = rewards.reward_terms(errors, config.gains)
    reward = np.where(finite, sum(terms.values()), 0.0)
    height = safe[:, 2] - self.support(safe[:, 0])
    cause = terminations.termination_cause(
      errors['position'],
      errors['orientation'],
      reward,
      height,
      finite,
      config.limits,
      self.distance_slack + self.push_slack,
    )
    return Outcome(reward, terms, errors, reference, cause)

  def reference(self, x: np.ndarray) -> reference_lib.Reference:
    """Returns the references, shifted with the ground.

    A motion is shifted vertically by the difference between the support height
    at `x` and the height that the motion expects there.

    Args:
      x: of the trunks, world metres, [B].
    """
    reference = self.tracker.reference()
    reference.position[:, 2] += resets.lift_of_ground(
      self.tracker, self.terrain, x
    )
    return reference

  def switch(
    self,
    qpos: np.ndarray,
    qvel: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Carries out the commands that are due; see `command`.

    Returns:
      The worlds whose terrain changed, [N].
    """
    self.tracker.take_due_commands()
    return self._obey(qpos, qvel, random_state)

  def command(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Commands modes; they start where the robots are.

    With `commands_from_ground`, a command that no robot can obey is held until
    this one can; see `ModeTracker.can_obey`. A later command replaces it.

    Args:
      ids: worlds, [N].
      modes: their new modes, [N].
      qpos, qvel: of all worlds, [B, 7 + J] and [B, 6 + J].
      random_state: source of the places of ledges and obstacles.

    Returns:
      The worlds whose terrain changed.
    """
    self.tracker.state.pending[ids] = modes
    return self._obey(qpos, qvel, random_state)

  def _obey(
    self,
    qpos: np.ndarray,
    qvel: np.ndarray,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Starts the pending modes that can be obeyed; see `command`."""
    ids, modes = self.tracker.pop_pending(self.config.commands_from_ground)
    if not len(ids):
      return ids
    position = qpos[ids, :3]
    support = terrain_lib.support_height(self.terrain.rows(ids), position[:, 0])
    self.tracker.command(ids, modes, position, support, qvel[ids, :3])
    return self.terrain_events.prepare(ids, modes, position[:, 0], random_state)

  def contact_schedule_agreement(
    self, reference: reference_lib.Reference, soles: np.ndarray
  ) -> np.ndarray:
    """Returns `events.contact_schedule_agreement` of the feet, [B].

    Where the reference stands on all feet, a robot that recovers from a push
    may step, and agrees whatever it does.

    Args:
      reference: pose of the mode that is in force.
      soles: world positions of the soles, metres, [B, F, 3].
    """
    swinging, time, length = self.tracker.swing_timing()
    progress = np.where(length > 0, 0.5 + time / np.maximum(length, 1e-9), 0.5)
    stands = (reference.contact > 0).all(axis=1)
    return events.contact_schedule_agreement(
      self.contact,
      self.clearance(soles) / self.config.robot.size,
      reference.contact,
      reference.has_contact & ~(stands & (self.recovering > 0)),
      np.where(swinging, progress[:, None], np.nan),
    )

  def clearance(self, soles: np.ndarray) -> np.ndarray:
    """Returns heights of the soles over the ground below, metres, [B, F].

    Args:
      soles: world positions of the soles, metres, [B, F, 3].
    """
    grounds = [
      self.support(soles[:, foot, 0]) for foot in range(soles.shape[1])
    ]
    return soles[:, :, 2] - np.stack(grounds, axis=1)

  def motion(
    self,
    joints: np.ndarray,
    limits: np.ndarray,
    soles: np.ndarray,
    before: np.ndarray,
  ) -> motion_costs.Motion:
    """Returns the motion that costs are computed from.

    Args:
      joints: angles, radians, [B, J].
      limits: of the joints, radians, [J, 2].
      soles: world positions of the soles, metres, [B, F, 3].
      before: likewise, a control step earlier; infinite for none.
    """
    state, bank = self.tracker.state, self.tracker.bank
    rise = np.where(np.isinf(before), 0.0, soles - before)[:, :, 2]
    robot = self.config.robot
    # Costs are of lengths and speeds of the mini biped.
    size, derived = robot.size, robot.derived
    apart = np.mean(
      [
        soles[:, left] - soles[:, right] for left, right in derived.mirror.pairs
      ],
      axis=0,
    )
    return motion_costs.Motion(
      self.actions,
      joints,
      limits,
      self.contact,
      self.clearance(soles) / size,
      terrain_lib.overhang(
        self.terrain,
        soles[:, :, 0],
        motion_costs.HALF_FOOT * size,
        motion_costs.EVEN * size,
      ),
      rise / self.config.control_timestep / np.sqrt(size),
      observations.in_heading(apart, state.heading)[:, 1] / size,
      derived.stance_width / size,
      bank.steady[state.mode],
      ~(bank.flies | (bank.takeoffs > 0))[state.mode],
      bank.straight[state.mode],
    )

  def _ground(self, ids: np.ndarray | slice) -> terrain_lib.Terrain:
    """Returns the terrains of the worlds `ids`; a view if `ids` is a slice."""
    return terrain_lib.Terrain(*(field[ids] for field in self.terrain))

  def support(self, x: np.ndarray) -> np.ndarray:
    """Returns the support heights at `x`, one position a world, metres, [B]."""
    return terrain_lib.support_height(self.terrain, x)

  def observe(
    self,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ids: np.ndarray | slice = slice(None),
    share: float = 0.0,
    privileged: bool = False,
  ) -> dict[str, np.ndarray]:
    """Returns the parts of the observation by name; see `observations`.

    Args:
      qpos, qvel: of the worlds `ids`, [N, 7 + J] and [N, 6 + J].
      ids: worlds, [N]; all by default.
      share: of a control step that has passed since the last `advance`.
      privileged: appends the critic's parts, of the last `advance`.
    """
    state, extra = self.tracker.state, self.config.extra_observations
    phase, heading = state.phase, state.heading
    if share:
      phase, heading = self.tracker.ahead(share)
    terrain = self._ground(ids)
    support = terrain_lib.support_height(terrain, qpos[:, 0])
    displacement = np.zeros((len(qpos), 2))
    if 'displacement' in extra or privileged:
      reference = self.tracker.reference(ids).position
      displacement = qpos[:, :2] - reference[:, :2]
      displacement += disturbances.odometry_error(
        qpos[:, :2] - state.anchor[ids, :2],
        self.disturbances['odometry_drift'][ids],
      )
    parts = observations.observe(
      observations.policy_view(
        qpos,
        qvel,
        support,
        heading[ids],
        phase[ids],
        self.tracker.commands()[ids],
        displacement,
        state.clock_rate[ids],
        self.actions[ids],
        self._scan(
          terrain,
          qpos[:, 0] - observations.SCAN_AGE * qvel[:, 0],
          heading[ids],
          support,
        )
        if 'ground_scan' in extra
        else np.zeros((len(qpos), 0)),
      ),
      extra,
    )
    if privileged:
      parts |= self._observe_privileged(qpos, reference, ids)
    return parts

  def _observe_privileged(
    self,
    qpos: np.ndarray,
    reference: np.ndarray,
    ids: np.ndarray | slice,
  ) -> dict[str, np.ndarray]:
    """Returns the critic's parts of the observation by name.

    Args:
      qpos: of the worlds `ids`, [N, 7 + J].
      reference: positions on level ground, world metres, [N, 3].
      ids: worlds, [N].
    """
    terrain, x = self._ground(ids), qpos[:, 0]
    reference[:, 2] += resets.lift_of_ground(self.tracker, terrain, x, ids)
    countdown, following = self.tracker.upcoming(ids)
    return observations.observe_privileged(
      observations.CriticView(
        qpos[:, :3],
        reference,
        self.tracker.state.heading[ids],
        self.contact[ids],
        countdown,
        following,
        *terrain_lib.next_segment(terrain, x),
        {name: value[ids] for name, value in self.disturbances.items()},
      ),
      self.config.observed_terms,
    )

  def _scan(
    self,
    terrain: terrain_lib.Terrain,
    x: np.ndarray,
    heading: np.ndarray,
    support: np.ndarray,
  ) -> np.ndarray:
    """Returns the heights at `observations.SCAN` of N worlds, [N, 16]."""
    # The ground changes along x alone.
    places = np.cos(heading)[:, None] * np.array(observations.SCAN)
    heights = terrain_lib.profile(terrain, x[:, None] + places)
    return heights - support[:, None]
