"""Training events: pushes, assistance, bonus, obstacles, initial states.

An evaluation has none: `dataclasses.replace(config, events=NONE)`. All but the
initial states are schedules of environment steps, summed over all worlds; the
caller counts them. The batched engine alone has assistance, bonus, costs and
schedules; the Composer task has every other event as at step 0, and no slack.

The take-off assistance curriculum: from rest, half a jump onto a block earns no
more than no jump. So at take-off the robot is given a share of the velocity
that it lacks. The share falls from 1 to 0, while at least a third of the
episodes that end in a mode with a flight survive.
"""

import dataclasses
from typing import Any, Mapping

import numpy as np

from dmc_multimode.suite.imitation import disturbances as disturbances_lib
from dmc_multimode.suite.imitation import motion_costs
from dmc_multimode.utils import config
from dmc_multimode.utils import schedule

_MEMORY = 0.995  # The mean follows about the last 200 episodes.
RECOVERY = 2.0  # Seconds after a push in which a robot is recovering.
_ENOUGH = 1 / 3  # Share of survivors above which assistance fades.
_CLEARANCE = 0.05  # Metres: clearance at which a swinging foot agrees fully.
_SWING_HEIGHT = 0.06  # Metres: clearance in the middle of a step's swing.
_LEAST_SWING = 0.005  # Metres, at its ends.
_SWING_SLACK = 0.02  # Metres above it that still agree.
_TOUCHING = 0.3  # Share of its agreement that a stepping foot keeps in contact.
_ZERO = schedule.constant(0.0)


@config.dataclass
class TrainingEvents:
  """Events of trainings; evaluations have none.

  Attributes:
    reference_starts: share of the episodes that start on the reference at a
      random phase, with the reference's velocity.
    edge_noise: half-width of the uniform noise on the distance to a ledge that
      a mode such as launch needs, metres.
    distance_slack: added to `limits.distance`, metres.
    assistance_steps: environment steps over which the take-off assistance
      fades, counted while enough episodes survive; 0 for no assistance.
    contact_bonus: weight of `contact_schedule_agreement`, which is added to the
      reward and not to normalised returns. A gait that has been learned keeps
      with a smaller weight, and then follows its reference more closely. For
      two seconds after a push it is paid wherever the reference stands on all
      feet.
    precision_bonus: weight of `rewards.precision`, which is added likewise:
      without it a steady offset of 2 cm costs less than the noise of returns.
    obstacles: share of the commands that meet an obstacle, see
      `suite.imitation.obstacles`.
    push_speed: largest velocity that a push adds, m/s; see `push`.
    push_interval: mean time between the pushes of a robot, seconds.
    push_fraction: probability of an episode to have pushes.
    push_slack: added to `limits.distance` for two seconds after a push, metres:
      a robot that steps to stay up strays, and has to come back.
    push_cost_share: factor of `costs` in these two seconds: such steps are not
      quiet.
    disturbances: of body, servos and ground, drawn for each episode.
    disturbance_share: of the way from the nominal robot to the drawn one.
    disturbance_fraction: probability of each row of the disturbances to be
      drawn for an episode, and not nominal.
    sensor_noise: factor of the noise of `observations.Term`.
    costs: of motions that are not quiet, which are subtracted from the reward
      and not from normalised returns.
    cost_share: factor of all costs.
  """

  reference_starts: config.Share = 0.5
  edge_noise: config.NonNegative = 0.04
  distance_slack: schedule.ScheduleField = _ZERO
  assistance_steps: config.Count = 0
  contact_bonus: schedule.ScheduleField = _ZERO
  precision_bonus: schedule.ScheduleField = _ZERO
  obstacles: schedule.ScheduleField = _ZERO
  push_speed: schedule.ScheduleField = _ZERO
  push_interval: config.Positive = 1.5
  push_fraction: config.Share = 1.0
  push_slack: config.NonNegative = 0.0
  push_cost_share: config.Share = 1.0
  disturbances: disturbances_lib.Disturbances = disturbances_lib.NOMINAL
  disturbance_share: schedule.ShareField = schedule.constant(1.0)
  disturbance_fraction: config.Share = 1.0
  sensor_noise: schedule.ScheduleField = _ZERO
  costs: motion_costs.CostWeights = motion_costs.NONE
  cost_share: schedule.ShareField = schedule.constant(1.0)

  def __post_init__(self) -> None:
    for name in (
      'contact_bonus',
      'precision_bonus',
      'obstacles',
      'push_speed',
      'sensor_noise',
    ):
      value = getattr(self, name)
      if min(value.first, value.last) < 0:
        raise ValueError(f'{name} must not be negative, got {value}')
    if self.most_obstacles > 1:
      raise ValueError(f'obstacles is a share in [0, 1], got {self.obstacles}')

  @property
  def most_obstacles(self) -> float:
    """Largest share of commands that meet an obstacle, over all steps."""
    return self.obstacles.largest

  def at_end(self) -> 'TrainingEvents':
    """Returns the events at the end of every schedule, as constants."""
    changes: dict[str, Any] = {
      name: value.at_end()
      for name, value in vars(self).items()
      if isinstance(value, schedule.Schedule)
    }
    return dataclasses.replace(self, assistance_steps=0, **changes)


# Episodes start from rest, edges are in place, and nothing else happens.
NONE = TrainingEvents(reference_starts=0.0, edge_noise=0.0)


def fixed(
  push_speed: float = 0.0, sensor_noise: float = 0.0, **rows: float
) -> TrainingEvents:
  """Returns the events of an evaluation under fixed disturbances.

  Args:
    push_speed: largest velocity that a push adds, m/s.
    sensor_noise: factor of the noise of `observations.Term`.
    **rows: values of `Disturbances` by name.

  Raises:
    ValueError: a number is out of bounds.
  """
  return dataclasses.replace(
    NONE,
    push_speed=schedule.constant(push_speed),
    sensor_noise=schedule.constant(sensor_noise),
    disturbances=disturbances_lib.NOMINAL.fixed(**rows),
  )


class TakeoffAssistance:
  """Take-off assistance: the share of a lacking velocity that robots get."""

  def __init__(self, steps: int, assisted: np.ndarray):
    """Starts at a share of 1.

    Args:
      steps: environment steps over which it fades, counted while enough
        episodes survive; 0 for no assistance.
      assisted: whether each mode is assisted, [M].
    """
    self._steps = steps
    self._assisted = np.asarray(assisted, dtype=bool)
    self._survival = 0.0
    self.share = 1.0 if steps and self._assisted.any() else 0.0

  def boost(self, velocity: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Returns increments of the velocities at take-off, m/s, [N, 3].

    An increment is parallel to the wanted velocity, and never exceeds it.

    Args:
      velocity: of the trunk, world m/s, [N, 3].
      wanted: of the reference, not zero, world m/s, [N, 3].
    """
    reached = np.sum(velocity * wanted, axis=1) / np.sum(wanted**2, axis=1)
    return np.clip(1 - reached, 0, self.share)[:, None] * wanted

  def update(self, final: np.ndarray, survived: np.ndarray) -> None:
    """Counts finished episodes: last modes and whether they survived, [N]."""
    for value in survived[self._assisted[final]]:
      self._survival += (1 - _MEMORY) * (value - self._survival)

  def fade(self, steps: int) -> None:
    """Fades by `steps` environment steps, if enough episodes survive."""
    if self.share > 0 and self._survival > _ENOUGH:
      self.share = max(self.share - steps / self._steps, 0.0)

  def state(self) -> dict[str, np.ndarray]:
    """Returns the state for `restore`."""
    return {
      'survival': np.array(self._survival),
      'share': np.array(self.share),
    }

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """Restores a `state`."""
    self._survival = float(state['survival'])
    self.share = float(state['share'])


def push(
  qvel: np.ndarray,
  speed: float,
  probability: float | np.ndarray,
  random_state: np.random.RandomState,
) -> np.ndarray:
  """Adds random horizontal velocities to some robots, in place.

  They are uniform in a disc, so that three of four exceed half of `speed`.

  Args:
    qvel: generalised velocities, [B, 6 + J]; changed in place.
    speed: largest velocity that a push adds, m/s; at 0 nothing is drawn.
    probability: of a push, for each robot, [B] or one for all.
    random_state: source of the robots, speeds and directions.

  Returns:
    The robots that are pushed, [N].
  """
  if not speed:
    return np.zeros(0, dtype=np.int64)
  uniform = lambda high, size: random_state.uniform(0, high, size)
  ids = np.flatnonzero(uniform(1.0, len(qvel)) < probability)
  speeds = speed * np.sqrt(uniform(1.0, len(ids)))
  angle = uniform(2 * np.pi, len(ids))
  qvel[ids, 0] += speeds * np.cos(angle)
  qvel[ids, 1] += speeds * np.sin(angle)
  return ids


def contact_schedule_agreement(
  contact: np.ndarray,
  clearance: np.ndarray,
  reference_contact: np.ndarray,
  has_contact: np.ndarray,
  progress: np.ndarray,
) -> np.ndarray:
  """Returns the agreement of feet and reference contacts, in [0, 1], [B].

  Not part of Eq. 3, whose contact term is flat between stance and swing. Here a
  foot that should swing agrees in proportion to its clearance, up to a height
  that rises and falls over the swing, 6 cm in its middle, so that the foot is
  set down softly; far above that, it agrees less; if it touches the ground, as
  on its toe, it keeps 0.3 of its agreement, however high its middle is. In a
  flight of both feet 5 cm are enough. A foot that should stand agrees in
  contact. The product over a left and a right foot is 0 for a shuffle, which
  always has one foot right; of four feet, the mean over both pairs counts, so
  that one that steps is already worth something.

  Args:
    contact, reference_contact: feet on the ground, 0 or 1, [B, F].
    clearance: of the soles over the ground below, metres, [B, F].
    has_contact: whether the reference prescribes contacts, [B]; where not, the
      agreement is 1.
    progress: of the swing of a foot while the other stands, in [0, 1]; NaN for
      feet that do not, [B, F].
  """
  swing = np.clip(clearance / _CLEARANCE, 0.0, 1.0)
  bell = np.maximum(_SWING_HEIGHT * np.sin(np.pi * progress), _LEAST_SWING)
  too_high = (clearance - bell - _SWING_SLACK) / _SWING_HEIGHT
  stepping = np.clip(clearance / bell, 0.0, 1.0)
  stepping *= np.clip(1.0 - too_high, 0.0, 1.0)
  stepping *= np.where(contact > 0, _TOUCHING, 1.0)
  swing = np.where(np.isnan(progress), swing, stepping)
  right = np.where(reference_contact > 0, contact, swing)
  pairs = right.reshape(len(right), -1, 2).prod(axis=2)
  return np.where(has_contact, pairs.mean(axis=1), 1.0)
