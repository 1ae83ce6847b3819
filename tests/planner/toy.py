"""A point on a line in place of a robot, and a clock that tests move."""

import numpy as np

from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.suite.reaching import problem as reaching

# Metres that the modes move: none, a step, a jump.
STRIDES = np.array([0.0, 0.2, 0.5])
_HOLE = (0.55, 0.85)  # Who is here at a knot has fallen.
_REST_KNOTS = 5  # Knots that take as long as the rest.


class Clock:
  """Clock whose time passes only where work is done.

  Attributes:
    now: seconds.
  """

  def __init__(self) -> None:
    self.now = 0.0

  def __call__(self) -> float:
    return self.now


class Toy:
  """A point that steps and jumps along x; stands in for ReachingProblem.

  A knot of a world takes a second of the clock, and one control step.
  """

  control_timestep = 0.3
  rest_mode = 0

  def __init__(
    self,
    num_worlds: int,
    knots: int = 6,
    goal: float = 1.6,
    clock: Clock | None = None,
  ):
    self.config = reaching.ReachingConfig((goal, 0.0, 0.5), knots)
    self.num_worlds, self.num_modes = num_worlds, len(STRIDES)
    self.knots = self.remaining = knots
    self.control_steps = 0
    self._clock = clock or Clock()
    self._start = 0.0, True
    self.reset()

  @property
  def plan_steps(self) -> int:
    return self.knots + _REST_KNOTS

  @property
  def phase(self) -> np.ndarray:
    return np.zeros(self.num_worlds)

  def begin_at(self, other: 'Toy', map_error: float = 0.0) -> None:
    assert not map_error
    self._start = float(other.x[0]), bool(other.alive[0])
    self.knots = other.remaining
    self.reset()

  def reset(self) -> None:
    x, alive = self._start
    self.x = np.full(self.num_worlds, x)
    self.alive = np.full(self.num_worlds, alive)
    self.remaining = self.knots

  def copy_state(self, sources: np.ndarray) -> None:
    self.x, self.alive = self.x[sources], self.alive[sources]

  def run_knot(self, modes: np.ndarray) -> problem_lib.Progress:
    self.x = self.x + STRIDES[modes]
    self.alive = self.alive & ~((self.x > _HOLE[0]) & (self.x < _HOLE[1]))
    self.remaining -= 1
    self._work(1, self.num_worlds)
    distance = np.abs(self.config.goal[0] - self.x)
    return problem_lib.Progress(
      np.where(self.alive, np.exp(-distance), 0.0),
      self._path(),
      self.alive.copy(),
    )

  def rest(self, moved: np.ndarray | None = None) -> problem_lib.Rest:
    worlds = self.num_worlds if moved is None else int(moved.sum())
    self._work(_REST_KNOTS, worlds)
    return problem_lib.Rest(
      self._path(),
      np.zeros(self.num_worlds),
      self.alive.copy(),
      self._there() & (True if moved is None else moved),
    )

  def rollout(self, plans: np.ndarray) -> problem_lib.Trials:
    self.reset()
    knots = [self.run_knot(modes) for modes in plans.T]
    return problem_lib.trials(knots, self.rest())

  def _there(self) -> np.ndarray:
    return self.alive & (np.abs(self.config.goal[0] - self.x) < 0.05)

  def _work(self, knots: int, worlds: int) -> None:
    self.control_steps += knots * worlds
    self._clock.now += knots * worlds

  def _path(self) -> np.ndarray:
    path = np.zeros((1, self.num_worlds, 3))
    path[0, :, 0] = self.x
    return path


def return_of(plan: np.ndarray) -> float:
  """Returns the return of a plan, [K]."""
  toy = Toy(1, len(plan))
  return float(sum(toy.run_knot(mode[None]).reward[0] for mode in plan))


def is_alive(plan: np.ndarray) -> bool:
  """Returns whether a plan, [K], is without a fall."""
  return bool(Toy(1, len(plan)).rollout(plan[None]).alive[0])


assert _REST_KNOTS == plan_lib.REST / Toy.control_timestep
