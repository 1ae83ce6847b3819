"""Mode plans: a zero-order spline of modes over knots, and their files.

The plans are those of Krishna and Nguyen, Sec. II-E: at each of k knots, dt
seconds apart, one mode is commanded, and it holds to the next. After the last
one the robot rests: it has reached the goal if it then stands there.
"""

import dataclasses
import itertools
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

REST = 1.5  # Seconds of the rest after a plan.
_REST_MODE = 'idle'
_MAX_BYTES = 1 << 20  # Larger files are rejected.
_MAX_KNOTS = 10_000


@dataclasses.dataclass(frozen=True)
class ModePlan:
  """Modes by knot.

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
    """Returns the modes as indices into a mode set, [K].

    Raises:
      ValueError: the set lacks a mode; the message lists its modes.
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
    """Returns the modes without repetitions and their durations, seconds.

    Durations are without the rounding of sums: 0.45, not 0.44999999999999996.
    """
    runs = [
      (name, len(list(run))) for name, run in itertools.groupby(self.modes)
    ]
    return [name for name, _ in runs], [
      round(knots * self.knot_duration, 9) for _, knots in runs
    ]


class Course(NamedTuple):
  """Conditions of a plan: the track, its seed, and pushes.

  Attributes:
    arena: name of the track.
    sizes: of the track, metres, where they are not its defaults.
    seed: of the track, if it is random, and of the initial state's noise.
    pushes: met by the robot.
  """

  arena: str
  sizes: Mapping[str, float] = {}
  seed: int = 0
  pushes: tuple[pushes_lib.Push, ...] = ()


@dataclasses.dataclass(frozen=True)
class PlanFile:
  """A plan with its course, and its JSON file.

  Attributes:
    plan: modes by knot.
    course: track and pushes.
    details: further JSON values: result and origin of the plan.
  """

  plan: ModePlan
  course: Course
  details: Mapping[str, Any] = dataclasses.field(default_factory=dict)

  def to_dict(self) -> dict[str, Any]:
    """Returns the JSON values of the file."""
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
    """Returns the `PlanFile` of a `to_dict`.

    Raises:
      ValueError: a value is missing or of the wrong type, the number of knots
        is not that of the modes, or a push is not at a knot.
    """
    plan = _read_plan(values)
    course = _read_course(values)
    pushes_lib.by_knot(course.pushes, len(plan.modes), plan.knot_duration)
    known = {'plan', 'knots', 'dt', *Course._fields}
    rest = {key: value for key, value in values.items() if key not in known}
    return cls(plan, course, rest)

  def write(self, path: str | os.PathLike[str]) -> None:
    """Writes the file atomically; missing folders are made."""
    path = pathlib.Path(files.expand(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_json(path, self.to_dict())

  @classmethod
  def read(cls, path: str | os.PathLike[str]) -> Self:
    """Reads a file.

    Raises:
      FileNotFoundError: the file does not exist.
      ValueError: the file does not hold a plan with its course.
    """
    path = pathlib.Path(files.expand(path))
    if not path.is_file():
      raise FileNotFoundError(f'There is no plan {path}.')
    values = files.read_json(path, _MAX_BYTES)
    try:
      return cls.from_dict(values)
    except ValueError as error:
      raise ValueError(f'{path}: {error}') from error


@dataclasses.dataclass(frozen=True)
class PlanResult:
  """A plan and its replay in a single separate world.

  Attributes:
    plan: the best plan found or, with replanning, the modes commanded.
    course: conditions of the plan.
    goal: of the trunk, world metres, [3].
    success: whether the robot stands at the goal in the end.
    episode_return: sum of exp(-|goal - p|) over the control steps of the knots.
    path: of the trunk after every control step of the knots and of the rest
      after them, world metres, [T, 3].
    seconds: from the first command to the end of the rest.
    final_speed: of the trunk, m/s.
    solve_seconds: from the first roll-out to the last; with a budget of seconds
      without the compilation of worlds in between.
    rollouts: number of plans, or parts of plans, that were rolled out.
    control_steps: sum over all worlds of searches and replays.
    origin: planner, policy and the like, JSON values.
  """

  plan: ModePlan
  course: Course
  goal: tuple[float, float, float]
  success: bool
  episode_return: float
  path: np.ndarray
  seconds: float
  final_speed: float
  solve_seconds: float
  rollouts: int
  control_steps: int
  origin: Mapping[str, Any] = dataclasses.field(default_factory=dict)

  def __repr__(self) -> str:
    """Returns one line: the track, the modes and the end."""
    segments = zip(*self.plan.segments(), strict=True)
    modes = ','.join(f'{name}:{seconds:g}' for name, seconds in segments)
    fate = 'reached' if self.success else 'not reached'
    return f'PlanResult({self.course.arena}, goal {fate}; {modes})'

  @property
  def final_position(self) -> np.ndarray:
    """Last position of the trunk, world metres, [3]."""
    return self.path[-1]

  def file(self) -> PlanFile:
    """Returns the plan as a file, with results as details."""
    details = {
      'reached': self.success,
      'final_position': self.final_position.tolist(),
      'final_speed': self.final_speed,
      'seconds': self.seconds,
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


def rest_mode(mode_set: mode_set_lib.ModeSet) -> int:
  """Returns the index of the mode in which robots rest: idle, or the first."""
  names = mode_set.names
  return names.index(_REST_MODE) if _REST_MODE in names else 0


def from_indices(
  indices: Sequence[int] | np.ndarray,
  names: Sequence[str],
  knot_duration: float,
) -> ModePlan:
  """Returns the plan of mode indices into `names`."""
  return ModePlan(tuple(names[int(i)] for i in indices), knot_duration)


def _read_plan(values: Any) -> ModePlan:
  """Returns the plan of a file's content."""
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
  except OverflowError as error:  # An integer too large for a float.
    raise ValueError(f'Not a plan: {error}.') from error
  if knots != len(modes):
    raise ValueError(
      f'Not a plan: {len(modes)} modes for {reprlib.repr(knots)} knots.'
    )
  return plan


def _read_course(values: Mapping[str, Any]) -> Course:
  """Returns the track and pushes of a file's content."""
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
