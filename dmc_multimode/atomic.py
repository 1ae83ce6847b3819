"""Files that are whole or not there."""

import os
import pathlib


def write(path: str | os.PathLike[str], content: bytes) -> None:
  """Replaces a file in one step: a reader sees the old or the new content.

  Raises:
    OSError: the folder is not writable or full; the file is as it was.
  """
  path = pathlib.Path(path)
  temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
  try:
    with open(temporary, 'wb') as file:
      file.write(content)
      file.flush()
      os.fsync(file.fileno())
    os.replace(temporary, path)
  finally:
    temporary.unlink(missing_ok=True)
