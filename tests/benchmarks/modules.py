"""Imports benchmarks side by side."""

import importlib
from typing import Any

from absl import flags


def load(name: str) -> Any:
  """Imports a benchmark and forgets its flags, whose names others have, too.

  Those of libraries that it is the first to import stay.
  """
  # By their objects: one that has a short name is there under both.
  others = {id(flags.FLAGS[n]): flags.FLAGS[n] for n in flags.FLAGS}
  for old in [*flags.FLAGS]:
    delattr(flags.FLAGS, old)
  try:
    return importlib.import_module(f'benchmarks.{name}')
  finally:
    for added in [*flags.FLAGS]:
      module = flags.FLAGS.find_module_defining_flag(added) or ''
      if module.startswith('benchmarks.'):
        delattr(flags.FLAGS, added)
    for flag in others.values():
      flags.FLAGS[flag.name] = flag
