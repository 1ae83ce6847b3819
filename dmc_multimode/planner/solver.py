"""Finds a plan from a track and a goal: one call for every planner."""

import time
from typing import Callable, Mapping, NamedTuple, Sequence

import numpy as np

from dmc_multimode.arenas import track as track_lib
from dmc_multimode.planner import beam_search as search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.suite.reaching import problem as reaching

PlannerConfig = search.BeamConfig | q_learning.QLearningConfig
PLANNERS: Mapping[str, PlannerConfig] = {  # By name, with their defaults.
  'beam': search.BeamConfig(),
  'q_learning': q_learning.QLearningConfig(),
}
_CANDIDATES = 10  # Plans that are tried alone until one succeeds.


class Status(NamedTuple):
  """Progress of a search.

  Attributes:
    search: which one, for people.
    done, total: knots of a beam search, episodes of a Q-learning.
    best: return of the best plan so far.
    distance: least distance from the goal along x at an end, metres.
  """

  search: str
  done: int
  total: int
  best: float
  distance: float


Report = Callable[[Status], None]


def name_of(config: PlannerConfig) -> str:
  """Returns the planner's name in `PLANNERS`."""
  return 'beam' if isinstance(config, search.BeamConfig) else 'q_learning'


def num_worlds(config: PlannerConfig, num_modes: int) -> int:
  """Returns how many worlds a planner runs at once."""
  if isinstance(config, search.BeamConfig):
    return config.beams * num_modes
  return config.trials


class _Tried(NamedTuple):
  """A plan, mode indices [K], and how it went alone."""

  indices: np.ndarray
  trial: problem_lib.Trials

  def worth(self) -> tuple[bool, bool, float]:
    """Sorts by success, then by who stands, then by return."""
    trial = self.trial
    return bool(trial.success[0]), bool(trial.alive[0]), float(trial.returns[0])


class Solver:
  """A planner on its problem, compiled and ready to run."""

  def __init__(
    self,
    policy: reaching.Policy,
    arena: str,
    config: reaching.ReachingConfig,
    planner: PlannerConfig,
    num_threads: int = 0,
    sizes: Mapping[str, float] | None = None,
  ):
    """Compiles the worlds.

    Args:
      policy: turns mode commands into motion.
      arena: name of the track.
      config: goal and knots.
      planner: which planner, and how.
      num_threads: of the physics; 0 takes every core.
      sizes: of the track, metres, where they are not its defaults.

    Raises:
      ValueError: the track is unknown, the goal is not over it, or a knot is no
        whole number of control steps.
    """
    self._policy = policy
    self._course = plan_lib.Course(arena, dict(sizes or {}), config.seed)
    self._config, self._num_threads = config, num_threads
    self._searches = (
      planner.escalation()
      if isinstance(planner, search.BeamConfig)
      else [planner]
    )
    self._problems: dict[PlannerConfig, problem_lib.ReachingProblem] = {}
    self._problem(self._searches[0])
    self._alone = self.make_robot()

  def make_robot(
    self, pushes: Sequence[pushes_lib.Push] = ()
  ) -> problem_lib.ReachingProblem:
    """Returns a single world at the start, to carry out plans in.

    Args:
      pushes: that it will meet.

    Raises:
      ValueError: a push is not at a knot.
    """
    return problem_lib.ReachingProblem(
      self._policy, self._make_arena(), self._config, 1, 1, pushes
    )

  def _make_arena(self) -> track_lib.Track:
    """Returns the track anew, for worlds of its own."""
    return track_lib.make(self._course.arena, sizes=self._course.sizes)

  def solve(
    self,
    report: Report = lambda status: None,
    robot: problem_lib.ReachingProblem | None = None,
    guess: np.ndarray | None = None,
  ) -> plan_lib.PlanResult:
    """Finds a plan; the best that was found if none succeeds.

    Args:
      report: progress of the searches.
      robot: where it is, the plan begins, for the knots that are left; at the
        start without one. It does not move.
      guess: a plan for those knots, mode indices, [K]; if it succeeds, it is
        the one, and nothing is searched.
    """
    robot = robot or self.make_robot()
    began, steps = time.perf_counter(), self._control_steps()
    self._alone.begin_at(robot)
    tried, rollouts = [] if guess is None else [self._try(guess)], 0
    for planner in self._searches:
      if tried and tried[-1].trial.success[0]:
        break
      solution = self._search(planner, robot, report)
      rollouts += solution.episodes
      tried += self._try_some(solution)
    indices, trial = max(tried, key=_Tried.worth)
    return self.result(
      indices,
      trial,
      time.perf_counter() - began,
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
    """Returns what is told of a plan.

    Args:
      indices: of the modes, [K].
      trial: of one world.
      solve_seconds, rollouts, control_steps: see `plan.PlanResult`.
      pushes: that the robot met.
    """
    return plan_lib.PlanResult(
      plan_lib.from_indices(
        indices, self._alone.mode_set.names, self._config.knot_duration
      ),
      self._course._replace(pushes=tuple(pushes)),
      self._config.goal,
      bool(trial.success[0]),
      float(trial.returns[0]),
      trial.paths[0],
      solve_seconds,
      rollouts,
      control_steps,
    )

  def _problem(self, planner: PlannerConfig) -> problem_lib.ReachingProblem:
    """Returns the worlds for a planner, compiled when first asked for."""
    if planner not in self._problems:
      self._problems[planner] = problem_lib.ReachingProblem(
        self._policy,
        self._make_arena(),
        self._config,
        num_worlds(planner, len(self._policy.mode_set)),
        self._num_threads,
      )
    return self._problems[planner]

  def _control_steps(self) -> int:
    """Of all worlds since they were compiled."""
    problems = [*self._problems.values(), self._alone]
    return sum(problem.control_steps for problem in problems)

  def _search(
    self,
    planner: PlannerConfig,
    robot: problem_lib.ReachingProblem,
    report: Report,
  ) -> search.Solution:
    """Runs one search from where the robot is."""
    problem = self._problem(planner)
    problem.begin_at(robot)
    began = (self._config.knots - problem.knots) * self._config.knot_duration
    if isinstance(planner, search.BeamConfig):
      name, total = f'{planner.beams} beams', problem.knots
    else:
      name, total = f'{planner.trials} trials', planner.episodes
    tell = lambda *row: report(
      Status(f'{name} from {began:.2f} s', row[0], total, *row[1:])
    )
    if isinstance(planner, search.BeamConfig):
      return search.beam_search(problem, planner, tell)
    return q_learning.q_learning(problem, planner, tell)

  def _try_some(self, solution: search.Solution) -> list[_Tried]:
    """Tries the best plans alone, until one succeeds."""
    tried: list[_Tried] = []
    for indices in solution.plans[:_CANDIDATES]:
      tried.append(self._try(indices))
      if tried[-1].trial.success[0]:
        break
    return tried

  def _try(self, indices: np.ndarray) -> _Tried:
    """Tries a plan alone."""
    return _Tried(indices, self._alone.rollout(indices[None]))
