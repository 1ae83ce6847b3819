"""Schedules: values that depend on environment steps."""

import dataclasses
import re
from typing import Annotated, Any, Literal

import pydantic

from dmc_multimode.utils import config

_TEXT = re.compile(
  r'(?P<first>[^:@]+)(:(?P<last>[^:@]+))?'
  r'(@(?P<start>[^:@]+)(:(?P<end>[^:@]+))?)?'
)


@config.dataclass
class Schedule:
  """A value as a function of environment steps, summed over all worlds.

  The value is `first` before `start`, `last` from `end` on, and interpolated
  between them. With `start` equal to `end` it jumps.

  Attributes:
    first: value at the beginning.
    last: value at the end.
    start, end: environment steps.
    interpolation: 'linear', or 'geometric' for positive values.
  """

  first: float
  last: float
  start: config.Count = 0
  end: config.Count = 0
  interpolation: Literal['linear', 'geometric'] = 'linear'

  def __post_init__(self) -> None:
    if self.start > self.end:
      raise ValueError(
        f'a schedule cannot end at step {self.end:,}, before it starts at '
        f'{self.start:,}'
      )
    if self.interpolation == 'geometric' and min(self.first, self.last) <= 0:
      raise ValueError('a geometric schedule needs positive values')

  @property
  def largest(self) -> float:
    """Greatest value that it takes."""
    return max(self.first, self.last)

  def at_end(self) -> 'Schedule':
    """Returns the schedule that is always `last`."""
    return constant(self.last)

  def at(self, steps: int) -> float:
    """Returns the value after `steps` environment steps."""
    share = self.share(steps)
    if share == 1.0:
      return self.last
    if self.interpolation == 'geometric':
      return float(self.first * (self.last / self.first) ** share)
    return self.first + share * (self.last - self.first)

  def share(self, steps: int) -> float:
    """Returns the interpolation weight of `last` after `steps`, in [0, 1]."""
    if steps >= self.end:
      return 1.0
    return max(steps - self.start, 0) / max(self.end - self.start, 1)

  def __str__(self) -> str:
    """Returns the text that `parse` reads, but for the interpolation."""
    if self.first == self.last:
      return f'{self.first:g}'
    text = f'{self.first:g}:{self.last:g}@{self.start}'
    return text if self.start == self.end else f'{text}:{self.end}'


def constant(value: float) -> Schedule:
  """Returns the schedule that is always `value`."""
  return Schedule(value, value)


def step(value: float, start: int) -> Schedule:
  """Returns the schedule that is 0 before `start`, and `value` from then on."""
  return Schedule(0.0, value, start, start)


def parse(text: str) -> Schedule:
  """Parses a schedule `FIRST[:LAST][@START[:END]]`.

  `0.5` is constant, `0:0.5@8e6` jumps after 8 million steps,
  `0.5:0.1@10e6:14e6` moves from 10 to 14 million.

  Raises:
    ValueError: the text is not a schedule; the message shows the form.
  """
  match = _TEXT.fullmatch(text.strip())
  try:
    if match is None:
      raise ValueError
    first = float(match['first'])
    start = float(match['start'] or 0)
    last = first if match['last'] is None else float(match['last'])
    end = start if match['end'] is None else float(match['end'])
    if start % 1 or end % 1:
      raise ValueError
    between = int(start), int(end)
  except (OverflowError, ValueError) as error:
    raise ValueError(
      f'{text!r} is no schedule FIRST[:LAST][@START[:END]], such as 0.5, '
      '0:0.5@8e6 or 0.5:0.1@10e6:14e6'
    ) from error
  return Schedule(first, last, *between)


def _convert(value: Any) -> Any:
  """Returns the schedule of a number, or of a text for `parse`."""
  if isinstance(value, str):
    return parse(value)
  if type(value) in (int, float):
    return constant(value)
  return value


def _convert_geometric(value: Any) -> Any:
  """Returns the geometric schedule of a number or text."""
  value = _convert(value)
  if isinstance(value, Schedule):
    return dataclasses.replace(value, interpolation='geometric')
  if isinstance(value, dict):
    return {**value, 'interpolation': 'geometric'}
  return value


def _check_share(value: Schedule) -> Schedule:
  if not 0 <= min(value.first, value.last) <= value.largest <= 1:
    raise ValueError(f'a share is in [0, 1], got {value}')
  return value


# Types of fields; they accept numbers and texts.
ScheduleField = Annotated[Schedule, pydantic.BeforeValidator(_convert)]
ShareField = Annotated[ScheduleField, pydantic.AfterValidator(_check_share)]
GeometricField = Annotated[
  Schedule, pydantic.BeforeValidator(_convert_geometric)
]
