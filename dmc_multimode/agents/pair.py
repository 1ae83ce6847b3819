"""Two threads for two independent computations."""

from concurrent import futures
from typing import Callable, TypeVar

import torch

_T = TypeVar('_T')
_U = TypeVar('_U')


class Pair:
  """Runs functions in the calling thread and a second one, or in turn.

  With networks this small, two threads that run different operations are faster
  than torch's threads within each operation, which also keep spinning while the
  physics needs the cores. Results are the same to the bit with and without the
  second thread.
  """

  def __init__(self, parallel: bool = False):
    """Creates the second thread if `parallel`."""
    self._worker = futures.ThreadPoolExecutor(1, 'pair') if parallel else None

  def both(
    self, mine: Callable[[], _T], other: Callable[[], _U]
  ) -> tuple[_T, _U]:
    """Calls both functions, in parallel or in turn; returns both results.

    An exception of either is raised when both have ended, `mine` first.
    """
    if self._worker is None:
      return mine(), other()
    future = self._worker.submit(other)
    try:
      result = mine()
    finally:
      futures.wait([future])
    return result, future.result()

  def map_rows(
    self, function: Callable[[torch.Tensor], torch.Tensor], rows: torch.Tensor
  ) -> torch.Tensor:
    """Returns `function(rows)` without gradients, each thread doing half.

    Args:
      function: maps [N, ...] to [N, ...], row by row.
      rows: [N, ...].
    """
    first, *rest = rows.chunk(2)
    if not rest:
      return _infer(function, first)
    halves = self.both(
      lambda: _infer(function, first), lambda: _infer(function, rest[0])
    )
    return torch.cat(halves)


@torch.no_grad()  # Gradient mode is local to a thread.
def _infer(
  function: Callable[[torch.Tensor], torch.Tensor], rows: torch.Tensor
) -> torch.Tensor:
  return function(rows)
