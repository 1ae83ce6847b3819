"""Atomic writing and bounded reading of files, with one-line errors."""

import glob
import json
import os
import pathlib
import tempfile
from typing import Any

Path = str | os.PathLike[str]

MAX_BYTES = 64 << 20  # Apart from checkpoints.


def expand(path: Path) -> str:
  """Returns a path with the home folder in place of a leading `~` or `~USER`.

  Raises:
    ValueError: nobody of that name has a home folder.
  """
  text = os.path.expanduser(os.fspath(path))
  if text.startswith('~'):
    raise ValueError(
      f'{text.split(os.sep)[0]} is no home folder; a file of such a name is '
      f'./{text}.'
    )
  return text


def check_size(path: Path, limit: int = MAX_BYTES) -> None:
  """Raises ValueError if a file is too large; see `read_bounded`."""
  if os.path.getsize(path) > limit:
    raise ValueError(f'{path} is too large: {limit:,} bytes are the most.')


def read_bounded(path: Path, limit: int = MAX_BYTES) -> bytes:
  """Returns a file's content.

  Args:
    path: of the file.
    limit: bytes; larger files are rejected, which could fill the memory.

  Raises:
    OSError: the file is missing or cannot be read.
    ValueError: the file is larger.
  """
  with open(path, 'rb') as file:
    content = file.read(limit + 1)
  if len(content) > limit:
    raise ValueError(f'{path} is too large: {limit:,} bytes are the most.')
  return content


def read_json(path: Path, limit: int = MAX_BYTES) -> Any:
  """Returns the values of a JSON file.

  Raises:
    OSError: the file is missing or cannot be read.
    ValueError: the file is too large or not JSON (NaN, Infinity).
  """
  content = read_bounded(path, limit)
  try:
    return json.loads(content, parse_constant=_refuse)
  except (ValueError, RecursionError) as error:
    raise ValueError(f'{path} is damaged: {error}.') from error


def write(path: Path, content: bytes) -> None:
  """Replaces a file atomically: readers see the old or the new content.

  Raises:
    OSError: the folder is not writable or full; the file is unchanged.
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


def write_json(path: Path, values: Any) -> None:
  """Replaces a file atomically by JSON for `read_json`."""
  text = json.dumps(values, indent=1, allow_nan=False) + '\n'
  write(path, text.encode())


def output_file(flag: str, value: Path | None) -> pathlib.Path | None:
  """Returns the output file of a flag, checked; None if the flag is empty.

  Commands call it before the work, so that no result is lost.

  Args:
    flag: for the error, without dashes.
    value: of the flag.

  Raises:
    OSError: the path is a folder, or cannot be written.
  """
  if not value:
    return None
  path = pathlib.Path(expand(value))
  if path.is_dir():
    raise IsADirectoryError(f'--{flag}={value} is a folder; name a file.')
  _check_writable(path.absolute().parent, f'--{flag}={value}')
  return path


def output_folder(flag: str, value: Path | None) -> pathlib.Path | None:
  """Returns the output folder of a flag, checked; None if it is empty.

  Raises:
    OSError: the path is a file, or the folder is not writable.
  """
  if not value:
    return None
  path = pathlib.Path(expand(value))
  if path.exists() and not path.is_dir():
    raise NotADirectoryError(f'--{flag}={value} is a file; name a folder.')
  _check_writable(path.absolute(), f'--{flag}={value}')
  return path


def _check_writable(path: pathlib.Path, flag: str) -> None:
  parent = next(p for p in (path, *path.parents) if p.exists())
  try:  # Permissions alone do not tell: root may not write into /proc either.
    with tempfile.TemporaryFile(dir=parent):
      pass
  except OSError as error:
    raise type(error)(f'{flag}: cannot write into {parent}.') from error


def _refuse(constant: str) -> None:
  raise ValueError(f'{constant} is not a finite number')


def _clean_up(path: pathlib.Path) -> None:
  """Removes temporary files of processes killed while writing `path`."""
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
    pass  # Another user's process, or none.
  return True
