"""Shares flags, tables and reports with the machine among benchmarks."""

import importlib.metadata
import json
import os
import pathlib
import platform
import sys
from typing import Any, Iterable, Mapping, Sequence

from absl import flags

from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar
from dmc_multimode.walkers import robot as robot_lib

CORES = len(os.sched_getaffinity(0))
_PACKAGES = ('mujoco', 'dm_control', 'torch', 'numpy')
_PARTS = ('ppo', 'sampling', 'task')


flags.disclaim_key_flags()  # They are of the benchmark that asks for them.

_WIDTH = 10  # Characters of the narrowest column.

Row = dict[str, Any]


def _parsed(columns: str) -> list[tuple[str, str, str]]:
  """Returns title, key and format of every `title=key:format`, by bars."""
  found = []
  for column in columns.split(' | '):
    name, _, form = column.partition(':')
    title, _, key = name.rpartition('=')
    found.append((title or key * ('=' not in name), key, form))
  return found


def line(columns: str, row: Mapping[str, Any]) -> str:
  """Returns a row of a table; parts of a value that are None are left out.

  Args:
    columns: `title=key:format` of each, separated by bars; the title is by
      default the key, and the first column is a name.
    row: values by key.
  """
  cells: list[str] = []
  for title, key, form in _parsed(columns):
    values = row[key] if isinstance(row[key], list) else [row[key]]
    text = ' to '.join(format(x, form) for x in values if x is not None)
    width = max(len(title), _WIDTH) + 2
    cells.append(f'{text:>{width}}' if cells else f'{text:28}')
  return ''.join(cells)


def print_table(columns: str, rows: Iterable[Mapping[str, Any]]) -> None:
  """Prints titles and rows, each as soon as there is one."""
  titles = [title for title, _, _ in _parsed(columns)]
  print(
    titles[0].ljust(28)
    + ''.join(f'{title:>{max(len(title), _WIDTH) + 2}}' for title in titles[1:])
  )
  for row in rows:
    print(line(columns, row), flush=True)


def show(columns: str, row: Mapping[str, Any]) -> None:
  """Prints a row on stderr beside a progress bar."""
  progress_bar.Bar.write(line(columns, row), sys.stderr)


def define_policy() -> flags.FlagHolder[str]:
  """Defines --policy."""
  text = 'Name of a shipped policy, or a folder.'
  return config_flags.define_path('policy', 'pi2', text)


def define_selector() -> flags.FlagHolder[str]:
  """Defines --selector."""
  text = 'Folder of the selector; the one beside the policy.'
  return config_flags.define_path('selector', '', text)


def define_out() -> flags.FlagHolder[str | None]:
  """Defines --out."""
  return config_flags.define_path('out', None, 'JSON file to write.')


def define_run_flags() -> None:
  """Defines --modes, --num_worlds, --threads, --seed and those of the parts."""
  default = run_config.RunConfig()
  flags.DEFINE_string('modes', 'pi2', 'A mode set, or modes.')
  flags.DEFINE_integer('num_worlds', default.num_worlds, 'Of all.', 1)
  flags.DEFINE_integer('threads', CORES, 'Of physics and torch.', 1)
  flags.DEFINE_integer('seed', 0, 'Of all randomness.', 0)
  for part in _PARTS:
    config_flags.define(getattr(run_config.RunConfig(), part), part)


def configured(robot: str | None = None) -> run_config.RunConfig:
  """Returns a run's configuration by its flags.

  Args:
    robot: file or name of a robot; the mini biped by default.
  """
  default = run_config.RunConfig()
  if robot:
    default = run_config.for_robot(default, robot_lib.load(robot))
  values: dict[str, Any] = {
    part: config_flags.read(getattr(default, part), part) for part in _PARTS
  }
  for name in ('modes', 'num_worlds', 'threads', 'seed'):
    values[name] = flags.FLAGS[name].value
  return run_config.RunConfig(**values)


def describe(config: run_config.RunConfig) -> str:
  """Returns what is run, and on what."""
  return (
    f'{config.task.robot.name}, {config.modes}, {config.num_worlds} worlds, '
    f'{config.threads} threads on {CORES} cores, mujoco {_version("mujoco")}'
  )


def write_report(
  out: pathlib.Path | None,
  report: Mapping[str, Any],
  packages: Sequence[str] = (),
) -> None:
  """Writes a report as JSON, with what it was measured on; to None: nothing.

  Args:
    out: the file.
    report: JSON-able values.
    packages: whose versions matter, besides those that always do.
  """
  if out is None:
    return
  machine = {
    'versions': {name: _version(name) for name in (*_PACKAGES, *packages)},
    'python': platform.python_version(),
    'platform': platform.platform(),
    'cores': CORES,
  }
  text = json.dumps({**report, **machine}, indent=1) + '\n'
  files.write(out, text.encode())


def _version(package: str) -> str | None:
  try:
    return importlib.metadata.version(package)
  except importlib.metadata.PackageNotFoundError:
    return None
