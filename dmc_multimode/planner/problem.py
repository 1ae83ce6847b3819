"""Reaching a place by mode commands alone (Sec. II-E), in many worlds at once.

All worlds of a problem begin in the same state. A planner runs them from knot
to knot, each with its own mode, and may copy states between worlds. Only the
policy observes the robot: a plan is open-loop. After the last knot the robots
rest, and must then stand at the goal. Robots that have fallen are not moved any
more.
"""

from typing import NamedTuple, Sequence

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.utils import durations

_BLOCK = 16  # Batch sizes of the policy are multiples of this.
_IN_REACH = 1.0  # Metres from the goal along x that a robot may yet coast.


class Progress(NamedTuple):
  """Outcome of a knot in B worlds; see `ReachingProblem.run_knot`.

  Attributes:
    reward: of the knot, sum of exp(-|goal - p|) over its control steps, zero
      after a fall, [B].
    path: of the trunk in the world after each control step, metres, [S, B, 3].
    alive: whether the robot has never fallen, [B].
  """

  reward: np.ndarray
  path: np.ndarray
  alive: np.ndarray

  @property
  def position(self) -> np.ndarray:
    """Trunk positions at the end of the knot, world metres, [B, 3]."""
    return self.path[-1]


class Rest(NamedTuple):
  """Outcome of the rest after a plan in B worlds; see `ReachingProblem.rest`.

  Attributes:
    path: of the trunk in the world after each control step, metres, [S, B, 3].
    speed: of the trunk at the end, m/s, [B].
    alive: whether the robot has never fallen, [B].
    reached: whether it stands at the goal, [B].
  """

  path: np.ndarray
  speed: np.ndarray
  alive: np.ndarray
  reached: np.ndarray


class Trials(NamedTuple):
  """Results of whole plans in N worlds.

  Attributes:
    returns: sums of the knots' rewards, [N].
    alive: whether the robot never fell, [N].
    success: whether it stands at the goal in the end, [N].
    speed: of the trunk in the end, m/s, [N].
    paths: of the trunk after every control step, the rest's included, metres,
      [N, T, 3].
  """

  returns: np.ndarray
  alive: np.ndarray
  success: np.ndarray
  speed: np.ndarray
  paths: np.ndarray

  @property
  def position(self) -> np.ndarray:
    """Last positions of the trunk, world metres, [N, 3]."""
    return self.paths[:, -1]


def trials(knots: Sequence[Progress], rest: Rest) -> Trials:
  """Returns the results of consecutive knots and the rest after them."""
  return Trials(
    np.sum([knot.reward for knot in knots], axis=0),
    rest.alive,
    rest.reached,
    rest.speed,
    np.concatenate([*(knot.path for knot in knots), rest.path]).swapaxes(0, 1),
  )


class _Start(NamedTuple):
  """State that `ReachingProblem.reset` returns to.

  Attributes:
    worlds: their state.
    knot: index of the knot in the whole plan.
    alive: whether each robot has never fallen, [B].
  """

  worlds: dict[str, np.ndarray]
  knot: int
  alive: np.ndarray


class ReachingProblem:
  """B worlds on one track with the same initial state."""

  def __init__(
    self,
    policy: reaching.Policy,
    arena: track_lib.Track,
    config: reaching.ReachingConfig,
    num_worlds: int,
    num_threads: int = 0,
    pushes: Sequence[pushes_lib.Push] = (),
    scan_errors: sensing.ScanErrors = sensing.EXACT,
    disturbed: events_lib.TrainingEvents = events_lib.NONE,
  ):
    """Compiles the worlds and puts the robots at the start.

    Args:
      policy: turns mode commands into motion.
      arena: the track.
      config: goal and knots.
      num_worlds: B.
      num_threads: of the physics; 0 takes every core.
      pushes: applied to all robots at knots, after the mode is chosen.
      scan_errors: of the ground in `observe`.
      disturbed: of robot and ground; see `events.fixed`.

    Raises:
      ValueError: a knot is not a whole number of control steps, the goal is not
        over the track, or a push is not at a knot.
    """
    self.policy, self.config = policy, config
    self.mode_set = policy.mode_set
    self.num_worlds, self.num_modes = num_worlds, len(self.mode_set)
    self._worlds = batched_env.BatchedImitation(
      multimode_biped.make_task(
        policy.mode_set,
        episodes.ScheduledEpisodes(schedule_lib.single(np.zeros(1))),
        arena,
        reaching.task_config(policy, config, disturbed),
      ),
      num_worlds,
      config.seed,
      num_threads,
      auto_reset=False,
    )
    self._observer = sensing.Observer(policy, self._worlds.core, scan_errors)
    self._random_state = np.random.RandomState(config.seed)
    self._shift = scan_errors.draw_shift(num_worlds, self._random_state)
    self.knot_steps = reaching.knot_steps(config, self.control_timestep)
    self._pushes = pushes_lib.by_knot(
      pushes, config.knots, config.knot_duration
    )
    self.control_steps = 0
    self._goal = np.array(config.goal)
    self._observation = self._worlds.reset_alike()
    alive = np.ones(num_worlds, dtype=bool)
    self._start = _Start(self._worlds.state(), 0, alive)
    self._knot, self._alive = 0, alive.copy()
    reaching.check_goal(config.goal, self.terrain)

  @property
  def terrain(self) -> terrain_lib.Terrain:
    """Terrain of all worlds, a batch of one."""
    return self._worlds.core.terrain.rows(np.array([0]))

  @property
  def control_timestep(self) -> float:
    """Seconds of a control step."""
    return self._worlds.control_timestep

  @property
  def knots(self) -> int:
    """Number of knots of a plan from the current start."""
    return self.config.knots - self._start.knot

  @property
  def remaining(self) -> int:
    """Number of knots that are left."""
    return self.config.knots - self._knot

  @property
  def rest_mode(self) -> int:
    """Index of the mode in which robots rest."""
    return plan_lib.rest_mode(self.mode_set)

  @property
  def plan_steps(self) -> int:
    """Control steps of a plan from the current start, and of the rest."""
    return self.knots * self.knot_steps + self._rest_steps

  @property
  def _rest_steps(self) -> int:
    return int(durations.steps(plan_lib.REST, self.control_timestep))

  @property
  def alive(self) -> np.ndarray:
    """Mask of the robots that have never fallen, [B]."""
    return self._alive.copy()

  @property
  def phase(self) -> np.ndarray:
    """Phases of the running modes, in [0, 1], [B]."""
    return self._worlds.core.tracker.state.phase.copy()

  @property
  def layout(self) -> sensing.Layout:
    """(name, size) of the parts of what `observe` returns, in order."""
    return self._observer.layout

  def observe(self) -> np.ndarray:
    """Returns the observations of the `reach_*` tasks, float32 [B, D]."""
    left = np.full(self.num_worlds, self.remaining / self.config.knots)
    return self._observer.observe(
      self._observation,
      self._worlds.qpos[:, :3],
      sensing.Situation(self._goal, left, self._shift),
      self._random_state,
    )

  def obeyed(self) -> np.ndarray:
    """Returns the modes that can begin at once; see `Observer.obeyed`."""
    return self._observer.obeyed()

  def reached(self) -> np.ndarray:
    """Returns a mask of the robots that stand at the goal now, [B]."""
    worlds = self._worlds
    return self._alive & reaching.reached(
      worlds.qpos, worlds.qvel, worlds.core.terrain, self._goal
    )

  def begin_at(self, other: 'ReachingProblem', map_error: float = 0.0) -> None:
    """Makes the state of another problem the start of this one.

    Disturbances are no part of the state: who is nominal stays so.

    Args:
      other: on the same track, with the same knots; its first world is used.
      map_error: by which all edges are nearer here than there, metres.

    Raises:
      ValueError: the other problem has another task.
    """
    self._worlds.copy_state(
      np.zeros(self._worlds.num_worlds, dtype=np.int64), other._worlds
    )
    alive = np.repeat(other._alive[:1], self.num_worlds)
    state = self._worlds.state()
    for name in ('terrain/starts', 'terrain/ends'):
      state[name] -= map_error
    self._start = _Start(state, other._knot, alive)
    self.reset()

  def reset(self) -> None:
    """Resets all worlds to the start."""
    self._observation = self._worlds.restore(self._start.worlds)
    self._knot, self._alive = self._start.knot, self._start.alive.copy()

  def copy_state(self, sources: np.ndarray) -> None:
    """Continues world i from the state of world `sources[i]`.

    Args:
      sources: indices of worlds, [B].
    """
    self._observation = self._worlds.copy_state(sources)
    self._alive = self._alive[sources]

  def run_knot(self, modes: np.ndarray) -> Progress:
    """Runs all worlds for one knot.

    Args:
      modes: index of the mode that each world commands, [B].
    """
    self._observation = self._worlds.command(np.asarray(modes))
    if self._knot in self._pushes:
      self._worlds.qvel[:, :3] += self._pushes[self._knot]
      # Commanding the running modes only renews the observation.
      self._observation = self._worlds.command(np.asarray(modes))
    self._knot += 1
    reward, path = np.zeros(self.num_worlds), []
    for _ in range(self.knot_steps):
      path.append(self._step())
      worth = reaching.rewards(path[-1], self._goal)
      reward += np.where(self._alive, worth, 0.0)
    return Progress(reward, np.array(path), self._alive.copy())

  def rest(self, moved: np.ndarray | None = None) -> Rest:
    """Commands all robots to rest, after the last knot.

    Robots that are not moved have not reached the goal.

    Args:
      moved: mask of the robots that move, [B]; by default those that are not
        too far from the goal to stand there in time.
    """
    worlds = self._worlds
    resting = np.full(self.num_worlds, self.rest_mode)
    self._observation = worlds.command(resting)
    distance = np.abs(worlds.qpos[:, 0] - self._goal[0])
    near = self._alive & (distance <= _IN_REACH)
    if self.num_worlds == 1:  # A replay shows how it ends.
      near[:] = self._alive
    if moved is not None:
      near = self._alive & moved
    path = np.array([self._step(near) for _ in range(self._rest_steps)])
    return Rest(
      path,
      np.linalg.norm(worlds.qvel[:, :3], axis=1),
      self._alive.copy(),
      near & self.reached(),
    )

  def _step(self, moved: np.ndarray | None = None) -> np.ndarray:
    """Advances by a control step; returns trunk positions, metres, [B, 3].

    Robots are held where they fall: tumbling on, their states would diverge. A
      robot that diverges at once keeps its last position.

    Args:
      moved: mask of the robots that move, [B]; all by default.
    """
    moving = self._alive if moved is None else self._alive & moved
    if moving.any():
      state = self._worlds.physics.state
      before = state.copy()
      self._worlds.moving[:] = moving
      self.control_steps += int(moving.sum())
      step = self._worlds.step(self._act())
      self._observation = step.observation
      self._alive &= step.discount > 0
      diverged = ~np.isfinite(state).all(axis=1)
      state[diverged] = before[diverged]
    return self._worlds.qpos[:, :3].copy()

  def rollout(self, plans: np.ndarray) -> Trials:
    """Runs whole plans from the start, one a world.

    Args:
      plans: mode indices, [B, K].
    """
    self.reset()
    knots = [self.run_knot(modes) for modes in np.asarray(plans).T]
    return trials(knots, self.rest())

  def _act(self) -> np.ndarray:
    """Returns the policy's actions, [B, 10].

    Batches are padded to one size, so that an action does not depend on the
    number of worlds. A single world acts as in a Composer environment.
    """
    seen = self._observation
    if len(seen) == 1:
      return self.policy.select_action(seen)
    missing = -len(seen) % _BLOCK
    padded = np.concatenate([seen, np.repeat(seen[:1], missing, axis=0)])
    actions = [
      self.policy.select_action(padded[i : i + _BLOCK])
      for i in range(0, len(padded), _BLOCK)
    ]
    return np.concatenate(actions)[: len(seen)]
