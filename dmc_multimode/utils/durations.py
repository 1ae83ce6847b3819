"""Durations as numbers of control steps, by one formula.

Both engines, all wrappers, schedules and plans count their steps here, so that
a time limit is as long everywhere.
"""

import math
import sys
from typing import Any

import numpy as np

UNBOUNDED = sys.maxsize  # Control steps that are never reached.
_MOST = 1e15  # Steps beyond this are never reached.
_TOLERANCE = 1e-6  # Seconds.


def steps(seconds: Any, period: float) -> np.ndarray:
  """Returns the nearest whole numbers of control steps, int64.

  Args:
    seconds: durations of any shape; infinite ones are `UNBOUNDED` steps.
    period: seconds of a control step.
  """
  ratio = np.asarray(seconds, dtype=np.float64) / period
  is_bounded = ratio < _MOST
  whole = np.rint(np.where(is_bounded, ratio, 0.0)).astype(np.int64)
  return np.where(is_bounded, whole, UNBOUNDED)


def whole_steps(seconds: float, period: float, name: str) -> int:
  """Returns the number of control steps of a duration that has to be whole.

  Args:
    seconds: the duration.
    period: seconds of a control step.
    name: of the duration, for the error.

  Raises:
    ValueError: it is not a positive whole number of control steps.
  """
  count = int(steps(seconds, period))
  if not 1 <= count < _MOST or abs(count * period - seconds) > _TOLERANCE:
    raise ValueError(
      f'{name} of {seconds:g} s is no multiple of the control step, '
      f'{period:g} s.'
    )
  return count


def dm_control_limit(count: int, period: float) -> float:
  """Returns the time limit at which dm_control ends after `count` steps.

  dm_control compares the limit with the physics' clock, which adds up rounding
  errors; half a control step early, they do not matter.

  Args:
    count: control steps, or `UNBOUNDED`.
    period: seconds of a control step.
  """
  return math.inf if count == UNBOUNDED else (count - 0.5) * period
