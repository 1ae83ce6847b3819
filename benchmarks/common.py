"""Flags of a run, and reports with the machine: what benchmarks share."""

import importlib.metadata
import json
import os
import pathlib
import platform
from typing import Any, Mapping, Sequence

from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.utils import files

CORES = len(os.sched_getaffinity(0))
_PACKAGES = ('mujoco', 'dm_control', 'torch', 'numpy')
_PARTS = ('ppo', 'sampling', 'task')


def define_run_flags() -> None:
  """Defines flags for every field of the parts of a `RunConfig`."""
  for part in _PARTS:
    config_flags.define(getattr(run_config.RunConfig(), part), part)


def configured(**values: Any) -> run_config.RunConfig:
  """Returns a run's configuration: its parts by their flags, and `values`."""
  parts: dict[str, Any] = {
    part: config_flags.read(getattr(run_config.RunConfig(), part), part)
    for part in _PARTS
  }
  return run_config.RunConfig(**parts, **values)


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
