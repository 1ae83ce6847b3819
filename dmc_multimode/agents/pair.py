"""Two threads that share the work of one."""

from concurrent import futures
from typing import Callable, TypeVar

import torch

_T = TypeVar('_T')
_U = TypeVar('_U')


class Pair:
  """The calling thread and a second one, or the calling thread alone.

  Operations on networks as small as these gain more from two threads that do
  different ones than from being cut in two each; and the threads of the latter
  go on waiting in a loop when the physics needs their cores. Results are the
  same to the bit, with a second thread or without.
  """

  def __init__(self, parallel: bool = False):
    """Starts the second thread when there is `parallel` work for it."""
    self._worker = futures.ThreadPoolExecutor(1, 'pair') if parallel else None

  def both(
    self, mine: Callable[[], _T], other: Callable[[], _U]
  ) -> tuple[_T, _U]:
    """Calls both, at once or in turn; returns what both returned.

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
    """Returns `function(rows)` without gradients, half by each thread.

    Args:
      function: takes [N, ...] to [N, ...], row by row.
      rows: [N, ...].
    """
    first, *rest = rows.chunk(2)
    if not rest:
      return _infer(function, first)
    halves = self.both(
      lambda: _infer(function, first), lambda: _infer(function, rest[0])
    )
    return torch.cat(halves)


@torch.no_grad()  # A thread has its own idea of whether there are gradients.
def _infer(
  function: Callable[[torch.Tensor], torch.Tensor], rows: torch.Tensor
) -> torch.Tensor:
  return function(rows)
