"""Imports benchmarks side by side."""

import importlib
from typing import Any

from absl import flags


def load(name: str) -> Any:
  """Imports a benchmark and forgets its flags, whose names others have, too."""
  # By their objects: one that has a short name is there under both.
  others = {id(flags.FLAGS[n]): flags.FLAGS[n] for n in flags.FLAGS}
  for flag in others.values():
    delattr(flags.FLAGS, flag.name)
  try:
    return importlib.import_module(f'benchmarks.{name}')
  finally:
    for added in {id(flags.FLAGS[n]): n for n in flags.FLAGS}.values():
      delattr(flags.FLAGS, added)
    for flag in others.values():
      flags.FLAGS[flag.name] = flag
