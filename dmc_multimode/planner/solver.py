"""Solver: a planner on a track and goal, with trials of its plans."""

import contextlib
import os
import time
from typing import (
  Callable,
  Hashable,
  Iterable,
  Iterator,
  Mapping,
  NamedTuple,
  Protocol,
  Sequence,
  TYPE_CHECKING,
)

import numpy as np

from dmc_multimode.arenas import track as track_lib
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import budget as budget_lib
from dmc_multimode.planner import guided_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import config as config_lib

if TYPE_CHECKING:
  from dmc_multimode.planner import selector as selector_lib


class SearchConfig(Hashable, Protocol):
  """Configuration of a search; all of `PLANNERS` but the selector's are."""

  @property
  def description(self) -> str:
    """Name of the search, for its progress."""

  def num_worlds(self, num_modes: int) -> int:
    """Returns the number of worlds that the search takes."""

  def rounds(self, knots: int) -> int:
    """Returns the number of reports of a search over so many knots."""

  def search(
    self,
    problem: problem_lib.ReachingProblem,
    selector: 'selector_lib.Selector | None',
    report: Callable[[int, float, float], None],
    stop: Callable[[float], bool],
  ) -> beam_search.Solution:
    """Searches plans; see `beam_search.beam_search`.

    Args:
      problem: worlds at their start.
      selector: of a guided search; others do without.
      report: is told rounds, the best return and the least distance, metres.
      stop: returns True if there is no time for so many seconds of a plan. Ends
        searches that have a budget.
    """


PlannerConfig = SearchConfig | steering.SteeringConfig
PLANNERS: Mapping[str, PlannerConfig] = {  # By name, with their defaults.
  'beam': beam_search.BeamConfig(),
  'guided': guided_search.GuidedConfig(),
  'q_learning': q_learning.QLearningConfig(),
  'selector': steering.SteeringConfig(),
}
_ANYTIME = (beam_search.BeamConfig, guided_search.GuidedConfig)
_CANDIDATES = 10  # Plans tried in one world until one succeeds.
_CAUTION = 1.25  # Time reserved for a replay, relative to the estimate.


class Status(NamedTuple):
  """Progress of a search.

  Attributes:
    search: description of the search.
    done, total: knots of a beam or guided search, episodes of a Q-learning.
    best: return of the best plan so far.
    distance: least final distance from the goal along x, metres.
  """

  search: str
  done: int
  total: int
  best: float
  distance: float


Report = Callable[[Status], None]


def name_of(config: PlannerConfig) -> str:
  """Returns the planner's name in `PLANNERS`."""
  return next(
    name for name, other in PLANNERS.items() if type(other) is type(config)
  )


def default_name(policy: str | os.PathLike[str] | reaching.Policy) -> str:
  """Returns the name of the planner that suits a policy best.

  Args:
    policy: a name, a folder, or the policy itself.

  Raises:
    FileNotFoundError: there is no such policy.
  """
  if isinstance(policy, (str, os.PathLike)) and steering.is_beside(policy):
    return 'guided'
  return 'beam'


@config_lib.dataclass
class _Limit:
  """Checked value of a budget, in seconds."""

  seconds: config_lib.Positive | None


def check_seconds(seconds: float | None, planner: PlannerConfig) -> None:
  """Raises ValueError for a budget that `Solver` would not take.

  Args:
    seconds: positive and finite, or None.
    planner: a beam or guided search, unless `seconds` is None.
  """
  _Limit(seconds)
  if seconds is not None and not isinstance(planner, _ANYTIME):
    raise ValueError(
      'seconds is a budget of the beam search and the guided one, not of '
      f'{name_of(planner)}, which ends with its episodes.'
    )


class _Tried(NamedTuple):
  """A plan, mode indices [K], and its replay in a single separate world."""

  indices: np.ndarray
  trial: problem_lib.Trials

  def worth(self) -> tuple[bool, bool, float]:
    """Returns the sort key: success, no fall, return."""
    trial = self.trial
    return bool(trial.success[0]), bool(trial.alive[0]), float(trial.returns[0])


class Solver:
  """A planner on its problem, compiled and ready to run."""

  def __init__(
    self,
    policy: reaching.Policy,
    arena: str,
    config: reaching.ReachingConfig,
    planner: SearchConfig,
    num_threads: int = 0,
    sizes: Mapping[str, float] | None = None,
    seconds: float | None = None,
    clock: Callable[[], float] = time.perf_counter,
    selector: 'selector_lib.Selector | None' = None,
    map_error: float = 0.0,
  ):
    """Compiles the worlds.

    Args:
      policy: turns mode commands into motion.
      arena: name of the track.
      config: goal and knots.
      planner: configuration, whose class selects the planner.
      num_threads: of the physics; 0 takes every core.
      sizes: of the track, metres, where they are not its defaults.
      seconds: wall-clock budget of every `solve`; None for none.
      clock: returns the current wall-clock time, seconds.
      selector: that guides a guided search, whose knots are the selector's.
      map_error: by which all edges are nearer where plans are searched and
        tried than where robots are, metres.

    Raises:
      ValueError: a guided search has no selector, the track is unknown, the
        goal is not over it, a knot is not a whole number of control steps, or
        the planner takes no such budget.
    """
    check_seconds(seconds, planner)
    if isinstance(planner, guided_search.GuidedConfig) and selector is None:
      raise ValueError('A guided search needs a selector.')
    self._policy, self._selector = policy, selector
    self._map_error = map_error
    self._planner, self._seconds, self._clock = planner, seconds, clock
    self._course = plan_lib.Course(arena, dict(sizes or {}), config.seed)
    if selector:
      config = reaching.in_knots(config, selector.knot_duration)
    self._config, self._num_threads = config, num_threads
    self._problems: dict[SearchConfig, problem_lib.ReachingProblem] = {}
    self._problem(next(iter(self._searches())))
    self._alone = self.make_robot()
    # Wall-clock seconds a control step of the single world, and a simulated
    # second of a search's world, as last measured.
    self._pace = self._search_pace = 0.0

  def _searches(self) -> Iterable[SearchConfig]:
    """Returns the configurations of the searches, each for one attempt."""
    if not isinstance(self._planner, _ANYTIME):
      return [self._planner]
    if self._seconds is None:
      return self._planner.escalation()
    return self._planner.doubling()

  def make_robot(
    self,
    pushes: Sequence[pushes_lib.Push] = (),
    disturbed: events_lib.TrainingEvents = events_lib.NONE,
  ) -> problem_lib.ReachingProblem:
    """Returns a single world at the start, for replays of plans.

    Args:
      pushes: on the robot.
      disturbed: of this robot and its ground; plans are for the nominal one.

    Raises:
      ValueError: a push is not at a knot.
    """
    return problem_lib.ReachingProblem(
      self._policy,
      self._make_arena(),
      self._config,
      1,
      1,
      pushes,
      disturbed=disturbed,
    )

  def _make_arena(self) -> track_lib.Track:
    """Returns a new instance of the track."""
    return track_lib.make(self._course.arena, sizes=self._course.sizes)

  def solve(
    self,
    report: Report = lambda status: None,
    robot: problem_lib.ReachingProblem | None = None,
    guess: np.ndarray | None = None,
  ) -> plan_lib.PlanResult:
    """Returns the best plan; the search ends when one succeeds.

    With a budget it also ends in time for a last replay, in mid-search if need
    be, but not before one plan has been tried. The budget is checked at knots.
    Compilation of worlds does not count, nor is it part of the result's
    `solve_seconds` then.

    Args:
      report: progress of the searches.
      robot: world whose state is the start, with its remaining knots; the start
        of the track by default. It does not move.
      guess: a plan for these knots, mode indices, [K]; if it succeeds, it is
        returned without a search.
    """
    robot = robot or self.make_robot()
    budget, steps = (
      budget_lib.Budget(self._seconds, self._clock),
      self._control_steps(),
    )
    self._alone.begin_at(robot, self._map_error)
    if budget.limited and not self._pace:
      with self._timing():
        self._alone.run_knot(np.array([self._alone.rest_mode]))
    tried, rollouts = [] if guess is None else [self._try(guess)], 0
    for planner in self._searches():
      worlds = planner.num_worlds(len(self._policy.mode_set))
      least = beam_search.least_work(self._config.knot_duration, worlds)
      if tried and (
        tried[-1].trial.success[0] or self._is_late(budget, worlds * least)
      ):
        break
      solution = self._search(planner, robot, report, budget)
      rollouts += solution.episodes
      tried += self._try_some(solution, budget)
    indices, trial = max(tried, key=_Tried.worth)
    return self.result(
      indices,
      trial,
      budget.spent,
      rollouts,
      self._control_steps() - steps,
    )

  def result(
    self,
    indices: Sequence[int] | np.ndarray,
    trial: problem_lib.Trials,
    solve_seconds: float,
    rollouts: int,
    control_steps: int,
    pushes: Sequence[pushes_lib.Push] = (),
  ) -> plan_lib.PlanResult:
    """Packs a plan and its trial into a `PlanResult`.

    Args:
      indices: of the modes, [K].
      trial: replay in one world.
      solve_seconds, rollouts, control_steps: see `plan.PlanResult`.
      pushes: on the robot.
    """
    return pack(
      self._alone,
      self._course._replace(pushes=tuple(pushes)),
      indices,
      trial,
      solve_seconds,
      rollouts,
      control_steps,
    )

  def _problem(self, planner: SearchConfig) -> problem_lib.ReachingProblem:
    """Returns the worlds of a planner, compiled in the first call."""
    if planner not in self._problems:
      self._problems[planner] = problem_lib.ReachingProblem(
        self._policy,
        self._make_arena(),
        self._config,
        planner.num_worlds(len(self._policy.mode_set)),
        self._num_threads,
      )
    return self._problems[planner]

  def _control_steps(self) -> int:
    """Returns the control steps of all worlds so far."""
    problems = [*self._problems.values(), self._alone]
    return sum(problem.control_steps for problem in problems)

  def _search(
    self,
    planner: SearchConfig,
    robot: problem_lib.ReachingProblem,
    report: Report,
    budget: budget_lib.Budget,
  ) -> beam_search.Solution:
    """Runs one search from the robot's state."""
    with budget.pause():
      problem = self._problem(planner)
    problem.begin_at(robot, self._map_error)
    began = (self._config.knots - problem.knots) * self._config.knot_duration
    name, total = planner.description, planner.rounds(problem.knots)
    tell = lambda *row: report(
      Status(f'{name} from {began:.2f} s', row[0], total, *row[1:])
    )
    stop = self._stopper(problem.num_worlds, budget)
    return planner.search(problem, self._selector, tell, stop)

  def _stopper(
    self, worlds: int, budget: budget_lib.Budget
  ) -> Callable[[float], bool]:
    """Returns the `stop` of a beam search that begins now; measures its pace.

    Args:
      worlds: number of worlds of the search.
      budget: of the planning.
    """
    last = budget.spent

    def stop(ahead: float) -> bool:
      nonlocal last
      before, last = last, budget.spent
      simulated = worlds * self._config.knot_duration
      self._search_pace = (last - before) / simulated
      return self._is_late(budget, worlds * ahead)

    return stop

  def _try_some(
    self, solution: beam_search.Solution, budget: budget_lib.Budget
  ) -> list[_Tried]:
    """Replays the best plans in one world until one succeeds.

    The search has left time for the first; others have to be in time.
    """
    tried: list[_Tried] = []
    for indices in solution.plans[:_CANDIDATES]:
      tried.append(self._try(indices))
      if tried[-1].trial.success[0] or self._is_late(budget):
        break
    return tried

  def _try(self, indices: np.ndarray) -> _Tried:
    """Replays a plan in a single separate world."""
    with self._timing():
      return _Tried(indices, self._alone.rollout(indices[None]))

  def _is_late(self, budget: budget_lib.Budget, work: float = 0.0) -> bool:
    """Returns whether the time left is too short for a replay.

    Args:
      budget: of the planning.
      work: of a search before it, simulated seconds summed over its worlds.
    """
    replay = _CAUTION * self._pace * self._alone.plan_steps
    return budget.left < self._search_pace * work + replay

  @contextlib.contextmanager
  def _timing(self) -> Iterator[None]:
    """Measures the single world's pace meanwhile."""
    began, steps = self._clock(), self._alone.control_steps
    yield
    steps = self._alone.control_steps - steps
    if steps:  # A robot that has fallen takes none, and no time.
      self._pace = (self._clock() - began) / steps


def pack(
  robot: problem_lib.ReachingProblem,
  course: plan_lib.Course,
  indices: Sequence[int] | np.ndarray,
  trial: problem_lib.Trials,
  solve_seconds: float,
  rollouts: int,
  control_steps: int,
) -> plan_lib.PlanResult:
  """Packs a plan and its trial into a `PlanResult`.

  Args:
    robot: of the trial.
    course: track and pushes.
    indices: of the modes, [K].
    trial: in one world.
    solve_seconds, rollouts, control_steps: see `plan.PlanResult`.
  """
  return plan_lib.PlanResult(
    plan_lib.from_indices(
      indices, robot.mode_set.names, robot.config.knot_duration
    ),
    course,
    robot.config.goal,
    bool(trial.success[0]),
    float(trial.returns[0]),
    trial.paths[0],
    len(trial.paths[0]) * robot.control_timestep,
    float(trial.speed[0]),
    solve_seconds,
    rollouts,
    control_steps,
  )
