"""Solver: a planner on a track and goal, with trials of its plans."""

import time
from typing import Callable, Mapping, NamedTuple, Sequence

import numpy as np

from dmc_multimode.arenas import track as track_lib
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.suite.reaching import problem as reaching

PlannerConfig = beam_search.BeamConfig | q_learning.QLearningConfig
PLANNERS: Mapping[str, PlannerConfig] = {  # By name, with their defaults.
  'beam': beam_search.BeamConfig(),
  'q_learning': q_learning.QLearningConfig(),
}
_CANDIDATES = 10  # Plans tried in one world until one succeeds.


class Status(NamedTuple):
  """Progress of a search.

  Attributes:
    search: description of the search.
    done, total: knots of a beam search, episodes of a Q-learning.
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
  return 'beam' if isinstance(config, beam_search.BeamConfig) else 'q_learning'


def num_worlds(config: PlannerConfig, num_modes: int) -> int:
  """Returns the number of worlds of a planner."""
  if isinstance(config, beam_search.BeamConfig):
    return config.beams * num_modes
  return config.trials


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
    planner: PlannerConfig,
    num_threads: int = 0,
    sizes: Mapping[str, float] | None = None,
  ):
    """Compiles the worlds.

    Args:
      policy: turns mode commands into motion.
      arena: name of the track.
      config: goal and knots.
      planner: configuration, whose class selects the planner.
      num_threads: of the physics; 0 takes every core.
      sizes: of the track, metres, where they are not its defaults.

    Raises:
      ValueError: the track is unknown, the goal is not over it, or a knot is
        not a whole number of control steps.
    """
    self._policy = policy
    self._course = plan_lib.Course(arena, dict(sizes or {}), config.seed)
    self._config, self._num_threads = config, num_threads
    self._searches = (
      planner.escalation()
      if isinstance(planner, beam_search.BeamConfig)
      else [planner]
    )
    self._problems: dict[PlannerConfig, problem_lib.ReachingProblem] = {}
    self._problem(self._searches[0])
    self._alone = self.make_robot()

  def make_robot(
    self, pushes: Sequence[pushes_lib.Push] = ()
  ) -> problem_lib.ReachingProblem:
    """Returns a single world at the start, for replays of plans.

    Args:
      pushes: on the robot.

    Raises:
      ValueError: a push is not at a knot.
    """
    return problem_lib.ReachingProblem(
      self._policy, self._make_arena(), self._config, 1, 1, pushes
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

    Args:
      report: progress of the searches.
      robot: world whose state is the start, with its remaining knots; the start
        of the track by default. It does not move.
      guess: a plan for these knots, mode indices, [K]; if it succeeds, it is
        returned without a search.
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
    """Packs a plan and its trial into a `PlanResult`.

    Args:
      indices: of the modes, [K].
      trial: replay in one world.
      solve_seconds, rollouts, control_steps: see `plan.PlanResult`.
      pushes: on the robot.
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
      len(trial.paths[0]) * self._alone.control_timestep,
      float(trial.speed[0]),
      solve_seconds,
      rollouts,
      control_steps,
    )

  def _problem(self, planner: PlannerConfig) -> problem_lib.ReachingProblem:
    """Returns the worlds of a planner, compiled in the first call."""
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
    """Returns the control steps of all worlds so far."""
    problems = [*self._problems.values(), self._alone]
    return sum(problem.control_steps for problem in problems)

  def _search(
    self,
    planner: PlannerConfig,
    robot: problem_lib.ReachingProblem,
    report: Report,
  ) -> beam_search.Solution:
    """Runs one search from the robot's state."""
    problem = self._problem(planner)
    problem.begin_at(robot)
    began = (self._config.knots - problem.knots) * self._config.knot_duration
    if isinstance(planner, beam_search.BeamConfig):
      name, total = f'{planner.beams} beams', problem.knots
    else:
      name, total = f'{planner.trials} trials', planner.episodes
    tell = lambda *row: report(
      Status(f'{name} from {began:.2f} s', row[0], total, *row[1:])
    )
    if isinstance(planner, beam_search.BeamConfig):
      return beam_search.beam_search(problem, planner, tell)
    return q_learning.q_learning(problem, planner, tell)

  def _try_some(self, solution: beam_search.Solution) -> list[_Tried]:
    """Replays the best plans in one world until one succeeds."""
    tried: list[_Tried] = []
    for indices in solution.plans[:_CANDIDATES]:
      tried.append(self._try(indices))
      if tried[-1].trial.success[0]:
        break
    return tried

  def _try(self, indices: np.ndarray) -> _Tried:
    """Replays a plan in a single separate world."""
    return _Tried(indices, self._alone.rollout(indices[None]))
