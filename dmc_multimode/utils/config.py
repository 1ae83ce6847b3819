"""Validated configuration dataclasses, with one-line errors.

A configuration is a frozen pydantic dataclass, which checks its values at
construction, from Python or from a file:

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

# No conversions of text or bool to numbers; no unknown fields. Validators are
# built when they are first used: importing the suite builds few.
STRICT = pydantic.ConfigDict(
  strict=True,
  extra='forbid',
  allow_inf_nan=False,
  validate_default=True,
  defer_build=True,
)
_field = pydantic_fields.Field

Positive = Annotated[float, _field(gt=0)]
NonNegative = Annotated[float, _field(ge=0)]
Share = Annotated[float, _field(ge=0, le=1)]
Count = Annotated[int, _field(ge=0)]
PositiveInt = Annotated[int, _field(gt=0)]


def one_of(names: Sequence[str]) -> pydantic.AfterValidator:
  """Returns the annotation of a field that is one of `names`."""

  def check(value: str) -> str:
    if value not in names:
      raise ValueError(f'must be one of {", ".join(names)}, got {value!r:.50}')
    return value

  return pydantic.AfterValidator(check)


def build(kind: type[_T], values: Any) -> _T:
  """Builds a configuration from a table of values.

  Args:
    kind: a pydantic dataclass.
    values: JSON values by field, nested for nested configurations.

  Raises:
    ValueError: in one line, a field is unknown or missing, or its value is of
      another type or out of its bounds.
  """
  if not isinstance(values, Mapping):
    raise ValueError(
      f'{kind.__name__} must be a table, got {type(values).__name__}'
    )
  try:
    # From JSON, strict mode accepts tables and lists for nested parts.
    text = json.dumps(dict(values))
    return pydantic.TypeAdapter(kind).validate_json(text)
  except pydantic.ValidationError as error:
    raise ValueError(describe(error)) from error
  except TypeError as error:
    raise ValueError(f'{kind.__name__} must be JSON: {error}') from error


def to_dict(config: Any) -> dict[str, Any]:
  """Returns a configuration as JSON values for `build`."""
  return dataclasses.asdict(config)


def describe(error: pydantic.ValidationError) -> str:
  """Returns a validation error in one line: fields, problem, value."""
  found = []
  for problem in error.errors(include_url=False):
    place = '.'.join(str(part) for part in problem['loc'])
    text = problem['msg'].removeprefix('Value error, ').rstrip('.')
    if problem['type'] != 'value_error':
      text = f'{text}, got {problem["input"]!r:.50}'
    found.append(f'{place}: {text}' if place else text)
  return '; '.join(found)
