"""Packages that offer names of their modules without importing these."""

import importlib
from typing import Any, Mapping


def find(package: str, homes: Mapping[str, str], name: str) -> Any:
  """Returns a name that a package offers: the body of its `__getattr__`.

  Args:
    package: its `__name__`.
    homes: for each name that is offered, the module that defines it; with
      ':NAME' behind it where its name there is another.
    name: which is asked for.

  Raises:
    AttributeError: the package does not offer it.
  """
  if name not in homes:
    raise AttributeError(f'module {package!r} has no attribute {name!r}')
  home, _, original = homes[name].partition(':')
  module = importlib.import_module(f'{package}.{home}')
  return getattr(module, original or name)
