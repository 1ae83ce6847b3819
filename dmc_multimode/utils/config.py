"""Validated configuration dataclasses, with one-line errors.

A configuration is a frozen pydantic dataclass, which checks its values at
construction, from Python or from a file:

    @config.dataclass
    class PushConfig:
      speed: config.NonNegative = 0.0  # m/s
      interval: config.Positive = 1.5  # Seconds.

No field takes NaN, and none but a `Limit` or `Duration` an infinity.
"""

import dataclasses
import json
import math
import typing
from typing import Annotated, Any, Mapping, Sequence, TypeVar

import numpy as np
import pydantic
from pydantic import dataclasses as pydantic_dataclasses
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


def _not_nan(value: float) -> float:
  if math.isnan(value):
    raise ValueError('must be a number, got nan')
  return value


Positive = Annotated[float, _field(gt=0)]
NonNegative = Annotated[float, _field(ge=0)]
Share = Annotated[float, _field(ge=0, le=1)]
Count = Annotated[int, _field(ge=0)]
PositiveInt = Annotated[int, _field(gt=0)]
# A bound; an infinite one never applies.
Limit = Annotated[
  float, _field(allow_inf_nan=True), pydantic.AfterValidator(_not_nan)
]
# Seconds, or another unit of time; may be infinite.
Duration = Annotated[
  float, _field(gt=0, allow_inf_nan=True), pydantic.AfterValidator(_not_nan)
]


@typing.dataclass_transform(
  frozen_default=True, field_specifiers=(dataclasses.field,)
)
def dataclass(kind: type[_T]) -> type[_T]:
  """Makes a class a configuration: a decorator.

  Its constructor takes numpy's numbers for Python's, and lists and arrays for
  tuples, and raises ValueError in one line that names the field.
  """
  # A metaclass: pydantic replaces `__init__` whenever it builds a validator.
  body = {'__qualname__': kind.__qualname__, **vars(kind)}
  for name in ('__dict__', '__weakref__'):
    body.pop(name, None)
  made: Any = _Configuration(kind.__name__, kind.__bases__, body)
  result: Any = pydantic_dataclasses.dataclass(frozen=True, config=STRICT)(made)
  return result


class _Configuration(type):
  """Class of the classes of configurations."""

  def __call__(cls, *args: Any, **kwargs: Any) -> Any:
    """Returns a configuration; raises ValueError in one line."""
    kind: Any = cls
    names = [field.name for field in dataclasses.fields(kind) if field.init]
    # By name, which is how an error calls them.
    given = dict(zip(names, map(_plain, args), strict=False))
    plain = {name: _plain(value) for name, value in kwargs.items()}
    try:
      return super().__call__(*args[len(given) :], **given, **plain)
    except pydantic.ValidationError as error:
      raise ValueError(describe(error)) from None


def _plain(value: Any) -> Any:
  """Returns numpy's numbers as Python's, lists and arrays as tuples."""
  if isinstance(value, (np.generic, np.ndarray)):
    value = value.tolist()
  return tuple(value) if isinstance(value, list) else value


def check_finite(config: Any, prefix: str = '') -> None:
  """Raises ValueError if a number in a configuration is infinite.

  Args:
    config: whose infinite limits no file can hold.
    prefix: of the names of the fields, for the error.
  """
  for field in dataclasses.fields(config):
    value, name = getattr(config, field.name), f'{prefix}{field.name}'
    if dataclasses.is_dataclass(value):
      check_finite(value, f'{name}.')
    elif isinstance(value, float) and math.isinf(value):
      raise ValueError(f'{name}: must be finite here, got {value}')


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
  """Returns a configuration as JSON values for `build`.

  Fields that are no configurations, yet have a `to_dict`, are what it returns.
  """
  return dataclasses.asdict(config, dict_factory=_table)


def _table(items: list[tuple[str, Any]]) -> dict[str, Any]:
  return {
    name: value.to_dict() if hasattr(value, 'to_dict') else value
    for name, value in items
  }


def describe(error: pydantic.ValidationError) -> str:
  """Returns a validation error in one line: fields, problem, value."""
  found = []
  for problem in error.errors(include_url=False):
    place = '.'.join(str(part) for part in problem['loc'])
    text = problem['msg'].removeprefix('Value error, ').rstrip('.')
    if problem['type'] not in ('missing', 'value_error'):
      text = f'{text}, got {problem["input"]!r:.50}'
    found.append(f'{place}: {text}' if place else text)
  return '; '.join(found)
