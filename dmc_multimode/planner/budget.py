"""Wall-clock budgets of plannings."""

import contextlib
import math
from typing import Callable, Iterator


class Budget:
  """Wall-clock time of a planning.

  Attributes:
    limited: whether there is a limit.
  """

  def __init__(self, seconds: float | None, clock: Callable[[], float]):
    """Starts the time.

    Args:
      seconds: limit; None for none.
      clock: returns the current time, seconds.
    """
    self.limited = seconds is not None
    self._seconds = math.inf if seconds is None else seconds
    self._clock, self._began = clock, clock()

  @property
  def spent(self) -> float:
    """Seconds since the start; with a limit, without those of `pause`."""
    return self._clock() - self._began

  @property
  def left(self) -> float:
    """Seconds until the limit."""
    return self._seconds - self.spent

  @contextlib.contextmanager
  def pause(self) -> Iterator[None]:
    """Stops the time meanwhile, if there is a limit."""
    began = self._clock()
    yield
    if self.limited:
      self._began += self._clock() - began
