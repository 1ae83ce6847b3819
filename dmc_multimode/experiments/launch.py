"""Which launch of `torchrun` has begun a run, so that its restarts go on."""

import os
import pathlib
import socket

from dmc_multimode.experiments import setup
from dmc_multimode.utils import files

FILE = 'launch'  # Beside a run.


def name() -> str:
  """Names this launch of `torchrun`, all restarts included; '' without one."""
  given = os.environ.get('TORCHELASTIC_RUN_ID', '')
  # What torchrun calls a launch that was given no name.
  return f'{socket.gethostname()}:{os.getppid()}' if given == 'none' else given


def note(directory: pathlib.Path) -> None:
  """Writes down which launch, if any, begins the run in a folder."""
  if name():
    files.write(directory / FILE, name().encode())


def is_restart(directory: pathlib.Path) -> bool:
  """Whether this launch has begun the run there, in processes that died."""
  noted = directory / FILE
  return (
    bool(name())
    and (directory / setup.CONFIG_FILE).is_file()
    and noted.is_file()
    and noted.read_text(encoding='utf-8') == name()
  )
