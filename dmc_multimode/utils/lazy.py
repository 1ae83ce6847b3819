"""Lazy imports of the names that a package exports."""

import importlib
from typing import Any, Mapping


def find(package: str, homes: Mapping[str, str], name: str) -> Any:
  """Returns an exported object: the body of a package's `__getattr__`.

  Args:
    package: its `__name__`.
    homes: module of each exported name, followed by ':NAME' if its name there
      differs.
    name: exported name.

  Raises:
    AttributeError: the package does not export it.
  """
  if name not in homes:
    raise AttributeError(f'module {package!r} has no attribute {name!r}')
  home, _, original = homes[name].partition(':')
  module = importlib.import_module(f'{package}.{home}')
  return getattr(module, original or name)
