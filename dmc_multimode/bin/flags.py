"""Flags generated from the fields of configuration dataclasses.

A field `discount` of a class defined under the prefix 'ppo' becomes the flag
`--ppo_discount`; the fields of a nested configuration are flags of their own. A
schedule is a text, see `utils.schedule.parse`.
"""

import dataclasses
from typing import Any, Iterator

from absl import flags
import pydantic

from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import schedule

FLAGS = flags.FLAGS


def define(config: Any, prefix: str) -> None:
  """Defines a flag for every field of `config`, whose values are defaults."""
  for name, default in _leaves(config, prefix):
    text = f'See {type(config).__name__}.'
    if isinstance(default, bool):
      flags.DEFINE_bool(name, default, text)
    elif isinstance(default, int):
      flags.DEFINE_integer(name, default, text)
    elif isinstance(default, float):
      flags.DEFINE_float(name, default, text)
    elif isinstance(default, str):
      flags.DEFINE_string(name, default, text)
    elif isinstance(default, schedule.Schedule):
      flags.DEFINE_string(name, schedule.to_text(default), text)
    elif isinstance(default, tuple):
      flags.DEFINE_list(name, [str(item) for item in default], text)
    else:
      raise TypeError(f'{name} has no kind of flag: {default!r}')


def read(config: Any, prefix: str) -> Any:
  """Returns `config` with the values of those of its flags that were given.

  Raises:
    ValueError: a list holds something that is no integer, or the configuration
      refuses a value.
  """
  changes: dict[str, Any] = {}
  for field, value in _fields(config):
    name = f'{prefix}_{field}'
    if _is_nested(value):
      changes[field] = read(value, name)
    elif not FLAGS[name].present:
      continue
    elif isinstance(value, tuple):
      changes[field] = _integers(name)
    elif isinstance(value, schedule.Schedule):
      changes[field] = _schedule(name)
    else:
      changes[field] = FLAGS[name].value
  return replace(config, **changes)


def overrides(config: Any, prefix: str) -> list[str]:
  """Names of the flags of `config` that were given."""
  return [name for name, _ in _leaves(config, prefix) if FLAGS[name].present]


def replace(config: Any, **changes: Any) -> Any:
  """Returns a dataclass or NamedTuple with some fields changed."""
  if _is_named_tuple(config):
    return config._replace(**changes)
  try:
    return dataclasses.replace(config, **changes)
  except pydantic.ValidationError as error:
    raise ValueError(config_lib.describe(error)) from error


def _integers(name: str) -> tuple[int, ...]:
  try:
    return tuple(int(item) for item in FLAGS[name].value or ())
  except ValueError as error:
    raise ValueError(f'--{name} needs integers: {error}') from error


def _schedule(name: str) -> schedule.Schedule:
  try:
    return schedule.parse(str(FLAGS[name].value))
  except ValueError as error:
    raise ValueError(f'--{name}: {error}') from error


def _is_nested(value: Any) -> bool:
  if isinstance(value, schedule.Schedule):
    return False
  return dataclasses.is_dataclass(value) or _is_named_tuple(value)


def _is_named_tuple(value: Any) -> bool:
  return isinstance(value, tuple) and hasattr(value, '_fields')


def _fields(config: Any) -> Iterator[tuple[str, Any]]:
  if _is_named_tuple(config):
    yield from config._asdict().items()
  else:
    for field in dataclasses.fields(config):
      yield field.name, getattr(config, field.name)


def _leaves(config: Any, prefix: str) -> Iterator[tuple[str, Any]]:
  """Flag names and values of all fields, nested ones included."""
  for field, value in _fields(config):
    name = f'{prefix}_{field}'
    if _is_nested(value):
      yield from _leaves(value, name)
    else:
      yield name, value
