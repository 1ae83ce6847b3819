"""Mode plans: a zero-order spline of modes over knots, and their files.

The plans are those of Krishna and Nguyen, Sec. II-E: at each of k knots, dt
seconds apart, one mode is commanded, and it holds to the next.
"""

import dataclasses
import math
import os
import pathlib
import reprlib
from typing import Any, Mapping, NamedTuple, Self, Sequence

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
  """Conditions that a plan was made for, and what happened on the way.

  Attributes:
    arena: name of the track.
    sizes: of the track, metres, where they are not its defaults.
    seed: of the track, if it is random, and of the initial state's noise.
    pushes: that the robot met.
  """

  arena: str
  sizes: Mapping[str, float] = {}
  seed: int = 0
  pushes: tuple[pushes_lib.Push, ...] = ()


@dataclasses.dataclass(frozen=True)
class PlanFile:
  """A plan with its course: reads and writes what is on disk.

  Attributes:
    plan: which mode when.
    course: the track, and pushes at knots of the plan.
    details: what else the file tells, JSON-able: where the plan led to, and how
      it was found.
  """

  plan: ModePlan
  course: Course
  details: Mapping[str, Any] = dataclasses.field(default_factory=dict)

  def to_dict(self) -> dict[str, Any]:
    """Returns the JSON-able values of the file."""
    return {
      **self.details,
      'plan': list(self.plan.modes),
      'knots': len(self.plan.modes),
      'dt': self.plan.knot_duration,
      'arena': self.course.arena,
      'sizes': dict(self.course.sizes),
      'seed': self.course.seed,
      'pushes': pushes_lib.to_list(self.course.pushes),
    }

  @classmethod
  def from_dict(cls, values: Any) -> Self:
    """Returns what `to_dict` was called of.

    Raises:
      ValueError: a value is missing or of the wrong kind, the number of knots
        is not that of the modes, or a push is not at one of them.
    """
    plan = _read_plan(values)
    course = _read_course(values)
    pushes_lib.by_knot(course.pushes, len(plan.modes), plan.knot_duration)
    known = {'plan', 'knots', 'dt', *Course._fields}
    rest = {key: value for key, value in values.items() if key not in known}
    return cls(plan, course, rest)

  def write(self, path: str | os.PathLike[str]) -> None:
    """Writes the file, whole or not at all; missing folders are made."""
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_json(path, self.to_dict())

  @classmethod
  def read(cls, path: str | os.PathLike[str]) -> Self:
    """Reads a file.

    Raises:
      FileNotFoundError: there is none.
      ValueError: it holds no plan and its course.
    """
    path = pathlib.Path(path)
    if not path.is_file():
      raise FileNotFoundError(f'There is no plan {path}.')
    values = files.read_json(path, _MAX_BYTES)
    try:
      return cls.from_dict(values)
    except ValueError as error:
      raise ValueError(f'{path}: {error}') from error


@dataclasses.dataclass(frozen=True)
class PlanResult:
  """A plan and what it led to, by itself in one world.

  Attributes:
    plan: the best plan that was found, or what was commanded on the way.
    course: what it was made for.
    goal: of the trunk, world metres, [3].
    success: true where the robot ends at the goal and never fell.
    episode_return: sum of exp(-|goal - p|) over the control steps.
    path: of the trunk after every control step, world metres, [T, 3].
    solve_seconds: from the first roll-out to the last.
    rollouts: plans that the searches tried; a beam search tries its parts.
    control_steps: of all worlds that were searched in or tried in, together.
    origin: how it was found, JSON-able: planner, policy and the like.
  """

  plan: ModePlan
  course: Course
  goal: tuple[float, float, float]
  success: bool
  episode_return: float
  path: np.ndarray
  solve_seconds: float
  rollouts: int
  control_steps: int
  origin: Mapping[str, Any] = dataclasses.field(default_factory=dict)

  @property
  def final_position(self) -> np.ndarray:
    """Of the trunk, world metres, [3]."""
    return self.path[-1]

  def file(self) -> PlanFile:
    """Returns the values that are written to disk."""
    details = {
      'success': self.success,
      'final_position': self.final_position.tolist(),
      'goal': list(self.goal),
      'return': self.episode_return,
      'solve_seconds': self.solve_seconds,
      'rollouts': self.rollouts,
      'control_steps': self.control_steps,
      **self.origin,
    }
    return PlanFile(self.plan, self.course, details)

  def save(self, path: str | os.PathLike[str]) -> None:
    """Writes the plan's file; see `PlanFile.write`."""
    self.file().write(path)


def from_indices(
  indices: Sequence[int] | np.ndarray,
  names: Sequence[str],
  knot_duration: float,
) -> ModePlan:
  """Returns the plan of mode indices into `names`."""
  return ModePlan(tuple(names[int(i)] for i in indices), knot_duration)


def _read_plan(values: Any) -> ModePlan:
  """Returns the plan that the content of a file tells."""
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


def _read_course(values: Mapping[str, Any]) -> Course:
  """Returns what the content of a file tells about track and pushes."""
  arena, sizes, seed = (values.get(key) for key in ('arena', 'sizes', 'seed'))
  if (
    not isinstance(arena, str)
    or not isinstance(sizes, dict)
    or not all(isinstance(size, (int, float)) for size in sizes.values())
    or not isinstance(seed, int)
    or seed < 0
  ):
    raise ValueError('The plan does not say for which arena, sizes and seed.')
  pushes = pushes_lib.from_list(values.get('pushes', []))
  return Course(arena, sizes, seed, pushes)
