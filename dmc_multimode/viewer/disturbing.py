"""Disturbances of the robot of a live session, as sliders set them."""

import dataclasses
from typing import Mapping, NamedTuple

from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import events
from dmc_multimode.utils import schedule

_PUSHES = 'push_speed'  # Of `TrainingEvents`; all others of `Disturbances`.


class Range(NamedTuple):
  """Values of a slider.

  Attributes:
    low, high: its ends.
    step: between its values.
    label: for people, with the unit.
  """

  low: float
  high: float
  step: float
  label: str


RANGES: Mapping[str, Range] = {
  'action_delay': Range(0.0, 0.06, 0.005, 'delay, s'),
  'friction': Range(0.1, 1.2, 0.05, 'friction'),
  'payload': Range(0.0, 4.0, 0.1, 'payload, kg'),
  'motor_strength': Range(0.5, 1.2, 0.05, 'motor strength'),
  _PUSHES: Range(0.0, 2.0, 0.1, 'random pushes, m/s'),
}


def value(of: events.TrainingEvents, name: str) -> float:
  """Returns one of `RANGES` in the result of `events.fixed`."""
  if name == _PUSHES:
    return of.push_speed.first
  return float(getattr(of.disturbances, name)[0])


NOMINAL: Mapping[str, float] = {
  name: value(events.NONE, name) for name in RANGES
}


def changed(
  of: events.TrainingEvents, **values: float
) -> events.TrainingEvents:
  """Returns events with other values of some of `RANGES`.

  Raises:
    ValueError: there is none of that name, or a number is out of bounds.
  """
  unknown = [name for name in values if name not in RANGES]
  if unknown:
    raise ValueError(f'{unknown[0]} is none of {", ".join(RANGES)}.')
  fixed: disturbances.Disturbances = of.disturbances.fixed(
    **{name: number for name, number in values.items() if name != _PUSHES}
  )
  speed = values.get(_PUSHES, value(of, _PUSHES))
  return dataclasses.replace(
    of, disturbances=fixed, push_speed=schedule.constant(speed)
  )
