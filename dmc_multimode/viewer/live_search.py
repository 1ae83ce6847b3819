"""A search for a plan beside a robot that runs in the meantime."""

from concurrent import futures
import threading

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import solver
from dmc_multimode.suite.reaching import problem as reaching


class Search:
  """A search for a plan, in a thread of its own.

  Attributes:
    status: how far it has come.
  """

  def __init__(
    self,
    policy: pretrained.Policy,
    arena: str,
    config: reaching.ReachingConfig,
    planner: beam_search.BeamConfig,
    threads: int,
  ):
    """Starts; the arguments are those of `solver.Solver`."""
    self.status = solver.Status('compiling', 0, 1, 0.0, np.inf)
    self._cancelled = threading.Event()
    executor = futures.ThreadPoolExecutor(1)
    self._found = executor.submit(
      lambda: solver.Solver(
        policy, lambda: track.make(arena), config, planner, threads
      ).solve(self._report)
    )
    executor.shutdown(wait=False)  # There is nothing more to do.

  @property
  def done(self) -> bool:
    """Whether it is over."""
    return self._found.done()

  def result(self) -> solver.Found:
    """Returns the best plan that was found.

    Raises:
      ValueError: there is none because the problem is none.
    """
    return self._found.result()

  def cancel(self) -> None:
    """Lets it end at the next knot."""
    self._cancelled.set()

  def _report(self, status: solver.Status) -> None:
    if self._cancelled.is_set():
      raise futures.CancelledError
    self.status = status
