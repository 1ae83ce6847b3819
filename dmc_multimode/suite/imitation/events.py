"""Events that only serve a training: pushes, assistance, bonuses, obstacles.

A task is evaluated without: `dataclasses.replace(config, events=NONE)`. All of
it but the initial states changes along a training, by its environment steps
summed over all worlds, and nothing here counts them.

From rest, half a jump onto a block pays no more than none. So at take-off the
robot is given a share of the velocity that it should have by then: all of it
at first, so that it practises flights and landings from rest, and less and less
as long as a third of the episodes that end on a block survive. This is the
take-off assistance curriculum.
"""

import dataclasses
from typing import Any, Mapping

import numpy as np
from pydantic import dataclasses as pydantic_dataclasses

from dmc_multimode.utils import config
from dmc_multimode.utils import schedule

_MEMORY = 0.995  # The mean follows about the last 200 episodes.
_ENOUGH = 1 / 3  # Share of survivors above which assistance fades.
_CLEARANCE = 0.05  # Metres: as high as a swinging foot needs to be.
_ZERO = schedule.constant(0.0)


@pydantic_dataclasses.dataclass(frozen=True, config=config.STRICT)
class TrainingEvents:
  """Events that happen to robots in a training alone.

  Attributes:
    reference_starts: share of the episodes that start on the reference at a
      random phase, with the reference's velocity.
    edge_noise: half-width of the uniform noise on the distance to a ledge that
      a mode such as launch needs, metres.
    distance_slack: how much farther than `limits.distance` a robot may be from
      its reference, metres.
    assistance_steps: environment steps over which the take-off assistance
      fades, of those in which enough episodes survive; 0 for none.
    contact_bonus: weight of what is added to the reward where feet stand and
      swing as the reference's do, see `contact_schedule_agreement`; no
      normalised return counts it. A gait that has been learned stays with
      less, and then keeps closer to its reference.
    obstacles: share of the commands that meet an obstacle, see
      `suite.imitation.obstacles`.
    push_speed: most velocity that a push adds, m/s.
    push_interval: mean time between the pushes of a robot, seconds.
  """

  reference_starts: config.Share = 0.5
  edge_noise: config.NonNegative = 0.04
  distance_slack: schedule.ScheduleField = _ZERO
  assistance_steps: config.Count = 0
  contact_bonus: schedule.ScheduleField = _ZERO
  obstacles: schedule.ScheduleField = _ZERO
  push_speed: schedule.ScheduleField = _ZERO
  push_interval: config.Positive = 1.5

  def __post_init__(self) -> None:
    for name in ('contact_bonus', 'obstacles', 'push_speed'):
      value = getattr(self, name)
      if min(value.first, value.last) < 0:
        raise ValueError(f'{name} must not be negative, got {value}')
    if self.most_obstacles > 1:
      raise ValueError(f'obstacles is a share in [0, 1], got {self.obstacles}')

  @property
  def most_obstacles(self) -> float:
    """The largest share of commands that ever meet an obstacle."""
    return max(self.obstacles.first, self.obstacles.last)

  def at_end(self) -> 'TrainingEvents':
    """Returns the events as they are when every schedule has ended."""
    changes: dict[str, Any] = {
      name: schedule.constant(value.last)
      for name, value in vars(self).items()
      if isinstance(value, schedule.Schedule)
    }
    return dataclasses.replace(self, assistance_steps=0, **changes)


# Episodes start from rest, edges are in place, and nothing else happens.
NONE = TrainingEvents(reference_starts=0.0, edge_noise=0.0)


class TakeoffAssistance:
  """The share of a take-off's velocity that the robot is given."""

  def __init__(self, steps: int, assisted: np.ndarray):
    """Begins with all of it.

    Args:
      steps: environment steps over which it fades, of those in which enough
        episodes survive; 0 for no assistance.
      assisted: whether each mode is, [M].
    """
    self._steps = steps
    self._assisted = np.asarray(assisted, dtype=bool)
    self._survival = 0.0
    self.share = 1.0 if steps and self._assisted.any() else 0.0

  def boost(self, velocity: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Returns what to add to velocities at take-off, m/s, [N, 3].

    It points along the wanted velocity and never leads beyond it.

    Args:
      velocity: of the trunk, world m/s, [N, 3].
      wanted: what it should be, not zero, world m/s, [N, 3].
    """
    reached = np.sum(velocity * wanted, axis=1) / np.sum(wanted**2, axis=1)
    return np.clip(1 - reached, 0, self.share)[:, None] * wanted

  def update(self, final: np.ndarray, survived: np.ndarray) -> None:
    """Takes finished episodes: their last modes and whether they survived."""
    for value in survived[self._assisted[final]]:
      self._survival += (1 - _MEMORY) * (value - self._survival)

  def fade(self, steps: int) -> None:
    """Fades by so many environment steps, if enough episodes survive."""
    if self.share > 0 and self._survival > _ENOUGH:
      self.share = max(self.share - steps / self._steps, 0.0)

  def state(self) -> dict[str, np.ndarray]:
    """Returns what `restore` needs."""
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
  probability: float,
  random_state: np.random.RandomState,
) -> None:
  """Pushes some robots in some horizontal direction.

  Args:
    qvel: generalised velocities, [B, 16]; those of the pushed change.
    speed: most velocity that a push adds, m/s; nothing is drawn where it is 0.
    probability: of a push, for each robot.
    random_state: source of who, how hard and where to.
  """
  if not speed:
    return
  uniform = lambda high, size: random_state.uniform(0, high, size)
  ids = np.flatnonzero(uniform(1.0, len(qvel)) < probability)
  speeds, angle = uniform(speed, len(ids)), uniform(2 * np.pi, len(ids))
  qvel[ids, 0] += speeds * np.cos(angle)
  qvel[ids, 1] += speeds * np.sin(angle)


def contact_schedule_agreement(
  contact: np.ndarray,
  clearance: np.ndarray,
  reference_contact: np.ndarray,
  has_contact: np.ndarray,
) -> np.ndarray:
  """Returns how well feet keep the reference's contacts, in [0, 1], [B].

  Not part of Eq. 3, whose contact term is flat between a foot that stands and
  one in the air: here a foot that should swing is the better, the higher it is,
  up to 5 cm. One that should stand is right in contact. The product of both
  feet: a shuffle, which always has one of them right, is right in nothing.

  Args:
    contact, reference_contact: feet on the ground (left, right), 0 or 1,
      [B, 2].
    clearance: of the soles over the ground below, metres, [B, 2].
    has_contact: whether the reference prescribes contacts, [B]; elsewhere feet
      are always right.
  """
  swing = np.clip(clearance / _CLEARANCE, 0.0, 1.0)
  right = np.where(reference_contact > 0, contact, swing)
  return np.where(has_contact, right.prod(axis=-1), 1.0)
