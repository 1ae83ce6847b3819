"""Survival of a robot: how long it stays up, and how often it falls."""

from typing import NamedTuple


class Survival(NamedTuple):
  """Survival since a count began.

  Attributes:
    up: seconds since the last fall, or since the count began.
    falls: number of falls.
    seconds: on its feet in all.
  """

  up: float
  falls: int
  seconds: float

  @property
  def falls_per_minute(self) -> float:
    """Falls in a minute on its feet; 0 before the first one."""
    return 60 * self.falls / self.seconds if self.falls else 0.0


class SurvivalCount:
  """Counts seconds and falls.

  Attributes:
    now: what was counted.
  """

  def __init__(self) -> None:
    """Begins a count."""
    self.restart()

  def restart(self) -> None:
    """Begins a new count, as for another robot or ground."""
    self.now = Survival(0.0, 0, 0.0)

  def stand(self, seconds: float) -> None:
    """Counts time on its feet."""
    up, falls, total = self.now
    self.now = Survival(up + seconds, falls, total + seconds)

  def fall(self) -> None:
    """Counts a fall."""
    self.now = self.now._replace(up=0.0, falls=self.now.falls + 1)
