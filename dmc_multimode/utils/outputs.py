"""Where binaries write: told from the flags before the work, not after it."""

import os
import pathlib


def file(flag: str, value: str | None) -> pathlib.Path | None:
  """Returns the file that a flag names; None if it names none.

  Raises:
    OSError: it is a folder, or cannot be written.
  """
  if not value:
    return None
  path = pathlib.Path(value)
  if path.is_dir():
    raise IsADirectoryError(f'--{flag}={value} is a folder; name a file.')
  _check_writable(path.absolute().parent, f'--{flag}={value}')
  return path


def folder(flag: str, value: str | None) -> pathlib.Path | None:
  """Returns the folder that a flag names, made or not; None if it names none.

  Raises:
    OSError: it is a file, or nothing can be written into it.
  """
  if not value:
    return None
  path = pathlib.Path(value)
  if path.exists() and not path.is_dir():
    raise NotADirectoryError(f'--{flag}={value} is a file; name a folder.')
  _check_writable(path.absolute(), f'--{flag}={value}')
  return path


def _check_writable(path: pathlib.Path, flag: str) -> None:
  parent = next(p for p in (path, *path.parents) if p.exists())
  if not (parent.is_dir() and os.access(parent, os.W_OK)):
    raise NotADirectoryError(f'{flag}: cannot write into {parent}.')
