"""One policy following one schedule in the Composer task, step by step."""

import dataclasses
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config as config_lib
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.viewer import robot


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
    self.schedule = schedule_lib.from_names(
      policy.mode_set, config.modes, config.durations, config.clock_rate
    )
    if config.seed < 0:
      raise ValueError(f'seed must not be negative, got {config.seed}.')
    task_config = _task_config(policy.config, config)
    if not task_config.horizon:
      raise ValueError('The schedule is shorter than one control step.')
    self._config = config
    self.task = multimode_biped.make_task(
      policy.mode_set,
      episodes=episodes.ScheduledEpisodes(self.schedule),
      arena=_make_arena(config),
      config=task_config,
    )
    limits = policy.config.limits
    if not config.imitation:
      limits = terminations.falls_alone(limits)
    self._robot = robot.Robot(policy, self.task, limits, config.seed)

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
    return self._robot.start()

  def steps(self) -> Iterator[robot.Step]:
    """Runs the schedule, after `start`.

    A robot that has lost its reference or fallen goes on, unless the
    configuration says `terminate`; a state that is not finite ends it.
    """
    for step in range(self.num_steps):
      self._push(step)
      made = self._robot.step()
      if made.cause == terminations.CAUSES[terminations.INVALID]:
        return
      yield made
      if self._robot.over:
        return

  def _push(self, step: int) -> None:
    """Carries out the pushes that are due."""
    period = self.task.config.control_timestep
    velocities = [
      push.velocity
      for push in self._config.pushes
      if round(push.time / period) == step
    ]
    if velocities:
      self._robot.push(np.sum(velocities, axis=0))


def outcomes(
  config: RolloutConfig, start: np.ndarray, steps: Sequence[robot.Step]
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
