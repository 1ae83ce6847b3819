"""Everything that the imitation task can be tuned by, in one dataclass."""

import dataclasses
import math
from typing import Any, Mapping

from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import typed


@dataclasses.dataclass(frozen=True)
class ImitationConfig:
  """Configuration of the imitation task, of both its engines.

  Attributes:
    gains: weights and sensitivities of Eq. 3.
    limits: early termination.
    time_limit: length of an episode, seconds.
    control_timestep: period of the policy, seconds.
    physics_timestep: period of the physics, seconds; divides the former.
    servo_inertia: whether the joints have the inertia that makes long physics
      steps behave as short ones do; see `MiniBiped.add_servo_inertia`.
    early_distance: bound on the distance from the reference at the start of a
      training, metres; it falls to `limits.distance` over `tighten_steps`.
    tighten_steps: control steps of all worlds together; 0 for no schedule.
    assist_steps: control steps of all worlds together over which help with
      take-offs fades, of those in which enough episodes survive, see
      `TakeoffAssistance`; 0 for no help.
    contact_bonus: weight of what a training adds to its reward where feet stand
      and swing as the reference's do, see `rewards.footing`; no normalised
      return counts it.
    late_contact_bonus: that weight in the end: a gait that has been learned
      stays with less, and then keeps closer to its reference.
    contact_bonus_start, contact_bonus_end: control steps of all worlds together
      between which the weight changes, linearly, from the one to the other.
    obstacles: share of the commands in a training that meet an obstacle, see
      `suite.imitation.obstacles`.
    obstacles_start: control steps of all worlds together before there are any.
    push_speed: most velocity that a push in a training adds, m/s.
    push_interval: mean time between the pushes of a robot, seconds.
    push_start: control steps of all worlds together before there are any.
    reference_starts: share of the episodes that start on the reference at a
      random phase, with the reference's velocity.
    edge_noise: half-width of the uniform noise on the distance to a step that
      a mode such as launch needs, metres.
    commands_from_ground: whether a mode is commanded only when the one before
      it is on the ground, and has made its jump; see `schedule.transitions`.
    joint_noise: standard deviation of the initial joint angles, radians.
    velocity_noise: standard deviation of the initial velocities, m/s and rad/s.
    tilt_noise: standard deviation of the initial roll and pitch, radians.
    contact_force: feet pressed harder than this are in contact, newtons.
  """

  gains: rewards.RewardGains = rewards.RewardGains()
  limits: terminations.TerminationLimits = terminations.TerminationLimits()
  early_distance: float = 0.5
  tighten_steps: int = 0
  assist_steps: int = 0
  time_limit: float = 4.5
  control_timestep: float = 0.03
  physics_timestep: float = 0.005
  servo_inertia: bool = True
  contact_bonus: float = 0.0
  late_contact_bonus: float = 0.0
  contact_bonus_start: int = 0
  contact_bonus_end: int = 0
  obstacles: float = 0.0
  obstacles_start: int = 0
  push_speed: float = 0.0
  push_interval: float = 1.5
  push_start: int = 0
  reference_starts: float = 0.5
  edge_noise: float = 0.04
  commands_from_ground: bool = True
  joint_noise: float = 0.05
  velocity_noise: float = 0.1
  tilt_noise: float = 0.03
  contact_force: float = 1.0

  def __post_init__(self) -> None:
    for name in (
      'time_limit',
      'control_timestep',
      'physics_timestep',
      'push_interval',
    ):
      value = getattr(self, name)
      if not (math.isfinite(value) and value > 0):
        raise ValueError(f'{name} must be positive, got {value}.')
    ratio = self.control_timestep / self.physics_timestep
    if abs(ratio - round(ratio)) > 1e-6 or ratio < 1:
      raise ValueError(
        f'physics_timestep {self.physics_timestep} must divide '
        f'control_timestep {self.control_timestep}.'
      )
    for name in ('contact_bonus', 'late_contact_bonus', 'push_speed'):
      value = getattr(self, name)
      if not (math.isfinite(value) and value >= 0):
        raise ValueError(f'{name} must not be negative, got {value}.')
    if not 0 <= self.contact_bonus_start <= self.contact_bonus_end:
      raise ValueError(
        f'contact_bonus_start {self.contact_bonus_start} must not be negative '
        f'nor later than contact_bonus_end {self.contact_bonus_end}.'
      )
    for name in ('reference_starts', 'obstacles'):
      value = getattr(self, name)
      if not 0 <= value <= 1:
        raise ValueError(f'{name} is a share in [0, 1], got {value}.')
    for name in ('obstacles_start', 'push_start'):
      if getattr(self, name) < 0:
        raise ValueError(
          f'{name} must not be negative, got {getattr(self, name)}.'
        )

  def distance_after(self, steps: int) -> float:
    """Bound on the distance from the reference, metres, early or late.

    Args:
      steps: control steps that all worlds of a training made together.
    """
    late = self.limits.distance
    if steps >= self.tighten_steps:
      return late
    share = steps / self.tighten_steps
    return self.early_distance + share * (late - self.early_distance)

  def contact_bonus_after(self, steps: int) -> float:
    """Weight of the bonus on footing; with no schedule, `contact_bonus`.

    Args:
      steps: control steps that all worlds of a training made together.
    """
    start, end = self.contact_bonus_start, self.contact_bonus_end
    if not end or steps < start:
      return self.contact_bonus
    share = min((steps - start) / (end - start), 1.0) if end > start else 1.0
    change = self.late_contact_bonus - self.contact_bonus
    return self.contact_bonus + share * change

  def obstacle_share_after(self, steps: int) -> float:
    """Share of the commands that meet an obstacle.

    Args:
      steps: control steps that all worlds of a training made together.
    """
    return self.obstacles if steps >= self.obstacles_start else 0.0

  def push_speed_after(self, steps: int) -> float:
    """Most velocity that a push adds, m/s.

    Args:
      steps: control steps that all worlds of a training made together.
    """
    return self.push_speed if steps >= self.push_start else 0.0

  @property
  def substeps(self) -> int:
    """Physics steps in a control step."""
    return round(self.control_timestep / self.physics_timestep)

  @property
  def horizon(self) -> int:
    """Control steps in an episode."""
    return round(self.time_limit / self.control_timestep)


def for_evaluation(config: ImitationConfig) -> ImitationConfig:
  """Returns the task without what only serves training.

  Episodes start from rest, edges are in place, no obstacle is met, nobody
  helps or pushes, no bonus is paid, and the bound on the distance is the final
  one.
  """
  return dataclasses.replace(
    config,
    reference_starts=0.0,
    edge_noise=0.0,
    tighten_steps=0,
    assist_steps=0,
    contact_bonus=0.0,
    late_contact_bonus=0.0,
    obstacles=0.0,
    push_speed=0.0,
  )


def to_dict(config: ImitationConfig) -> dict[str, Any]:
  """Returns the configuration as JSON-able values."""
  values = {
    field.name: getattr(config, field.name)
    for field in dataclasses.fields(config)
  }
  values['gains'] = config.gains._asdict()
  values['limits'] = config.limits._asdict()
  return values


def from_dict(values: Mapping[str, Any]) -> ImitationConfig:
  """Returns what `to_dict` was given.

  What was written before there was a `servo_inertia` knew none, nor a limit of
  the angle, nor did commands wait for the ground.

  Raises:
    ValueError: a field is unknown or of the wrong type.
  """
  try:
    gains = typed.build(rewards.RewardGains, values['gains'])
    limits = typed.build(
      terminations.TerminationLimits, {'angle': math.pi, **values['limits']}
    )
    return typed.build(
      ImitationConfig,
      {
        'servo_inertia': False,
        'commands_from_ground': False,
        **values,
        'gains': gains,
        'limits': limits,
      },
    )
  except KeyError as error:
    raise ValueError(f'Not a task configuration: it lacks {error}.') from error
  except (TypeError, ValueError) as error:
    reason = str(error).rstrip('.')
    raise ValueError(f'Not a task configuration: {reason}.') from error
