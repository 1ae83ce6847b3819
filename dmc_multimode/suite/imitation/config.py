"""Configuration of the imitation task, one dataclass for both engines."""

import dataclasses
import functools
import math
from typing import Annotated, Any, Iterable, Mapping

import numpy as np
import pydantic

from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import constants
from dmc_multimode.utils import durations
from dmc_multimode.walkers import robot as robot_lib


def _robot(value: Any) -> robot_lib.Robot:
  """Returns the robot of a field, or of its JSON."""
  return (
    value if isinstance(value, robot_lib.Robot) else robot_lib.from_dict(value)
  )


@config_lib.dataclass
class ImitationConfig:
  """Configuration of the imitation task, of both its engines.

  Attributes:
    gains: weights and sensitivities of Eq. 3.
    limits: early termination.
    events: training events; `events.NONE` for an evaluation. The default has
      those of a training: half of the episodes start mid-stride, and edges are
      noisy.
    time_limit: length of an episode, seconds, in the nearest whole number of
      control steps; infinite for episodes that only a termination ends.
    control_timestep: period of the policy, seconds.
    physics_timestep: period of the physics, seconds; divides the former.
    extra_observations: names of the policy's observations beyond the paper's,
      of `observations.EXTRA_TERMS`.
    feasible_references: references of gaits start with the robot's own speed
      and reach theirs after one cycle, and flights at clock rates above 1 rise
      less. Otherwise gaits move at full speed at once, and flights rise alike.
    commands_from_ground: postpones commands that would fall into a flight, or
      before the jump of a transient mode; see `schedule.transitions`.
    joint_noise: standard deviation of the initial joint angles, radians.
    velocity_noise: standard deviation of the initial velocities, m/s and rad/s.
    tilt_noise: standard deviation of the initial roll and pitch, radians.
    contact_force: least force on a foot that counts as a contact, newtons.
    robot: that does it; see `for_robot`.
  """

  gains: rewards.RewardGains = rewards.RewardGains()
  limits: terminations.TerminationLimits = terminations.TerminationLimits()
  events: events_lib.TrainingEvents = events_lib.TrainingEvents()
  time_limit: config_lib.Duration = 4.5
  control_timestep: config_lib.Positive = constants.CONTROL_TIMESTEP
  physics_timestep: config_lib.Positive = constants.PHYSICS_TIMESTEP
  extra_observations: tuple[str, ...] = ()
  feasible_references: bool = True
  commands_from_ground: bool = True
  joint_noise: config_lib.NonNegative = 0.05
  velocity_noise: config_lib.NonNegative = 0.1
  tilt_noise: config_lib.NonNegative = 0.03
  contact_force: config_lib.NonNegative = 1.0
  robot: Annotated[robot_lib.Robot, pydantic.PlainValidator(_robot)] = (
    dataclasses.field(
      default_factory=robot_lib.mini_biped, metadata={'flag': False}
    )
  )

  def __post_init__(self) -> None:
    observations.check_extra(self.extra_observations)
    ratio = self.control_timestep / self.physics_timestep
    if abs(ratio - round(ratio)) > 1e-6 or ratio < 1:
      raise ValueError(
        f'physics_timestep {self.physics_timestep} must divide '
        f'control_timestep {self.control_timestep}'
      )
    if not self.horizon:
      raise ValueError(
        f'time_limit {self.time_limit:g} has no room for a control step, '
        f'{self.control_timestep:g} s'
      )

  @property
  def substeps(self) -> int:
    """Physics steps in a control step."""
    return round(self.control_timestep / self.physics_timestep)

  @property
  def action_history(self) -> int:
    """Actions that a world remembers: for its costs, and for the delay."""
    longest = self.events.disturbances.action_delay[1] / self.control_timestep
    return max(3, math.ceil(round(longest, 6)) + 1)

  @property
  def observed_terms(self) -> tuple[str, ...]:
    """Names of the observed terms beyond the paper's, the critic's included."""
    drawn = bool(self.events.disturbances.active)
    return self.extra_observations + (observations.DISTURBANCES.name,) * drawn

  @functools.cached_property
  def horizon(self) -> int:
    """Control steps in an episode, or `durations.UNBOUNDED`."""
    return int(durations.steps(self.time_limit, self.control_timestep))

  def normalised(
    self,
    returns: Any,
    lengths: Any,
    horizon: int | np.ndarray | None = None,
    begin: int | np.ndarray = 0,
  ) -> Any:
    """Returns sums of rewards over the most that there is, in [0, 1].

    The most is horizon times the sum of the weights of Eq. 3; of an episode
    without a time limit, its own length takes the horizon's place.

    Args:
      returns: sums of the rewards of N episodes, [N].
      lengths: their control steps, [N].
      horizon: likewise until their time limits; the task's by default.
      begin: control step from which the rewards are summed.
    """
    most = self.horizon if horizon is None else horizon
    most = np.where(np.less(most, durations.UNBOUNDED), most, lengths)
    return returns / (self.gains.highest * (most - begin))

  def check_modes(self, motions: Iterable[motion_lib.ReferenceMotion]) -> None:
    """Raises ValueError for a mode that no robot can follow in this task.

    Args:
      motions: of the modes.
    """
    slack = self.events.distance_slack
    distance = self.limits.distance + slack.largest
    for motion in motions:
      motion_lib.check_cycle(motion, self.control_timestep)
      motion_lib.check_start(
        motion, distance, self.limits.angle, self.robot.stand_height
      )


def evaluated(config: ImitationConfig, **changes: Any) -> ImitationConfig:
  """Returns the task of a policy's training, without training events.

  Its physics steps are the product's, also where the training's were longer.

  Args:
    config: of the training.
    **changes: other values of fields, which override these.

  Raises:
    ValueError: the values are not those of a task.
  """
  period = changes.get('control_timestep', config.control_timestep)
  values = {
    'events': events_lib.NONE,
    'physics_timestep': _dividing(constants.PHYSICS_TIMESTEP, period),
    **changes,
  }
  return dataclasses.replace(config, **values)


def for_robot(
  config: ImitationConfig, robot: robot_lib.Robot
) -> ImitationConfig:
  """Returns a configuration, made for the mini biped, for another robot.

  Its lengths are in proportion to the heights of the trunks, and the period of
  the policy is that of the robot's declaration.

  Args:
    config: with the lengths and times of the mini biped.
    robot: that gets the task; its model is compiled.
  """
  size, period = robot.size, robot.declaration.control_timestep
  gain, slack = config.gains.position, config.events.distance_slack
  return dataclasses.replace(
    config,
    robot=robot,
    control_timestep=period,
    physics_timestep=_dividing(config.physics_timestep, period),
    gains=dataclasses.replace(
      config.gains,
      position=dataclasses.replace(gain, sensitivity=gain.sensitivity / size),
    ),
    limits=dataclasses.replace(
      config.limits,
      distance=config.limits.distance * size,
      height=config.limits.height * size,
    ),
    events=dataclasses.replace(
      config.events,
      edge_noise=config.events.edge_noise * size,
      distance_slack=dataclasses.replace(
        slack, first=slack.first * size, last=slack.last * size
      ),
    ),
  )


def _dividing(longest: float, period: float) -> float:
  """Returns a period of physics, at most `longest`, that divides another."""
  ratio = period / longest
  if abs(ratio - round(ratio)) < 1e-6 and ratio > 0.5:
    return longest
  return period / math.ceil(ratio)


def to_dict(config: ImitationConfig) -> dict[str, Any]:
  """Returns the configuration as JSON values.

  Those of the mini biped have no robot in them, as before there were others.
  """
  values = config_lib.to_dict(config)
  if config.robot.is_mini_biped:
    del values['robot']
  return values


def summary(config: ImitationConfig) -> dict[str, Any]:
  """Returns the configuration as JSON values, of a robot its name and hash."""
  values, robot = to_dict(config), config.robot
  if 'robot' in values:
    values['robot'] = {'name': robot.name, 'digest': robot.digest}
  return values


def from_dict(values: Mapping[str, Any]) -> ImitationConfig:
  """Returns the configuration of a `to_dict`, also of an earlier version.

  Raises:
    ValueError: in one line, a field is unknown, missing or of the wrong type.
  """
  try:
    return config_lib.build(ImitationConfig, upgraded(values))
  except (AttributeError, KeyError, TypeError, ValueError) as error:
    lacks = isinstance(error, KeyError)
    reason = f'it lacks {error}' if lacks else str(error).rstrip('.')
    raise ValueError(f'Not a task configuration: {reason}.') from error


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
  """Returns an earlier version's JSON of a task with this version's keys.

  The first versions had no limit of the angle, and commands did not wait for
  the ground. Then training events were fields of the task itself, and each
  schedule two to four fields. Until there were other observations, policies had
  the paper's, and references started at full speed; `servo_inertia` gave joints
  an inertia that depended on the physics step, where now the robot has its own.

  Raises:
    KeyError, TypeError, ValueError: the JSON is not that of a task.
  """
  new = dict(values)
  new['gains'] = _upgraded_gains(values['gains'])
  new['limits'] = {'angle': math.pi, **values['limits']}
  new = {'extra_observations': [], 'feasible_references': False, **new}
  new.pop('servo_inertia', None)
  if 'events' in new:
    return new
  new = {'commands_from_ground': False, **new}
  slack = new.pop('early_distance', 0.5) - new['limits'].get('distance', 0.35)
  tightened = new.pop('tighten_steps', 0)
  bonus, late = new.pop('contact_bonus', 0.0), new.pop('late_contact_bonus', 0)
  between = new.pop('contact_bonus_start', 0), new.pop('contact_bonus_end', 0)
  events = {
    'distance_slack': _schedule(slack, 0.0, 0, tightened) if tightened else 0,
    'assistance_steps': new.pop('assist_steps', 0),
    'contact_bonus': _schedule(bonus, late, *between) if between[1] else bonus,
  }
  for name, start_name in (
    ('obstacles', 'obstacles_start'),
    ('push_speed', 'push_start'),
  ):
    value, start = new.pop(name, 0.0), new.pop(start_name, 0)
    events[name] = _schedule(0.0, value, start, start) if start else value
  for name in ('push_interval', 'reference_starts', 'edge_noise'):
    if name in new:
      events[name] = new.pop(name)
  return {**new, 'events': events}


def _schedule(first: Any, last: Any, start: Any, end: Any) -> dict[str, Any]:
  return {'first': first, 'last': last, 'start': start, 'end': end}


def _upgraded_gains(gains: Any) -> Any:
  """Returns gains by term instead of by 'TERM_weight', 'TERM_sensitivity'."""
  if not any('_' in name for name in gains):
    return gains
  result: dict[str, Any] = {}
  for name, value in gains.items():
    term, _, part = name.rpartition('_')
    result.setdefault(term, {})[part] = value
  return result
