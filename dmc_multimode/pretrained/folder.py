"""The folder of a policy, as far as it is read without torch."""

import contextlib
import os
import pathlib
from typing import Any

from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.utils import files
from dmc_multimode.utils import resources
from dmc_multimode.walkers import robot_files

DESCRIPTION_FILE = 'policy.json'
RUN_SUBFOLDER = 'policy'  # Folder of the policy in a run's folder.
_MINI_BIPED = 'mini_biped', 'mini_biped.xml'  # Not named in a policy.
FORMAT = 'dmc_multimode.policy.1'


def names(robot: str | None = None, installed: bool = False) -> tuple[str, ...]:
  """Returns the names of the shipped policies.

  Args:
    robot: only those of the robot of this name, 'mini_biped' for example.
    installed: only those whose robot's model is here: models of other robots
      come with the extra `robots`.
  """
  found = []
  for name in resources.names('pretrained'):
    folder = resources.path('pretrained', name)
    if not (folder / DESCRIPTION_FILE).is_file():
      continue
    if robot is not None or installed:
      known, model = _robot(folder)
      if installed and not robot_files.is_here(model):
        continue
      if robot not in (None, known):
        continue
    found.append(name)
  return tuple(found)


def _robot(folder: pathlib.Path) -> tuple[str, str]:
  """Returns the name of a policy's robot, and of its model's file.

  A damaged file counts as the mini biped's: to load it says what is wrong.
  """
  try:
    task = read_json(folder / DESCRIPTION_FILE).get('task', {})
    if 'robot' not in task:
      return _MINI_BIPED
    declaration = task['robot']['declaration']
    return declaration['name'], declaration['model']
  except (ValueError, KeyError, TypeError):
    return _MINI_BIPED


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
  with contextlib.suppress(FileNotFoundError):  # Whose list has encoders, too.
    shipped = resources.path('pretrained', name)
    if (shipped / DESCRIPTION_FILE).is_file():
      return shipped
  raise FileNotFoundError(
    f'no pretrained policy named {name!r}; there are: {", ".join(names())}'
  )


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
