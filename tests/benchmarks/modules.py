"""Imports benchmarks side by side."""

import importlib
from typing import Any

from absl import flags


def load(name: str) -> Any:
  """Imports a benchmark and forgets its flags, whose names others have, too."""
  before = set(flags.FLAGS)
  module = importlib.import_module(f'benchmarks.{name}')
  for flag in set(flags.FLAGS) - before:
    delattr(flags.FLAGS, flag)
  return module
