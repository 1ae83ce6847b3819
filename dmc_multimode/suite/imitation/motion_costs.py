"""Costs of motions that are not quiet: pure, batched.

The reward of Eq. 3 is about the trunk alone; a policy that earns all of it may
still shake, stamp and straddle. In training, the sum of weight times cost over
the rows of `CostWeights` is subtracted from the reward; normalised returns and
evaluations leave it out.
"""

import dataclasses
from typing import Any, Callable, Mapping, NamedTuple

import numpy as np

from dmc_multimode.utils import config

_SOFT_LANDING = 0.5  # m/s: slower touch-downs cost nothing.
_APPROACH = 0.03  # Metres over the ground within which a fall is a touch-down.
_NEAR_LIMIT = np.deg2rad(3.0)  # Before a joint's limit.
_EXCESS = 0.1  # Radians in the zone of a limit that cost 1.
HALF_FOOT = 0.06  # Metres from the middle of a sole; its ends are at 7.5 cm.
EVEN = 0.02  # Metres: smaller rises of the ground are none.
_WIDTH_SLACK = 0.04  # Metres.
_STRADDLE = 0.1  # Metres beyond the slack that cost 1.


class Motion(NamedTuple):
  """Robots at the end of a control step, in lengths of the mini biped.

  Attributes:
    actions: the last joint targets, the newest first, radians, [B, H, J];
      H >= 3.
    joints: angles, radians, [B, J].
    limits: of the joints, radians, [J, 2].
    contact: feet on the ground, in the robot's order, 0 or 1, [B, F].
    clearance: of the soles over the ground, metres, [B, F].
    overhang: share of each sole's ends that are not over the ground under its
      middle, [B, F].
    sole_velocity: of the soles, vertical, m/s, [B, F].
    width: sideways from right soles to left ones, mean over the pairs, metres,
      [B].
    stance_width: likewise, in the standing pose.
    steady: whether the running mode is one pose, [B].
    grounded: whether the running mode has no flight, [B].
    straight: whether it steps with one foot at a time and neither turns nor
      goes sideways, [B].
  """

  actions: np.ndarray
  joints: np.ndarray
  limits: np.ndarray
  contact: np.ndarray
  clearance: np.ndarray
  overhang: np.ndarray
  sole_velocity: np.ndarray
  width: np.ndarray
  stance_width: float
  steady: np.ndarray
  grounded: np.ndarray
  straight: np.ndarray


def action_change(motion: Motion) -> np.ndarray:
  """Returns the mean squared change of the joint targets, rad^2, [B]."""
  change = motion.actions[:, 0] - motion.actions[:, 1]
  return np.mean(change**2, axis=1)


def action_acceleration(motion: Motion) -> np.ndarray:
  """Returns the mean square of their second difference, rad^2, [B]."""
  new, middle, old = motion.actions[:, :3].swapaxes(0, 1)
  return np.mean((new - 2 * middle + old) ** 2, axis=1)


def touch_down(motion: Motion) -> np.ndarray:
  """Returns squares of fast approaches to the ground, m^2/s^2, [B].

  Those of modes with a flight are as fast as its height makes them.
  """
  excess = np.maximum(-motion.sole_velocity - _SOFT_LANDING, 0.0)
  near = np.exp(-np.maximum(motion.clearance, 0.0) / _APPROACH)
  return np.where(motion.grounded, np.sum(near * excess**2, axis=1), 0.0)


def joint_limit(motion: Motion) -> np.ndarray:
  """Returns the summed squares of angles in the zones of limits, [B]."""
  low, high = motion.limits.T
  excess = np.maximum(motion.joints - high, low - motion.joints) + _NEAR_LIMIT
  return np.sum((np.maximum(excess, 0.0) / _EXCESS) ** 2, axis=1)


def lifted_foot(motion: Motion) -> np.ndarray:
  """Returns the share of lifted feet in steady modes, [B]."""
  return np.where(motion.steady, 1.0 - motion.contact.mean(axis=1), 0.0)


def foothold(motion: Motion) -> np.ndarray:
  """Returns the mean overhang of feet that stand near an edge, [B]."""
  return np.mean(motion.contact * motion.overhang, axis=1)


def straddle(motion: Motion) -> np.ndarray:
  """Returns how far straight gaits are off the stance's width, at most 1."""
  off = np.abs(motion.width - motion.stance_width)
  off = np.maximum(off - _WIDTH_SLACK, 0.0)
  cost = np.minimum(off / _STRADDLE, 1.0) ** 2
  return np.where(motion.straight, cost, 0.0)


Cost = Callable[[Motion], np.ndarray]


def _row(cost: Cost, default: float) -> Any:
  """Declares a cost, with the weight that a quiet training gives it."""
  return dataclasses.field(
    default=0.0, metadata={'cost': cost, 'weight': default}
  )


@config.dataclass
class CostWeights:
  """Weights of the costs, per unit of cost and control step.

  Attributes:
    action_change: of squared changes of the joint targets, 1/rad^2.
    action_acceleration: of squared changes of these changes, 1/rad^2.
    touch_down: of the squared excess of touch-downs over 0.5 m/s in modes
      without a flight, s^2/m^2.
    joint_limit: of joints within 3 degrees of a limit, or beyond.
    lifted_foot: of feet off the ground in steady modes.
    foothold: of standing feet with an end beyond an edge of the ground.
    straddle: of feet too far apart or too close in straight gaits.
  """

  action_change: config.NonNegative = _row(action_change, 1.0)
  action_acceleration: config.NonNegative = _row(action_acceleration, 0.25)
  touch_down: config.NonNegative = _row(touch_down, 0.15)
  joint_limit: config.NonNegative = _row(joint_limit, 0.15)
  lifted_foot: config.NonNegative = _row(lifted_foot, 0.2)
  foothold: config.NonNegative = _row(foothold, 0.1)
  straddle: config.NonNegative = _row(straddle, 0.1)

  @property
  def active(self) -> bool:
    """True if any weight is positive."""
    return any(getattr(self, name) for name in COSTS)


COSTS: Mapping[str, Cost] = {
  row.name: row.metadata['cost'] for row in dataclasses.fields(CostWeights)
}
NONE = CostWeights()
QUIET = CostWeights(
  **{
    row.name: row.metadata['weight'] for row in dataclasses.fields(CostWeights)
  }
)


def total(motion: Motion, weights: CostWeights) -> np.ndarray:
  """Returns the weighted sum of the costs, [B]."""
  result = np.zeros(len(motion.contact))
  for name, cost in COSTS.items():
    weight = getattr(weights, name)
    if weight:
      result += weight * cost(motion)
  return result
