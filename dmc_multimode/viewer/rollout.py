"""Roll-outs of a policy in a Composer environment."""

import collections
import dataclasses
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

from dm_control import composer
import numpy as np
import pydantic

from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import durations

_SPEED_WINDOW = 0.3  # Seconds over which speed is averaged.


class Step(NamedTuple):
  """State of the robot after a control step.

  Attributes:
    command: index into the schedule of the command that was in force.
    time: seconds since the start.
    mode: name of the mode that runs after the step.
    position: of the trunk in the world, metres, [3].
    height: of the trunk over its support plane, metres.
    rise: of the trunk over the support plane at the mode's start, metres.
    speed: horizontal, mean over the last 0.3 s, m/s.
    reward: in [0, 1]; NaN of a reference alone.
    cause: termination cause of the step, or 'none'; empty for a reference
      alone.
  """

  command: int
  time: float
  mode: str
  position: np.ndarray
  height: float
  rise: float
  speed: float
  reward: float
  cause: str

  @property
  def is_reference(self) -> bool:
    """True if a reference was carried, and no robot moved."""
    return not self.cause


class Robot:
  """A policy in a Composer environment of its own, one step at a time.

  Attributes:
    task: of the environment.
    over: whether the episode has ended.
  """

  def __init__(
    self,
    policy: pretrained.Policy,
    task: composer_task.Imitation,
    limits: terminations.TerminationLimits,
    seed: int,
  ):
    """Takes the task; `start` compiles it.

    Args:
      policy: to roll out.
      task: made for that policy.
      limits: for `Step.cause`; the task's own limits end the episode.
      seed: of the terrain and of the initial state's noise, at a reset.
    """
    self.task, self.over = task, False
    self._policy, self._limits, self._seed = policy, limits, seed

  def start(self) -> Any:
    """Compiles the model and resets it; returns the physics."""
    self._environment = composer.Environment(
      self.task,
      recompile_mjcf_every_episode=False,
      raise_exception_on_physics_error=False,
    )
    self.reset()
    return self.physics

  @property
  def environment(self) -> composer.Environment:
    """The Composer environment that `start` compiled."""
    return self._environment

  @property
  def physics(self) -> Any:
    """Physics of the environment, a weak proxy."""
    return self._environment.physics

  @property
  def position(self) -> np.ndarray:
    """Position of the trunk, world metres, [3]."""
    return self.physics.data.qpos[:3].copy()

  def reset(self, anew: bool = False) -> None:
    """Begins the episode of the seed, always the same; or, anew, the next."""
    if not anew:
      self._environment.random_state.seed(self._seed)
    self._environment.reset()
    self.over = False
    period = self.task.config.control_timestep
    window = max(1, int(durations.steps(_SPEED_WINDOW, period)))
    self._path = collections.deque([self.position], window + 1)

  def command(self, mode: int) -> None:
    """Commands a mode by its index; a running one continues.

    Raises:
      ValueError: the mode needs a ledge, and the track has no segment left.
    """
    self.task.command(self.physics, mode, self._environment.random_state)

  def push(self, velocity: Sequence[float] | np.ndarray) -> None:
    """Adds to the velocity of the trunk, world m/s (x, y, z)."""
    self.physics.data.qvel[:3] += velocity
    self.physics.forward()
    # Commanding the running mode only renews the observation.
    self.command(int(self.task.core.tracker.state.mode[0]))

  def set_events(self, changed: events.TrainingEvents) -> None:
    """Replaces disturbances, pushes and sensor noise from now on.

    Raises:
      ValueError: see `composer_task.Imitation.set_events`.
    """
    self.task.set_events(self.physics, changed, self._environment.random_state)

  def action(self) -> np.ndarray:
    """Returns the policy's joint targets for the current observation, [10]."""
    return self._policy.actor.select_action(self.task.observation)

  def here(self) -> Step:
    """Returns the state after a reset as a `Step`."""
    task, position = self.task, self.position
    return Step(
      command=0,
      time=0.0,
      mode=task.mode,
      position=position,
      height=float(position[2] - task.core.support(position[:1])[0]),
      rise=float(position[2] - task.core.tracker.state.anchor[0, 2]),
      speed=0.0,
      reward=0.0,
      cause=terminations.CAUSES[0],
    )

  def step(self) -> Step:
    """Advances by a control step; after divergence the state is not finite."""
    state = self.task.core.tracker.state
    command, floor = int(state.knot[0]), float(state.anchor[0, 2])
    self.over = self._environment.step(self.action()).last()
    self._path.append(self.position)
    return self._step(command, floor)

  def _step(self, command: int, floor: float) -> Step:
    """Returns the `Step` of the last control step."""
    task, outcome, path = self.task, self.task.outcome, self._path
    assert outcome is not None
    elapsed = (len(path) - 1) * task.config.control_timestep
    position = path[-1]
    height = position[2] - task.core.support(position[:1])
    cause = terminations.termination_cause(
      outcome.errors['position'],
      outcome.errors['orientation'],
      outcome.reward,
      height,
      np.array([np.isfinite(position).all()]),
      self._limits,
    )
    return Step(
      command=command,
      time=int(task.core.tracker.state.step[0]) * task.config.control_timestep,
      mode=task.mode,
      position=position,
      height=float(height[0]),
      rise=float(position[2] - floor),
      speed=float(np.linalg.norm((position - path[0])[:2]) / elapsed),
      reward=float(outcome.reward[0]),
      cause=terminations.CAUSES[cause[0]],
    )


@config_lib.dataclass
class RolloutConfig:
  """A schedule on a track, and the conditions of its roll-out.

  Attributes:
    modes: names of the commanded modes, or blends of them; see
      `mode_set.with_blends`.
    durations: of the commands, seconds.
    arena: name of a track.
    sizes: of the track, metres, where they are not its defaults.
    clock_rate: rate of the phase clock, 1 being the references' own.
    seed: of the terrain and of the initial state's noise.
    pushes: that the robot meets.
    imitation: whether losing the reference is a failure; in a plan, only a fall
      is.
    physics_timestep: seconds; `constants.PHYSICS_TIMESTEP` if None.
    terminate: ends the roll-out at a termination of the episode.
  """

  modes: tuple[str, ...]
  durations: tuple[config_lib.Positive, ...]
  arena: str = 'flat'
  sizes: Mapping[str, float] = dataclasses.field(default_factory=dict)
  clock_rate: config_lib.Positive = 1.0
  seed: config_lib.Count = 0
  pushes: tuple[pydantic.InstanceOf[pushes_lib.Push], ...] = ()
  imitation: bool = True
  physics_timestep: config_lib.Positive | None = None
  terminate: bool = False


class Rollout:
  """Roll-out of a schedule; `start`, then `steps`, once."""

  _robot_type: type[Robot] = Robot

  def __init__(self, policy: pretrained.Policy, config: RolloutConfig):
    """Builds the environment.

    Raises:
      ValueError: the schedule, the arena or a number is invalid, or the policy
        does not know a mode.
    """
    mode_set = mode_set_lib.with_blends(policy.mode_set, config.modes)
    self.schedule = schedule_lib.from_names(
      mode_set, config.modes, config.durations, config.clock_rate
    )
    task = _task_config(policy.config, config)
    self._config = config
    self.task = multimode_biped.make_task(
      mode_set,
      episodes=episodes.ScheduledEpisodes(self.schedule),
      arena=_make_arena(config),
      config=task,
    )
    limits = policy.config.limits
    if not config.imitation:
      limits = terminations.falls_alone(limits)
    self._robot = self._robot_type(policy, self.task, limits, config.seed)

  @property
  def num_steps(self) -> int:
    """Control steps of the whole schedule."""
    return self.task.config.horizon

  @property
  def pushes(self) -> tuple[pushes_lib.Push, ...]:
    """Pushes that the robot meets."""
    return self._config.pushes

  @property
  def ends(self) -> np.ndarray:
    """When each command ends, as shares of the whole, rising to 1."""
    ends = np.cumsum(self._config.durations)
    return ends / ends[-1]

  def start(self) -> Any:
    """Compiles the model and resets it; returns the physics."""
    return self._robot.start()

  def steps(self) -> Iterator[Step]:
    """Runs the schedule, after `start`.

    The roll-out continues after lost references and falls, unless `terminate`
    is set; a state that is not finite ends it.
    """
    for step in range(self.num_steps):
      self._push(step)
      made = self._robot.step()
      if made.cause == terminations.CAUSES[terminations.NON_FINITE]:
        return
      yield made
      if self._robot.over:
        return

  def _push(self, step: int) -> None:
    """Applies the pushes that are due."""
    period = self.task.config.control_timestep
    velocities = [
      push.velocity
      for push in self._config.pushes
      if durations.steps(push.time, period) == step
    ]
    if velocities:
      self._robot.push(np.sum(velocities, axis=0))


def _task_config(
  config: task_config.ImitationConfig, rollout: RolloutConfig
) -> task_config.ImitationConfig:
  """Returns the policy's task, from rest and as long as the schedule."""
  changes: dict[str, Any] = {
    'time_limit': sum(rollout.durations),
  }
  if rollout.physics_timestep is not None:
    changes['physics_timestep'] = rollout.physics_timestep
  if not rollout.terminate:
    changes['limits'] = terminations.NO_LIMITS
  return task_config.evaluated(config, **changes)


def _make_arena(config: RolloutConfig) -> track.Track:
  """Returns the arena, with segments for the ledges of all commands."""
  arena = track.make(config.arena, sizes=config.sizes)
  if not arena.adaptive:
    return arena
  return track.make(config.arena, arena.num_segments + len(config.modes))
