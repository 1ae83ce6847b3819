"""Early ends of an imitation episode: pure, with a leading batch axis.

Early termination decides whether moving modes are learned at all. Orientation
alone earns half of the reward, so that a policy which stands still never falls
below a bound on the reward. The bound on the distance from the reference ends
its episodes, and in a mode that turns on the spot the bound on orientation.
"""

import dataclasses

import numpy as np

from dmc_multimode.utils import config
from dmc_multimode.utils import constants

# Files hold the indices.
CAUSES = (
  'none',
  'position_error',
  'low_reward',
  'base_height',
  'non_finite',
  'orientation_error',
)
POSITION_ERROR, LOW_REWARD, BASE_HEIGHT, NON_FINITE, ORIENTATION_ERROR = range(
  1, len(CAUSES)
)


@config.dataclass
class TerminationLimits:
  """Bounds whose crossing ends an episode.

  Attributes:
    distance: of the trunk from its reference, metres.
    reward: lower bound of the reward of a step.
    height: lower bound of the trunk centre over its support, metres.
    angle: of the trunk's orientation from its reference, radians; pi for none.
  """

  distance: config.Limit = constants.TRACKING_DISTANCE
  reward: config.Limit = 0.3
  height: config.Limit = 0.22
  angle: config.Limit = constants.TRACKING_ANGLE


# With these, only a state that is not finite ends an episode.
NO_LIMITS = TerminationLimits(np.inf, -np.inf, -np.inf, np.pi)


def falls_alone(limits: TerminationLimits) -> TerminationLimits:
  """Returns limits of which only `height` of `limits` is left: falls."""
  return dataclasses.replace(
    limits, distance=np.inf, reward=-np.inf, angle=np.pi
  )


def termination_cause(
  distance: np.ndarray,
  orientation: np.ndarray,
  reward: np.ndarray,
  height: np.ndarray,
  finite: np.ndarray,
  limits: TerminationLimits,
  distance_slack: float | np.ndarray = 0.0,
) -> np.ndarray:
  """Returns the cause of each world's end, an index into `CAUSES`, [B].

  Args:
    distance: of the trunk from its reference, metres, [B].
    orientation: error of the trunk, sin^2(angle / 2), see `rewards`, [B].
    reward: of this step, [B].
    height: of the trunk over its support, metres, [B].
    finite: whether the state is finite, [B].
    limits: the bounds.
    distance_slack: added to the bound on the distance, metres, [B] or one for
      all.
  """
  cause = np.zeros(len(distance), dtype=np.int8)
  # The last assignment wins, so the most telling cause comes last.
  cause[reward < limits.reward] = LOW_REWARD
  cause[orientation > np.sin(limits.angle / 2) ** 2] = ORIENTATION_ERROR
  cause[distance > limits.distance + distance_slack] = POSITION_ERROR
  cause[height < limits.height] = BASE_HEIGHT
  cause[~finite] = NON_FINITE
  return cause
