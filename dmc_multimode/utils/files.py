"""Files that are whole or not there."""

import glob
import os
import pathlib


def write(path: str | os.PathLike[str], content: bytes) -> None:
  """Replaces a file in one step: a reader sees the old or the new content.

  Raises:
    OSError: the folder is not writable or full; the file is as it was.
  """
  path = pathlib.Path(path)
  _clean_up(path)
  temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
  try:
    with open(temporary, 'wb') as file:
      file.write(content)
      file.flush()
      os.fsync(file.fileno())
    os.replace(temporary, path)
  finally:
    temporary.unlink(missing_ok=True)


def _clean_up(path: pathlib.Path) -> None:
  """Removes what processes left that were killed while they wrote `path`."""
  for other in path.parent.glob(f'.{glob.escape(path.name)}.*.tmp'):
    process = other.name.split('.')[-2]
    if process.isdecimal() and not _is_running(int(process)):
      other.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
  try:
    os.kill(process, 0)
  except ProcessLookupError:
    return False
  except (OverflowError, PermissionError):
    pass  # No process of ours, or not even one.
  return True
