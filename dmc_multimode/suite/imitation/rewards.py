"""The imitation reward, Eq. 3 of Krishna and Nguyen: pure, batched.

    r = sum_o w_o exp(-k_o er_o)

over the terms o of `RewardGains`: the position and the orientation of the trunk
and the contacts of the feet, each against the reference.
"""

import dataclasses
from typing import Any, Callable, Mapping, NamedTuple

import numpy as np

from dmc_multimode.modes import reference as reference_lib
from dmc_multimode.utils import config

_PRECISE = 5.0  # Sensitivities of `precision` over those of Eq. 3.


class RobotState(NamedTuple):
  """Robot states that tracking errors are computed from.

  Attributes:
    qpos: free joint (world position in metres, quaternion), then the joints in
      radians, [B, 7 + J].
    qvel: free joint (world linear velocity in m/s, angular velocity in the
      trunk frame in rad/s), then the joints in rad/s, [B, 6 + J].
    orientation: of the trunk relative to the commanded heading, unit
      quaternions (w, x, y, z), [B, 4].
    contact: feet on the ground, in the robot's order, 0 or 1, [B, F].
  """

  qpos: np.ndarray
  qvel: np.ndarray
  orientation: np.ndarray
  contact: np.ndarray


Error = Callable[[RobotState, reference_lib.Reference], np.ndarray]


def position_error(
  robot: RobotState, reference: reference_lib.Reference
) -> np.ndarray:
  """Returns the distances of the trunks from their references, metres, [B]."""
  distance = robot.qpos[:, :3] - reference.position
  return np.sqrt(_dot(distance, distance))


def orientation_error(
  robot: RobotState, reference: reference_lib.Reference
) -> np.ndarray:
  """Returns 1 - <q, q_ref>^2, [B], as in the authors' released code.

  This is the squared sine of half the angle between the two.
  """
  agreement = _dot(robot.orientation, reference.orientation)
  return 1.0 - np.minimum(agreement**2, 1.0)


def contact_error(
  robot: RobotState, reference: reference_lib.Reference
) -> np.ndarray:
  """Returns Euclidean distances of the binary contact states, [B].

  The error is 0 where the mode prescribes no contacts.
  """
  difference = robot.contact - reference.contact
  distance = np.sqrt(_dot(difference, difference))
  return np.where(reference.has_contact, distance, 0.0)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Returns the scalar products of rows, [B]; faster than a sum over them."""
  return np.einsum('bi,bi->b', a, b)


@config.dataclass
class Gain:
  """The gains of one term of Eq. 3.

  Attributes:
    weight: scaling gain w (Table I).
    sensitivity: k, in one over the unit of the term's error.
  """

  weight: config.NonNegative
  sensitivity: config.NonNegative


def _term(error: Error, weight: float, sensitivity: float) -> Any:
  """Declares a term of the reward: the field of `RewardGains` is its name."""
  return dataclasses.field(
    default=Gain(weight, sensitivity), metadata={'error': error}
  )


@config.dataclass
class RewardGains:
  """Gains of Eq. 3, one row a term: error er, weight w, sensitivity k."""

  position: Gain = _term(position_error, 0.5, 5.0)  # k in 1/m.
  orientation: Gain = _term(orientation_error, 0.5, 5.0)
  contact: Gain = _term(contact_error, 0.0, 2.0)

  @property
  def highest(self) -> float:
    """Largest reward of a step: the sum of the weights."""
    return float(sum(getattr(self, name).weight for name in ERRORS))

  def with_weights(self, **weights: float) -> 'RewardGains':
    """Returns the gains with other weights, given by term."""
    changes = {
      name: dataclasses.replace(getattr(self, name), weight=weight)
      for name, weight in weights.items()
    }
    return dataclasses.replace(self, **changes)


ERRORS: Mapping[str, Error] = {
  field.name: field.metadata['error']
  for field in dataclasses.fields(RewardGains)
}


def tracking_errors(
  robot: RobotState, reference: reference_lib.Reference
) -> dict[str, np.ndarray]:
  """Returns the errors er_o of all terms by name, [B] each."""
  return {name: error(robot, reference) for name, error in ERRORS.items()}


def reward_terms(
  errors: Mapping[str, np.ndarray], gains: RewardGains
) -> dict[str, np.ndarray]:
  """Returns the terms w exp(-k er) of Eq. 3 by name, [B]; r is their sum."""
  return {
    name: gain.weight * np.exp(-gain.sensitivity * error)
    for name, error in errors.items()
    for gain in (getattr(gains, name),)
  }


def precision(
  errors: Mapping[str, np.ndarray], gains: RewardGains
) -> np.ndarray:
  """Returns how precise the pose of the trunk is, in [0, 1], [B].

  The product of the exponentials of Eq. 3 for position and orientation, five
  times as sensitive: near the reference it is steep where Eq. 3 is flat. As a
  product, it does not trade the one for the other.

  Args:
    errors: er_o of the terms by name, [B] each.
    gains: of Eq. 3.
  """
  exponent = sum(
    getattr(gains, name).sensitivity * errors[name]
    for name in ('position', 'orientation')
  )
  return np.exp(-_PRECISE * exponent)
