"""Runs of one command in several processes, which `torchrun` has started."""

import os
import pathlib
import socket
from typing import Callable

import torch

from dmc_multimode.agents import distributed
from dmc_multimode.utils import files

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


def name() -> str:
  """Names this launch of `torchrun`, all restarts included; '' without one."""
  given = os.environ.get('TORCHELASTIC_RUN_ID', '')
  # What torchrun calls a launch that was given no name.
  return f'{socket.gethostname()}:{os.getppid()}' if given == 'none' else given


def note(path: pathlib.Path) -> None:
  """Writes down in a file which launch, if any, begins a run."""
  if name():
    files.write(path, name().encode())


def is_restart(path: pathlib.Path) -> bool:
  """Returns whether this launch has noted itself, in processes that died."""
  return (
    bool(name())
    and path.is_file()
    and path.read_text(encoding='utf-8') == name()
  )
