"""Planning again on the way, from where the robot is: a receding horizon.

A planner knows the robot's state at the knot at which it plans, and nothing of
what pushes it later. It plans to the end, the robot follows for some knots, and
it plans again. As long as the rest of the former plan still succeeds by itself,
it is kept: then nothing unexpected has happened.
"""

from typing import Sequence

import numpy as np

from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import solver as planning


def solve(
  solver: planning.Solver,
  pushes: Sequence[pushes_lib.Push] = (),
  every: int = 0,
  report: planning.Report = lambda status: None,
) -> planning.Found:
  """Brings a robot to the goal; plans before and, maybe, on the way.

  Args:
    solver: plans.
    pushes: that the robot meets, each right after the planning at its knot.
    every: knots after which it plans again; 0 for never, an open loop.
    report: progress of the searches.

  Returns:
    The modes that were commanded and where they led to, pushes included; the
    costs are those of all plannings.

  Raises:
    ValueError: `every` is negative, or a push is not at a knot.
  """
  if every < 0:
    raise ValueError(f'replan_every must not be negative, got {every}.')
  robot = solver.make_robot(pushes)
  every = every or robot.knots
  plan: np.ndarray | None = None
  executed: list[int] = []
  plannings: list[planning.Found] = []
  knots: list[problem_lib.Progress] = []
  while robot.remaining:
    if plan is None or robot.alive[0]:  # Who has fallen goes nowhere.
      plannings.append(solver.solve(report, robot, plan))
      plan = plannings[-1].plan.indices(robot.mode_set)
    now, plan = plan[:every], plan[every:]
    knots += [robot.run_knot(mode[None]) for mode in now]
    executed += now.tolist()
  trial = problem_lib.trials(knots)
  return planning.Found(
    plan_lib.from_indices(
      executed, robot.mode_set.names, robot.config.knot_duration
    ),
    bool(trial.success[0]),
    float(trial.returns[0]),
    trial.paths[0],
    sum(found.solve_seconds for found in plannings),
    sum(found.rollouts for found in plannings),
    sum(found.control_steps for found in plannings),
  )
