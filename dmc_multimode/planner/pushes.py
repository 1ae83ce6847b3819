"""Pushes on the way of a robot, unknown to the planner."""

import dataclasses
import math
import reprlib
from typing import Any, Sequence

import numpy as np

_TOLERANCE = 1e-6  # Seconds.
_MOST = 1e4  # Seconds or m/s; more is a mistake.


@dataclasses.dataclass(frozen=True)
class Push:
  """A sudden change of the trunk's velocity.

  Attributes:
    time: seconds since the start.
    velocity: added to the trunk's, world m/s (x, y, z).
  """

  time: float
  velocity: tuple[float, float, float]

  def __post_init__(self) -> None:
    if len(self.velocity) != 3 or not all(
      isinstance(number, (int, float))
      and not isinstance(number, bool)
      and abs(number) <= _MOST
      for number in (self.time, *self.velocity)
    ):
      raise ValueError(
        'A push is a time in seconds and a velocity (x, y, z) in m/s, got '
        f'{self.time!r} and {self.velocity!r}.'
      )


def parse(text: str) -> Push:
  """Parses 'SECONDS:VX' or 'SECONDS:VX:VY', m/s in the world.

  Raises:
    ValueError: with one line that quotes the text.
  """
  try:
    time, x, *rest = (float(number) for number in text.split(':'))
    (y,) = rest or (0.0,)
    return Push(time, (x, y, 0.0))
  except ValueError as error:
    raise ValueError(
      f'{text!r} is no push, which is SECONDS:VX or SECONDS:VX:VY in m/s.'
    ) from error


def to_list(pushes: Sequence[Push]) -> list[dict[str, Any]]:
  """Returns the pushes as JSON values."""
  return [
    {'time': push.time, 'velocity': list(push.velocity)} for push in pushes
  ]


def from_list(values: Any) -> tuple[Push, ...]:
  """Returns the pushes of a `to_list`.

  Raises:
    ValueError: a value is missing or of the wrong type.
  """
  try:
    return tuple(
      Push(value['time'], tuple(value['velocity'])) for value in values
    )
  except (KeyError, TypeError) as error:
    raise ValueError(f'These are no pushes: {reprlib.repr(values)}.') from error


def draw(
  speed: float,
  knots: int,
  knot_duration: float,
  seed: int,
  period: float = 1.0,
) -> tuple[Push, ...]:
  """Returns pushes in random horizontal directions, at knots.

  Args:
    speed: of each, m/s; no pushes at 0.
    knots: number of knots in the plan.
    knot_duration: seconds from knot to knot.
    seed: of the directions.
    period: seconds between pushes, about: a whole number of knots.
  """
  if not speed:
    return ()
  apart = max(round(period / knot_duration), 1)
  angles = np.random.RandomState(seed).uniform(0, 2 * np.pi, knots)
  return tuple(
    Push(
      knot * knot_duration,
      (
        float(speed * np.cos(angles[knot])),
        float(speed * np.sin(angles[knot])),
        0.0,
      ),
    )
    for knot in range(apart, knots, apart)
  )


def by_knot(
  pushes: Sequence[Push], knots: int, knot_duration: float
) -> dict[int, np.ndarray]:
  """Returns the velocities to add by knot, world m/s, each [3].

  Args:
    pushes: in any order; those of one knot add up.
    knots: number of knots in the plan.
    knot_duration: seconds from knot to knot.

  Raises:
    ValueError: a push is not at the time of one of these knots.
  """
  found: dict[int, np.ndarray] = {}
  for push in pushes:
    ratio = push.time / knot_duration
    is_finite = math.isfinite(ratio)  # Knots may be very short.
    knot = round(ratio) if is_finite else knots
    if is_finite and abs(knot * knot_duration - push.time) > _TOLERANCE:
      raise ValueError(
        f'The push at {push.time:g} s is not at a knot: there is one every '
        f'{knot_duration:g} s.'
      )
    if not 0 <= knot < knots:
      raise ValueError(
        f'The push at {push.time:g} s is outside of the plan, whose last knot '
        f'is at {(knots - 1) * knot_duration:g} s.'
      )
    found[knot] = found.get(knot, np.zeros(3)) + push.velocity
  return found
