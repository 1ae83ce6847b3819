"""Carries out plans again, to compare with where they once led to."""

from typing import Sequence

from dmc_multimode.arenas import track
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite.reaching import problem as reaching


def replay(
  policy: reaching.Policy,
  config: reaching.ReachingConfig,
  plan: plan_lib.ModePlan,
  pushes: Sequence[pushes_lib.Push] = (),
  arena: str = 'flat',
) -> problem_lib.Trials:
  """Returns where a plan leads to, in one world."""
  robot = problem_lib.ReachingProblem(
    policy, track.make(arena), config, 1, 1, pushes
  )
  return robot.rollout(plan.indices(robot.mode_set)[None])
