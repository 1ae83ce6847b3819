"""How a binary runs in several processes that `torchrun` has started."""

from typing import Callable

import torch

from dmc_multimode.agents import distributed

_EXIT_ERROR = 2  # As `bin.app` exits where the user can put it right.


def run(
  function: Callable[[distributed.Communicator], int | None],
  device: torch.device | None = None,
) -> int:
  """Calls a function in every process; returns the exit code of this one.

  An error that all processes meet is raised at rank 0 alone, so that it is told
  once. A lost connection is told by all who lose it.

  Args:
    function: gets what connects the processes.
    device: on which it may exchange tensors, besides the CPU.
  """
  rank = 0
  try:
    with distributed.connect(device) as communicator:
      rank = communicator.rank
      return function(communicator) or 0
  except (ValueError, FloatingPointError, FileNotFoundError):
    if rank == 0:
      raise
    return _EXIT_ERROR
