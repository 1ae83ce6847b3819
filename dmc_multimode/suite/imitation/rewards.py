"""The imitation reward (Eq. 3): pure functions with a leading batch axis."""

from typing import NamedTuple

import numpy as np

_CLEARANCE = 0.05  # Metres: as high as a swinging foot needs to be.


class RewardGains(NamedTuple):
  """Scaling gains w (Table I) and sensitivity gains k of Eq. 3."""

  position_weight: float = 0.5
  orientation_weight: float = 0.5
  contact_weight: float = 0.0
  position_sensitivity: float = 5.0  # 1/m
  orientation_sensitivity: float = 5.0
  contact_sensitivity: float = 2.0

  @property
  def highest(self) -> float:
    """The reward of a perfect step: the sum of the weights."""
    return self.position_weight + self.orientation_weight + self.contact_weight


class TrackingErrors(NamedTuple):
  """How far the robot is from its reference, [B] each.

  Attributes:
    position: distance of the base from its reference, metres.
    orientation: 1 - <q, q_ref>^2, which is the squared sine of half the angle
      between the two, as in the authors' released code.
    contact: Euclidean distance of the binary contact states; 0 where the mode
      prescribes none.
  """

  position: np.ndarray
  orientation: np.ndarray
  contact: np.ndarray


def tracking_errors(
  position: np.ndarray,
  orientation: np.ndarray,
  contact: np.ndarray,
  reference_position: np.ndarray,
  reference_orientation: np.ndarray,
  reference_contact: np.ndarray,
  has_contact: np.ndarray,
) -> TrackingErrors:
  """Compares base poses and contacts with their references, in one frame.

  Args:
    position, reference_position: metres, [B, 3].
    orientation, reference_orientation: unit quaternions (w, x, y, z), [B, 4].
    contact, reference_contact: feet on the ground (left, right), [B, 2].
    has_contact: whether the reference prescribes contacts, [B].
  """
  agreement = _dot(orientation, reference_orientation)
  distance = position - reference_position
  difference = contact - reference_contact
  return TrackingErrors(
    np.sqrt(_dot(distance, distance)),
    1.0 - np.minimum(agreement**2, 1.0),
    np.where(has_contact, np.sqrt(_dot(difference, difference)), 0.0),
  )


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Returns the scalar products of rows, [B]; faster than a sum over them."""
  return np.einsum('bi,bi->b', a, b)


def reward_terms(
  errors: TrackingErrors, gains: RewardGains
) -> dict[str, np.ndarray]:
  """Returns the weighted terms of Eq. 3 by name, [B] each; r is their sum."""
  term = lambda weight, sensitivity, error: (
    weight * np.exp(-sensitivity * error)
  )
  return {
    'position': term(
      gains.position_weight, gains.position_sensitivity, errors.position
    ),
    'orientation': term(
      gains.orientation_weight,
      gains.orientation_sensitivity,
      errors.orientation,
    ),
    'contact': term(
      gains.contact_weight, gains.contact_sensitivity, errors.contact
    ),
  }


def footing(
  contact: np.ndarray,
  clearance: np.ndarray,
  reference_contact: np.ndarray,
  has_contact: np.ndarray,
) -> np.ndarray:
  """How well feet do what their reference's do, in [0, 1], [B].

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
