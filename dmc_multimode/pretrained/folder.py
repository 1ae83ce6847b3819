"""The folder of a policy, as far as it is read without torch."""

import os
import pathlib
from typing import Any

from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.utils import files
from dmc_multimode.utils import resources

DESCRIPTION_FILE = 'policy.json'
RUN_SUBFOLDER = 'policy'  # Folder of the policy in a run's folder.
FORMAT = 'dmc_multimode.policy.1'


def names() -> tuple[str, ...]:
  """Returns the names of the shipped policies."""
  is_policy = lambda name: (
    resources.path('pretrained', name) / DESCRIPTION_FILE
  ).is_file()
  return tuple(filter(is_policy, resources.names('pretrained')))


def find(policy: str | os.PathLike[str]) -> pathlib.Path:
  """Returns the folder of the files of a policy.

  Args:
    policy: one of `names`, a policy's folder, or a training run's folder.

  Raises:
    FileNotFoundError: there is no such policy; the message lists those there
      are.
  """
  name = files.expand(policy)
  path = pathlib.Path(name)
  for candidate in (path, path / RUN_SUBFOLDER):
    if (candidate / DESCRIPTION_FILE).is_file():
      return candidate
  if path.exists() and os.sep in name:
    raise FileNotFoundError(
      f'{path} holds no {DESCRIPTION_FILE}: it is not the folder of a policy '
      'or of a training run that has saved one.'
    )
  found = resources.path('pretrained', name)
  if not (found / DESCRIPTION_FILE).is_file():
    raise FileNotFoundError(f'pretrained {name!r} is no policy.')
  return found


def read_json(path: pathlib.Path) -> dict[str, Any]:
  """Returns the object of a JSON file; raises ValueError for anything else."""
  content = files.read_json(path)
  if not isinstance(content, dict):
    raise ValueError(f'{path} is damaged: it holds no object.')
  return content


def read_description(folder: pathlib.Path) -> dict[str, Any]:
  """Returns the content of a folder's `policy.json`.

  Raises:
    ValueError: the file is damaged, or of another version.
  """
  path = folder / DESCRIPTION_FILE
  description = read_json(path)
  if description.get('format') != FORMAT:
    raise ValueError(f'{path} is not a policy of this version.')
  return description


def mode_set(policy: str | os.PathLike[str]) -> mode_set_lib.ModeSet:
  """Returns the modes of a policy, without loading its network.

  Raises:
    FileNotFoundError: there is no such policy.
    ValueError: the file is damaged, or of another version.
  """
  folder = find(policy)
  try:
    return mode_files.mode_set_from_dict(read_description(folder))
  except (KeyError, TypeError) as error:
    path = folder / DESCRIPTION_FILE
    raise ValueError(f'{path} is damaged: {error!r}') from error
