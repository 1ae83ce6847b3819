"""Paths of the files that ship with the package.

The folders `xml/`, `flags/` and `pretrained/` are inside the package. In a
checkout the first two are links to folders of the repository.
"""

import pathlib
from typing import get_args, Literal

Kind = Literal['xml', 'flags', 'pretrained']

_PACKAGE = pathlib.Path(__file__).resolve().parents[1]
_IS_DATA = {
  'xml': lambda entry: entry.suffix in ('.xml', '.yaml'),
  'flags': lambda entry: entry.suffix == '.flags',
  'pretrained': lambda entry: entry.is_dir() and entry.name != '__pycache__',
}


def path(kind: Kind, name: str) -> pathlib.Path:
  """Returns the path of a shipped file or folder.

  Args:
    kind: `'xml'` (models and robots), `'flags'` (absl flagfiles) or
      `'pretrained'` (a folder for each policy or encoder).
    name: Name below the folder of that kind, such as `'mini_biped.xml'`,
      `'quickstart.flags'`, `'quickstart'`. Forward slashes on every system.

  Returns:
    An absolute path that exists.

  Raises:
    FileNotFoundError: If nothing of that name is shipped; the message lists
      what is. A name that leads out of the folder counts as not shipped.
    ValueError: If `kind` is unknown.
  """
  parts = pathlib.PurePosixPath(name).parts
  inside = parts and '..' not in parts and not name.startswith('/')
  found = _folder(kind).joinpath(*parts) if inside else None
  if found is None or not found.exists():
    shipped = ', '.join(names(kind)) or 'nothing'
    raise FileNotFoundError(f'no {kind} named {name!r}; there is: {shipped}')
  return found


def names(kind: Kind) -> list[str]:
  """Returns the shipped names of a kind, sorted, for `path`."""
  entries = _folder(kind).iterdir()
  return sorted(entry.name for entry in entries if _IS_DATA[kind](entry))


def _folder(kind: Kind) -> pathlib.Path:
  """Returns the folder of a kind."""
  if kind not in get_args(Kind):
    raise ValueError(f'kind must be one of {get_args(Kind)}, got {kind!r}')
  folder = _PACKAGE / kind
  if not folder.is_dir():
    raise FileNotFoundError(f'no folder {folder}: the installation is damaged')
  return folder
