"""Configurations from tables of values that a stranger may have written."""

import sys
import typing
from typing import Any, Callable, Mapping, TypeVar

_T = TypeVar('_T')
_NOUNS = {
  bool: 'true or false',
  int: 'a whole number',
  float: 'a finite number',
  str: 'text',
}


def build(kind: Callable[..., _T], values: Any) -> _T:
  """Returns `kind(**values)`, a dataclass or a named tuple.

  Fields of the types bool, int, float and str are checked: neither says
  anything itself about a text where it wants a number.

  Raises:
    ValueError: `values` is no mapping, a field is unknown, missing or of
      another type, or `kind` rejects its value.
  """
  if not isinstance(values, Mapping):
    raise ValueError(
      f'{kind.__name__} must be a table, got {type(values).__name__}'
    )
  types = typing.get_type_hints(kind)
  for name, value in values.items():
    if name not in types:
      raise ValueError(f'{name} is unknown')
    if types[name] in _NOUNS and not _fits(types[name], value):
      raise ValueError(
        f'{name} must be {_NOUNS[types[name]]}, got {value!r:.50}'
      )
  try:
    return kind(**values)
  except TypeError as error:
    raise ValueError(str(error)) from error


def _fits(kind: Any, value: Any) -> bool:
  if kind is float:
    # An integer too large for a float is not finite either.
    return type(value) in (int, float) and abs(value) <= sys.float_info.max
  return type(value) is kind
