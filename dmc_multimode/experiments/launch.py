"""Runs of one command in several processes, started by `torchrun`."""

import os
import pathlib
import socket
from typing import Callable

import torch

from dmc_multimode.agents import distributed
from dmc_multimode.utils import files

_EXIT_ERROR = 2  # Exit code of `bin.app` for errors that the user can mend.


def run(
  function: Callable[[distributed.Communicator], int | None],
  device: torch.device | None = None,
) -> int:
  """Calls a function in every process; returns the exit code of this one.

  An error of all processes is raised at rank 0 only, so that it is reported
  once. Every process reports a lost connection.

  Args:
    function: receives the communicator; returns an exit code.
    device: of tensors to exchange, besides the CPU.
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


def name() -> str:
  """Returns the id of this `torchrun` launch, restarts included, or ''."""
  given = os.environ.get('TORCHELASTIC_RUN_ID', '')
  # The id of a launch without a name.
  return f'{socket.gethostname()}:{os.getppid()}' if given == 'none' else given


def note(path: pathlib.Path) -> None:
  """Writes the id of this launch into a file of the run it begins."""
  if name():
    files.write(path, name().encode())


def is_restart(path: pathlib.Path) -> bool:
  """Returns whether this torchrun launch began the run: it is a restart."""
  return (
    bool(name())
    and path.is_file()
    and path.read_text(encoding='utf-8') == name()
  )
