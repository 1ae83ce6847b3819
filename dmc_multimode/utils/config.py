"""Validated configuration dataclasses, and one line for what is wrong.

A configuration is a frozen pydantic dataclass, so that a value is checked where
it is made, in Python as from a file:

    @pydantic_dataclasses.dataclass(frozen=True, config=config.STRICT)
    class PushConfig:
      speed: config.NonNegative = 0.0  # m/s
      interval: config.Positive = 1.5  # Seconds.
"""

import dataclasses
import json
from typing import Annotated, Any, Mapping, Sequence, TypeVar

import pydantic
from pydantic import fields as pydantic_fields

_T = TypeVar('_T')

# Neither a text nor a bool is a number; nothing is added that no field has.
STRICT = pydantic.ConfigDict(
  strict=True, extra='forbid', allow_inf_nan=False, validate_default=True
)
_field = pydantic_fields.Field

Positive = Annotated[float, _field(gt=0)]
NonNegative = Annotated[float, _field(ge=0)]
Share = Annotated[float, _field(ge=0, le=1)]
Count = Annotated[int, _field(ge=0)]
PositiveInt = Annotated[int, _field(gt=0)]


def one_of(names: Sequence[str]) -> pydantic.AfterValidator:
  """Returns what annotates a field that is one of some names."""

  def check(value: str) -> str:
    if value not in names:
      raise ValueError(f'must be one of {", ".join(names)}, got {value!r:.50}')
    return value

  return pydantic.AfterValidator(check)


def build(kind: type[_T], values: Any) -> _T:
  """Returns a configuration of a dataclass from a table of values.

  Args:
    kind: a pydantic dataclass.
    values: JSON-able values by field, nested for configurations in it.

  Raises:
    ValueError: in one line, a field is unknown or missing, or its value is of
      another type or out of its bounds.
  """
  if not isinstance(values, Mapping):
    raise ValueError(
      f'{kind.__name__} must be a table, got {type(values).__name__}'
    )
  try:
    # As JSON, a strict configuration takes tables and lists for its parts.
    text = json.dumps(dict(values))
    return pydantic.TypeAdapter(kind).validate_json(text)
  except pydantic.ValidationError as error:
    raise ValueError(describe(error)) from error
  except TypeError as error:
    raise ValueError(f'{kind.__name__} must be JSON: {error}') from error


def to_dict(config: Any) -> dict[str, Any]:
  """Returns a configuration as JSON-able values, which `build` reads."""
  return dataclasses.asdict(config)


def describe(error: pydantic.ValidationError) -> str:
  """Returns what a validation found in one line: fields, problem, value."""
  found = []
  for problem in error.errors(include_url=False):
    place = '.'.join(str(part) for part in problem['loc'])
    text = problem['msg'].removeprefix('Value error, ').rstrip('.')
    if problem['type'] != 'value_error':
      text = f'{text}, got {problem["input"]!r:.50}'
    found.append(f'{place}: {text}' if place else text)
  return '; '.join(found)
