"""Mode plans: a zero-order spline of modes over knots (Sec. II-E)."""

import dataclasses
import math
import pathlib
import reprlib
from typing import Any, Mapping, NamedTuple, Sequence

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.utils import files

_MAX_BYTES = 1 << 20  # Larger files are no plans.
_MAX_KNOTS = 10_000


@dataclasses.dataclass(frozen=True)
class ModePlan:
  """Which mode is commanded at which knot.

  Attributes:
    modes: names, one a knot.
    knot_duration: seconds from knot to knot.
  """

  modes: tuple[str, ...]
  knot_duration: float

  def __post_init__(self) -> None:
    object.__setattr__(self, 'modes', tuple(self.modes))
    if not 0 < len(self.modes) <= _MAX_KNOTS:
      raise ValueError(
        f'A plan has 1 to {_MAX_KNOTS} knots, got {len(self.modes)}.'
      )
    for name in self.modes:
      if not (isinstance(name, str) and name):
        raise ValueError(
          f'A plan is of names of modes, got {reprlib.repr(name)}.'
        )
    if not (math.isfinite(self.knot_duration) and self.knot_duration > 0):
      raise ValueError(
        f'Knots must last longer than 0 s, got {self.knot_duration}.'
      )

  @property
  def duration(self) -> float:
    """Seconds from the first knot to the end."""
    return len(self.modes) * self.knot_duration

  def indices(self, mode_set: mode_set_lib.ModeSet) -> np.ndarray:
    """Returns the plan in the indices of a mode set, [K].

    Raises:
      ValueError: the set lacks a mode; the message lists those that it has.
    """
    missing = [name for name in self.modes if name not in mode_set.names]
    if missing:
      raise ValueError(
        f'The plan commands {missing[0]!r}, which the policy does not know; '
        f'it knows {", ".join(mode_set.names)}.'
      )
    return np.array([mode_set.index(name) for name in self.modes])

  def schedule(
    self, mode_set: mode_set_lib.ModeSet
  ) -> schedule_lib.ModeSchedule:
    """Returns the plan as the schedule of one world."""
    return schedule_lib.from_knots(self.indices(mode_set), self.knot_duration)

  def segments(self) -> tuple[list[str], list[float]]:
    """Returns the modes without repetitions and for how long each runs, s."""
    names: list[str] = []
    durations: list[float] = []
    for name in self.modes:
      if names and names[-1] == name:
        durations[-1] += self.knot_duration
      else:
        names.append(name)
        durations.append(self.knot_duration)
    return names, durations


class Course(NamedTuple):
  """What a plan was made for, and what happened on the way.

  Attributes:
    arena: name of the track.
    sizes: of the track, metres, where they are not its defaults.
    seed: of the track, if it is random.
    pushes: that the robot met.
  """

  arena: str
  sizes: Mapping[str, float]
  seed: int
  pushes: tuple[pushes_lib.Push, ...] = ()


def from_indices(
  indices: Sequence[int] | np.ndarray,
  names: Sequence[str],
  knot_duration: float,
) -> ModePlan:
  """Returns the plan of mode indices into `names`."""
  return ModePlan(tuple(names[int(i)] for i in indices), knot_duration)


def to_dict(plan: ModePlan) -> dict[str, Any]:
  """Returns the plan as JSON-able values."""
  return {
    'plan': list(plan.modes),
    'knots': len(plan.modes),
    'dt': plan.knot_duration,
  }


def from_dict(values: Mapping[str, Any]) -> ModePlan:
  """Returns what `to_dict` was given; other keys are ignored.

  Raises:
    ValueError: a value is missing or of the wrong kind, or the number of knots
      is not that of the modes.
  """
  try:
    modes, knots, dt = values['plan'], values['knots'], values['dt']
  except (KeyError, TypeError) as error:
    raise ValueError(f'Not a plan: it lacks {error}.') from error
  if not isinstance(modes, list):
    raise ValueError('Not a plan: its modes are no list.')
  if isinstance(dt, bool) or not isinstance(dt, (int, float)):
    raise ValueError(f'Not a plan: dt is {reprlib.repr(dt)}, not seconds.')
  try:
    plan = ModePlan(tuple(modes), float(dt))
  except OverflowError as error:  # An integer of hundreds of digits.
    raise ValueError(f'Not a plan: {error}.') from error
  if knots != len(modes):
    raise ValueError(
      f'Not a plan: {len(modes)} modes for {reprlib.repr(knots)} knots.'
    )
  return plan


def course(values: Mapping[str, Any]) -> Course:
  """Returns what the content of a plan file says about its track and pushes.

  Raises:
    ValueError: something is missing or of the wrong kind, or a push is not at
      one of the plan's knots.
  """
  arena, sizes, seed = (values.get(key) for key in ('arena', 'sizes', 'seed'))
  if (
    not isinstance(arena, str)
    or not isinstance(sizes, dict)
    or not all(isinstance(size, (int, float)) for size in sizes.values())
    or not isinstance(seed, int)
    or seed < 0
  ):
    raise ValueError('The plan does not say for which arena, sizes and seed.')
  plan = from_dict(values)
  pushes = pushes_lib.from_list(values.get('pushes', []))
  pushes_lib.by_knot(pushes, len(plan.modes), plan.knot_duration)
  return Course(arena, sizes, seed, pushes)


def read(path: pathlib.Path) -> dict[str, Any]:
  """Returns the content of a plan file; its plan is known to be one.

  Raises:
    FileNotFoundError: there is no such file.
    ValueError: it holds no plan.
  """
  if not path.is_file():
    raise FileNotFoundError(f'There is no plan {path}.')
  values = files.read_json(path, _MAX_BYTES)
  try:
    from_dict(values)
  except ValueError as error:
    raise ValueError(f'{path}: {error}') from error
  return values
