"""One policy following one schedule in the Composer task, step by step."""

import collections
import dataclasses
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

from dm_control import composer
import dm_env
import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.modes import reference
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite import terminations

_SPEED_WINDOW = 0.3  # Seconds over which the shown speed is a mean.


@dataclasses.dataclass(frozen=True)
class RolloutConfig:
  """What is rolled out.

  Attributes:
    modes: names of the commanded modes.
    durations: of the commands, seconds.
    arena: name of a track.
    sizes: of the track, metres, where they are not its defaults.
    clock_rate: rate of the phase clock, 1 being the references' own.
    seed: of the terrain and of the initial state's noise.
    pushes: that the robot meets.
    imitation: whether a robot that loses its reference has failed; in a plan,
      only one that falls has.
    physics_timestep: seconds; the policy's own if None.
    terminate: whether the roll-out ends where an episode would.
  """

  modes: tuple[str, ...]
  durations: tuple[float, ...]
  arena: str = 'flat'
  sizes: Mapping[str, float] = dataclasses.field(default_factory=dict)
  clock_rate: float = 1.0
  seed: int = 0
  pushes: tuple[pushes_lib.Push, ...] = ()
  imitation: bool = True
  physics_timestep: float | None = None
  terminate: bool = False


class Step(NamedTuple):
  """What a control step led to.

  Attributes:
    command: index into the schedule of the command that was in force.
    time: seconds since the start.
    mode: name of the mode that runs from here on.
    position: of the trunk in the world, metres, [3].
    height: of the trunk over the support plane under it, metres.
    rise: of the trunk over the support plane at the mode's start, metres.
    speed: horizontal, mean over the last 0.3 s, m/s.
    reward: in [0, 1].
    cause: why an episode would end here; 'none' where it would not.
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


class Outcome(NamedTuple):
  """How one command of the schedule went.

  Attributes:
    mode: name of the mode.
    duration: seconds for which it ran; 0 if it was never reached.
    cause: the first reason to end an episode in it, 'none' if it survived.
    speed: distance between its ends over its duration, horizontal, m/s.
    peak: greatest height of the trunk over the support plane at the mode's
      start, metres.
  """

  mode: str
  duration: float
  cause: str
  speed: float
  peak: float

  def __str__(self) -> str:
    if not self.duration:
      return f'{self.mode}: not reached'
    fate = 'survived' if self.cause == 'none' else f'failed ({self.cause})'
    return (
      f'{self.mode}: {fate}, mean speed {self.speed:.2f} m/s, '
      f'peak height {self.peak:.2f} m'
    )


class Rollout:
  """A policy in its environment, reset and ready to run once."""

  def __init__(self, policy: pretrained.Policy, config: RolloutConfig):
    """Builds the environment.

    Raises:
      ValueError: the schedule, the arena, a number, or a mode that the policy
        does not know.
    """
    bank = reference.ReferenceBank(policy.motions)
    self.schedule = schedule_lib.from_names(
      bank, config.modes, config.durations, config.clock_rate
    )
    if config.seed < 0:
      raise ValueError(f'seed must not be negative, got {config.seed}.')
    task_config = _task_config(policy.config, config)
    if not task_config.horizon:
      raise ValueError('The schedule is shorter than one control step.')
    self._policy, self._config = policy, config
    self._limits = policy.config.limits
    if not config.imitation:
      self._limits = terminations.falls_alone(self._limits)
    self.task = multimode_biped.make_task(
      policy.motions,
      codebook=policy.codebook,
      episodes=episodes.ScheduledEpisodes(self.schedule),
      arena=_make_arena(config),
      config=task_config,
    )

  @property
  def num_steps(self) -> int:
    """Control steps of the whole schedule."""
    return self.task.config.horizon

  @property
  def pushes(self) -> tuple[pushes_lib.Push, ...]:
    """What the robot meets."""
    return self._config.pushes

  @property
  def ends(self) -> np.ndarray:
    """When each command ends, as shares of the whole, rising to 1."""
    durations = np.cumsum(self._config.durations)
    return durations / durations[-1]

  def start(self) -> Any:
    """Compiles the model and resets it; returns the physics."""
    self._environment = composer.Environment(
      self.task,
      random_state=self._config.seed,
      recompile_mjcf_every_episode=False,
      raise_exception_on_physics_error=False,
    )
    self._first = self._environment.reset()
    return self._environment.physics

  def steps(self) -> Iterator[Step]:
    """Runs the schedule, after `start`.

    A robot that has lost its reference or fallen goes on, unless the
    configuration says `terminate`; a state that is not finite ends it.
    """
    timestep, state = self._first, self.task.core.tracker.state
    window = max(1, round(_SPEED_WINDOW / self.task.config.control_timestep))
    path = collections.deque([self._position()], window + 1)
    for step in range(self.num_steps):
      timestep = self._pushed(timestep, step)
      command, floor = int(state.knot[0]), float(state.anchor[0, 2])
      action = self._policy.actor.select_action(timestep.observation)
      timestep = self._environment.step(action)
      if not np.isfinite(self._position()).all():
        return
      path.append(self._position())
      yield self._step(command, floor, path)
      if timestep.last():
        return

  def _pushed(self, timestep: dm_env.TimeStep, step: int) -> dm_env.TimeStep:
    """Carries out the pushes that are due; returns what is seen after them."""
    period = self.task.config.control_timestep
    physics = self._environment.physics
    velocities = [
      push.velocity
      for push in self._config.pushes
      if round(push.time / period) == step
    ]
    if not velocities:
      return timestep
    physics.data.qvel[:3] += np.sum(velocities, axis=0)
    physics.forward()
    parts = self.task.core.observe(
      physics.data.qpos[None], physics.data.qvel[None]
    )
    seen = {name: parts[name][0] for name in timestep.observation}
    return timestep._replace(observation=seen)

  def _position(self) -> np.ndarray:
    return self._environment.physics.data.qpos[:3].copy()

  def _step(
    self, command: int, floor: float, path: Sequence[np.ndarray]
  ) -> Step:
    """Judges the step that has just been made."""
    task, outcome = self.task, self.task.outcome
    assert outcome is not None
    elapsed = (len(path) - 1) * task.config.control_timestep
    position = path[-1]
    height = position[2] - task.core.support(position[:1])
    cause = terminations.termination_cause(
      outcome.errors.position,
      outcome.errors.orientation,
      outcome.reward,
      height,
      np.array([True]),
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


def outcomes(
  config: RolloutConfig, start: np.ndarray, steps: Sequence[Step]
) -> list[Outcome]:
  """Returns how every command went.

  Args:
    config: of the roll-out.
    start: where the trunk began, metres, [3].
    steps: all of them.
  """
  result = []
  before, began = start, 0.0
  for command, mode in enumerate(config.modes):
    mine = [step for step in steps if step.command == command]
    if not mine:
      result.append(Outcome(mode, 0.0, 'none', 0.0, 0.0))
      continue
    duration = mine[-1].time - began
    way = np.linalg.norm((mine[-1].position - before)[:2])
    cause = next((s.cause for s in mine if s.cause != 'none'), 'none')
    peak = max(step.rise for step in mine)
    result.append(Outcome(mode, duration, cause, float(way) / duration, peak))
    before, began = mine[-1].position, mine[-1].time
  return result


def _task_config(
  config: config_lib.ImitationConfig, rollout: RolloutConfig
) -> config_lib.ImitationConfig:
  """The policy's own task, from rest, as long as the schedule."""
  changes: dict[str, Any] = {'time_limit': sum(rollout.durations)}
  if rollout.physics_timestep is not None:
    changes['physics_timestep'] = rollout.physics_timestep
  if not rollout.terminate:
    changes['limits'] = terminations.NO_LIMITS
  return dataclasses.replace(config_lib.for_evaluation(config), **changes)


def _make_arena(config: RolloutConfig) -> track.Track:
  """The arena, with room for the step that any of the commands may call for."""
  arena = track.make(config.arena, sizes=config.sizes)
  if not arena.adaptive:
    return arena
  return track.make(config.arena, arena.num_segments + len(config.modes))
