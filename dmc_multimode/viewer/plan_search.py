"""Plans in a live session: searched for in a thread, and carried out."""

from concurrent import futures
import threading

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import solver
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import durations
from dmc_multimode.viewer import rollout

DONE = ''  # In the place of a mode: the plan is over.


class PlanSearch:
  """A search for a plan in a thread.

  Attributes:
    status: progress of the search.
  """

  def __init__(
    self,
    policy: pretrained.Policy,
    arena: str,
    config: reaching.ReachingConfig,
    planner: solver.SearchConfig,
    threads: int,
    selector: selector_lib.Selector | None,
  ):
    """Starts the search; for the arguments see `solver.Solver`."""
    self.status = solver.Status('compiling', 0, 1, 0.0, np.inf)
    self._cancelled = threading.Event()
    executor = futures.ThreadPoolExecutor(1)
    self._found = executor.submit(
      lambda: solver.Solver(
        policy, arena, config, planner, threads, selector=selector
      ).solve(self._report)
    )
    executor.shutdown(wait=False)  # The exception ends the thread.

  @property
  def done(self) -> bool:
    """True once the search is over."""
    return self._found.done()

  def result(self) -> plan_lib.PlanResult:
    """Returns the best plan that was found.

    Raises:
      ValueError: the problem is invalid.
    """
    return self._found.result()

  def cancel(self) -> None:
    """Ends the search at the next knot."""
    self._cancelled.set()

  def _report(self, status: solver.Status) -> None:
    if self._cancelled.is_set():
      raise futures.CancelledError
    self.status = status


def mode_at(plan: plan_lib.ModePlan, robot: rollout.Robot) -> str | None:
  """Returns the mode to command now; None between knots, `DONE` at the end.

  Args:
    plan: carried out since the robot's start.
    robot: moves by control steps.
  """
  task = robot.task
  knot_steps = durations.whole_steps(
    plan.knot_duration, task.control_timestep, 'A knot'
  )
  knot, rest = divmod(int(task.core.tracker.state.step[0]), knot_steps)
  if knot == len(plan.modes):
    return DONE
  return None if rest else plan.modes[knot]
