"""From a track and a goal to a plan: one call for every planner."""

import time
from typing import Callable, NamedTuple

import numpy as np

from dmc_multimode.arenas import track as track_lib
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import search
from dmc_multimode.suite import reaching

PlannerConfig = search.BeamConfig | q_learning.QLearningConfig
Report = Callable[[int, float, float], None]
_CANDIDATES = 10  # Plans that are tried alone until one succeeds.


class Found(NamedTuple):
  """A plan and what it led to, by itself in one world.

  Attributes:
    plan: the best plan.
    success: whether the robot stands at the goal in the end and never fell.
    episode_return: sum of exp(-|goal - p|) over the control steps.
    path: of the trunk after every control step, metres, [T, 3].
    solve_seconds: from the first roll-out to the last.
    rollouts: plans that were tried; a beam search tries its parts.
    control_steps: of all worlds together.
  """

  plan: plan_lib.ModePlan
  success: bool
  episode_return: float
  path: np.ndarray
  solve_seconds: float
  rollouts: int
  control_steps: int

  @property
  def final_position(self) -> np.ndarray:
    """Of the trunk, world metres, [3]."""
    return self.path[-1]


def num_worlds(config: PlannerConfig, num_modes: int) -> int:
  """Returns how many worlds a planner runs at once."""
  if isinstance(config, search.BeamConfig):
    return config.beams * num_modes
  return config.trials


class Solver:
  """A planner on its problem, compiled and ready to run."""

  def __init__(
    self,
    policy: reaching.Policy,
    make_arena: Callable[[], track_lib.Track],
    config: reaching.ReachingConfig,
    planner: PlannerConfig,
    num_threads: int = 0,
  ):
    """Compiles the worlds.

    Args:
      policy: turns mode commands into motion.
      make_arena: returns the track anew, for worlds of its own.
      config: goal and knots.
      planner: which planner, and how.
      num_threads: of the physics; 0 takes every core.

    Raises:
      ValueError: the goal is not over the track, or a knot is no whole number
        of control steps.
    """
    self._planner = planner
    count = num_worlds(planner, len(policy.motions))
    self._problem, self._alone = (
      problem_lib.ReachingProblem(policy, make_arena(), config, worlds, threads)
      for worlds, threads in ((count, num_threads), (1, 1))
    )

  def solve(self, report: Report = lambda *args: None) -> Found:
    """Finds a plan; the best that was found if none succeeds.

    Args:
      report: progress; see `search.beam_search` and `q_learning.q_learning`.
    """
    problem, alone = self._problem, self._alone
    problem.control_steps = alone.control_steps = 0
    began = time.perf_counter()
    if isinstance(self._planner, search.BeamConfig):
      solution = search.beam_search(problem, self._planner, report)
    else:
      solution = q_learning.q_learning(problem, self._planner, report)
    plan, trial = _best_alone(alone, solution)
    return Found(
      plan,
      bool(trial.success[0]),
      float(trial.returns[0]),
      trial.paths[0],
      time.perf_counter() - began,
      solution.episodes,
      problem.control_steps + alone.control_steps,
    )


def replay(
  policy: reaching.Policy,
  arena: track_lib.Track,
  config: reaching.ReachingConfig,
  plan: plan_lib.ModePlan,
) -> problem_lib.Trials:
  """Runs a plan in one world, as `Solver` did in the end, bit for bit.

  Raises:
    ValueError: the plan has other knots than `config`, or commands a mode that
      the policy does not know.
  """
  if (len(plan.modes), plan.knot_duration) != (
    config.knots,
    config.knot_duration,
  ):
    raise ValueError('The plan has other knots than the problem.')
  alone = problem_lib.ReachingProblem(policy, arena, config, 1, 1)
  return alone.rollout(plan.indices(alone.bank)[None])


def _best_alone(
  alone: problem_lib.ReachingProblem, solution: search.Solution
) -> tuple[plan_lib.ModePlan, problem_lib.Trials]:
  """Returns the first plan that succeeds by itself, or else the first."""
  tried = []
  for indices in solution.plans[:_CANDIDATES]:
    tried.append((indices, alone.rollout(indices[None])))
    if tried[-1][1].success[0]:
      break
  else:
    del tried[1:]
  indices, trial = tried[-1]
  plan = plan_lib.from_indices(
    indices, alone.bank.names, alone.config.knot_duration
  )
  return plan, trial
