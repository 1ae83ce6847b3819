"""When an imitation episode ends early: pure, with a leading batch axis.

Early termination decides whether moving modes are learned at all. Orientation
alone pays half of the reward, so that a policy which stands still in every mode
never meets a bound on the reward; the bound on the distance from the reference
is what it meets, and in a mode that turns on the spot that on the orientation.
"""

from typing import NamedTuple

import numpy as np

CAUSES = ('none', 'lost', 'reward', 'fallen', 'invalid', 'turned')  # By index.
LOST, REWARD, FALLEN, INVALID, TURNED = range(1, len(CAUSES))


class TerminationLimits(NamedTuple):
  """Bounds whose crossing ends an episode.

  Attributes:
    distance: of the base from its reference, metres.
    reward: lower bound.
    height: lower bound of the trunk centre over its support, metres.
    angle: of the base's orientation from its reference, radians; pi for none.
  """

  distance: float = 0.35
  reward: float = 0.3
  height: float = 0.22
  angle: float = 1.0


# Nothing but a state that is not finite ends an episode with these.
NO_LIMITS = TerminationLimits(np.inf, -np.inf, -np.inf, np.pi)


def falls_alone(limits: TerminationLimits) -> TerminationLimits:
  """Returns limits that forgive a robot everything but to fall."""
  return limits._replace(distance=np.inf, reward=-np.inf, angle=np.pi)


def termination_cause(
  distance: np.ndarray,
  orientation: np.ndarray,
  reward: np.ndarray,
  height: np.ndarray,
  finite: np.ndarray,
  limits: TerminationLimits,
) -> np.ndarray:
  """Returns why each world terminates, as an index into `CAUSES`, [B].

  Args:
    distance: of the base from its reference, metres, [B].
    orientation: error of the base, sin^2(angle / 2), see `rewards`, [B].
    reward: of this step, [B].
    height: of the trunk over its support, metres, [B].
    finite: whether the state is finite, [B].
    limits: the bounds.
  """
  cause = np.zeros(len(distance), dtype=np.int8)
  # The last assignment wins, so the most telling cause comes last.
  cause[reward < limits.reward] = REWARD
  cause[orientation > np.sin(limits.angle / 2) ** 2] = TURNED
  cause[distance > limits.distance] = LOST
  cause[height < limits.height] = FALLEN
  cause[~finite] = INVALID
  return cause
