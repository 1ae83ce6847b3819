"""Flags of paths, and flags generated from configuration dataclasses.

A path is read as a shell reads it, wherever it comes from: `~` is the home
folder, in quotes and in flagfiles, too. So every flag that names a file or a
folder is defined by `define_path`.

A field `discount` of a class defined under the prefix 'ppo' becomes the flag
`--ppo_discount`; the fields of a configuration in it are flags of their own.
Its help comes from the docstring of the class, its parser from the type of the
field, and so do the bounds that the help states. For schedules see
`utils.schedule.parse`. Flags of a configuration are a group of the help, under
the first line of its class.
"""

import dataclasses
import inspect
import re
import typing
from typing import Any, Iterator, Mapping, Sequence

from absl import flags
import pydantic

from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import files
from dmc_multimode.utils import schedule

FLAGS = flags.FLAGS
# Flags of paths are of the command that asks for them, as absl's own are.
flags.disclaim_key_flags()
# absl lists flags by module, and takes the group of a configuration for one.
# The name of no other begins like this.
_GROUP = '--'

# Former names of flags -> their replacement, for the error.
RENAMED = {
  'ppo_min_std': 'ppo_std_floor=STD, or STD:FINAL@START:END',
  'ppo_final_min_std': 'ppo_std_floor=STD:FINAL@START:END',
  'ppo_anneal_start': 'ppo_std_floor=STD:FINAL@START:END',
  'ppo_anneal_end': 'ppo_std_floor=STD:FINAL@START:END',
  'ppo_quiet_share': 'ppo_deterministic_fraction=0:SHARE@START',
  'ppo_quiet_start': 'ppo_deterministic_fraction=0:SHARE@START',
  'ppo_quiet_steps': 'ppo_deterministic_steps',
  'ppo_anchor_weight': 'ppo_kickstarting_weight',
  'sampling_adaptive': 'sampling_kind=uniform for false',
  'sampling_gait_steps': 'sampling_gait_fraction=0.7:0@STEPS',
  'sampling_gait_share': 'sampling_gait_fraction=SHARE:0@STEPS',
  'sampling_focus_start': 'sampling_focus_fraction=0:SHARE@START',
  'sampling_focus_share': 'sampling_focus_fraction=0:SHARE@START',
  'sampling_focus_steps': 'sampling_focus_end',
  'task_early_distance': 'task_events_distance_slack=SLACK:0@0:STEPS',
  'task_tighten_steps': 'task_events_distance_slack=SLACK:0@0:STEPS',
  'task_assist_steps': 'task_events_assistance_steps',
  'task_contact_bonus': 'task_events_contact_bonus=BONUS:LATE@START:END',
  'task_late_contact_bonus': 'task_events_contact_bonus=BONUS:LATE@START:END',
  'task_contact_bonus_start': 'task_events_contact_bonus=BONUS:LATE@START:END',
  'task_contact_bonus_end': 'task_events_contact_bonus=BONUS:LATE@START:END',
  'task_obstacles': 'task_events_obstacles=0:SHARE@START',
  'task_obstacles_start': 'task_events_obstacles=0:SHARE@START',
  'task_push_speed': 'task_events_push_speed=0:SPEED@START',
  'task_push_start': 'task_events_push_speed=0:SPEED@START',
  'task_push_interval': 'task_events_push_interval',
  'task_reference_starts': 'task_events_reference_starts',
  'task_edge_noise': 'task_events_edge_noise',
}

# Former names of flags without a replacement -> the reason, for the error.
REMOVED = {'ppo_compile': 'torch.compile made trainings no faster'}

# Flags that fix disturbances, see `events.fixed` -> help. The suite, which has
# the table, cannot be imported before a backend of OpenGL is chosen.
DISTURBANCES = {
  'action_delay': 'From an action to the servos, seconds; 0.03 is hard.',
  'friction': 'Of feet and ground; 0.9 is nominal.',
  'mass': 'Factor of all masses.',
  'payload': 'Mass added to the trunk, kg.',
  'centre_of_mass': "Forward shift of the trunk's, metres.",
  'motor_strength': "Factor of the servos' gains and torque limits.",
  'slope': 'Of the ground, up along x, radians.',
  'odometry_drift': '1 is 2 percent of the way and 1 degree a metre.',
  'push_speed': 'Largest velocity of random pushes, m/s.',
  'sensor_noise': 'Of observations; 1 is that of real sensors.',
}

# Fields of `RunConfig` that are one flag, and nested configurations, whose
# fields are flags.
_SIMPLE = ('steps', 'seed', 'num_worlds', 'threads', 'one_hot')
_PARTS = ('ppo', 'sampling', 'task')


class _PathParser(flags.ArgumentParser):
  """Parser of a flag for a file or folder, or for a name in its place."""

  syntactic_help = 'a path'

  def parse(self, argument: str) -> str:
    """Returns the path; raises ValueError for the home of nobody."""
    return files.expand(argument)


def define_path(
  name: str, default: str | None, text: str, required: bool = False
) -> flags.FlagHolder[Any]:
  """Defines a flag for a file or folder, or for a name in its place."""
  parser = _PathParser()
  return flags.DEFINE(parser, name, default, text, FLAGS, required=required)


def define_paths(
  name: str, default: Sequence[str], text: str
) -> flags.FlagHolder[Any]:
  """Defines such a flag that may be given many times."""
  parser, serializer = _PathParser(), flags.ArgumentSerializer[str]()
  return flags.DEFINE_multi(parser, serializer, name, default, text, FLAGS)


def define_robot() -> flags.FlagHolder[str | None]:
  """Defines --robot of a command that has a policy already."""
  return define_path(
    'robot',
    None,
    'File of the robot that the policy must have been trained for; its own is '
    'in its files.',
  )


def define_sizes() -> flags.FlagHolder[list[str]]:
  """Defines --sizes, for `read_sizes`."""
  return flags.DEFINE_list(
    'sizes',
    [],
    'Of the arena, metres: width:0.3,distance:1.0. Of a course, too, whose '
    'difficulty is 0 to 1: difficulty:0.5,length:9.',
    FLAGS,
  )


def read_sizes(items: Sequence[str]) -> dict[str, float]:
  """Returns the sizes of --sizes, metres, by name; raises ValueError."""
  sizes: dict[str, float] = {}
  for item in items:
    name, _, value = item.partition(':')
    try:
      sizes[name.strip()] = float(value)
    except ValueError as error:
      raise ValueError(f'--sizes: {item!r} is not NAME:METRES.') from error
  return sizes


class _Parser(flags.ArgumentParser):
  """Parser of a flag for a field of a configuration."""

  def __init__(self, kind: Any):
    """Parses values of the type `kind`."""
    plain = kind
    while typing.get_origin(plain) is typing.Annotated:
      plain = typing.get_args(plain)[0]
    self._is_list = typing.get_origin(plain) is tuple
    self._is_of_names = self._is_list and typing.get_args(plain)[0] is str
    is_schedule = plain is schedule.Schedule
    self._adapter = pydantic.TypeAdapter(
      kind,
      config=None if is_schedule else pydantic.ConfigDict(allow_inf_nan=False),
    )
    self.syntactic_help = (
      'a schedule over environment steps, FIRST[:LAST][@START[:END]]'
      if is_schedule
      else _describe(self._adapter.json_schema())
    )

  def parse(self, argument: Any) -> Any:
    """Returns the value; raises ValueError if the field refuses it."""
    if self._is_list and isinstance(argument, str):
      # No names are a list; no number is an error.
      is_empty = self._is_of_names and not argument
      argument = [] if is_empty else argument.split(',')
    try:
      return self._adapter.validate_python(argument)
    except pydantic.ValidationError as error:
      raise ValueError(config_lib.describe(error)) from error


class _Serializer(flags.ArgumentSerializer):
  """Serialises values to text for `_Parser`."""

  def serialize(self, value: Any) -> str:
    """Returns the text."""
    return ','.join(map(str, value if isinstance(value, tuple) else (value,)))


def _describe(schema: Mapping[str, Any]) -> str:
  """Returns the type and the bounds of a JSON schema in words; '' for text."""
  kind = schema.get('type')
  if kind == 'array':
    if 'prefixItems' in schema:
      return 'two numbers, LOW,HIGH'
    items = re.sub('a (.*?number)', r'\1s', _describe(schema['items']))
    return f'{items or "names"}, comma-separated'
  nouns = {'number': 'a number', 'integer': 'a whole number'}
  if kind not in nouns:
    return ''
  is_range = 'maximum' in schema or 'exclusiveMaximum' in schema
  words = (
    ('minimum', 'from' if is_range else 'at least'),
    ('exclusiveMinimum', 'above'),
    ('maximum', 'to'),
    ('exclusiveMaximum', 'to below'),
  )
  bounds = [f'{word} {schema[key]:g}' for key, word in words if key in schema]
  return ' '.join([nouns[kind], *bounds])


def define(config: Any, prefix: str) -> None:
  """Defines a flag for every field of `config`, whose values are defaults."""
  kinds = typing.get_type_hints(type(config), include_extras=True)
  texts = _attributes(type(config))
  title = inspect.cleandoc(type(config).__doc__ or '').partition('\n')[0]
  group = f'{_GROUP}{prefix}_*: {title.rstrip(".")}'
  for field, default in _fields(config):
    name, text = f'{prefix}_{field}', texts.get(field, '')
    if _is_nested(default):
      define(default, name)
    elif isinstance(default, bool):
      flags.DEFINE_bool(name, default, text, FLAGS, module_name=group)
    else:
      parser, serializer = _Parser(kinds[field]), _Serializer()
      flags.DEFINE(
        parser, name, default, text, FLAGS, serializer, module_name=group
      )


def help_texts() -> list[str]:
  """Returns the help of each group of flags of configurations, by its name."""
  groups = sorted(FLAGS.flags_by_module_dict())
  return [FLAGS.module_help(g) for g in groups if g.startswith(_GROUP)]


def read(config: Any, prefix: str) -> Any:
  """Returns `config` with the values of the flags that were given.

  Raises:
    ValueError: the configuration refuses their combination.
  """
  changes: dict[str, Any] = {}
  for field, value in _fields(config):
    name = f'{prefix}_{field}'
    if _is_nested(value):
      changes[field] = read(value, name)
    elif FLAGS[name].present:
      changes[field] = FLAGS[name].value
  try:
    return dataclasses.replace(config, **changes)
  except ValueError as error:
    raise ValueError(f'--{prefix}_*: {error}') from error


def define_settings() -> None:
  """Defines the flags of the fields of `RunConfig`, but for its modes."""
  # Late, as it takes a moment.
  from dmc_multimode.experiments import config as run_config

  defaults = run_config.RunConfig()
  flags.DEFINE_integer(
    'steps',
    defaults.steps,
    'Environment steps in all; of a run that is resumed by default its own.',
  )
  flags.DEFINE_integer('seed', defaults.seed, 'Of all randomness.')
  flags.DEFINE_integer(
    'num_worlds',
    defaults.num_worlds,
    'Worlds that are stepped together, by all processes.',
  )
  flags.DEFINE_integer(
    'threads',
    None,
    'Threads of the physics and of torch, in each process; by default one for '
    'each core.',
  )
  flags.DEFINE_bool(
    'one_hot', defaults.one_hot, 'One-hot commands instead of latents.'
  )
  for part in _PARTS:
    define(getattr(defaults, part), part)


def given_settings() -> dict[str, Any]:
  """Returns the values of the given flags of `define_settings`, by name."""
  from dmc_multimode.experiments import config as run_config

  values = {name: FLAGS[name].value for name in _SIMPLE if FLAGS[name].present}
  for part in _PARTS:
    values |= given(getattr(run_config.RunConfig(), part), part)
  return values


def define_disturbances() -> None:
  """Defines a flag for each of `DISTURBANCES`."""
  for name, text in DISTURBANCES.items():
    flags.DEFINE_float(name, None, text)


def given_disturbances() -> dict[str, float]:
  """Returns the values of the disturbances whose flags are given."""
  values = {name: FLAGS[name].value for name in DISTURBANCES}
  return {name: value for name, value in values.items() if value is not None}


def given(config: Any, prefix: str) -> dict[str, Any]:
  """Returns the values of the given flags of `config`, by name."""
  found: dict[str, Any] = {}
  for field, value in _fields(config):
    name = f'{prefix}_{field}'
    if _is_nested(value):
      found |= given(value, name)
    elif FLAGS[name].present:
      found[name] = FLAGS[name].value
  return found


def _attributes(kind: type) -> dict[str, str]:
  """Returns the descriptions of fields in the docstring of a class."""
  _, _, section = inspect.cleandoc(kind.__doc__ or '').partition(
    'Attributes:\n'
  )
  texts = {}
  section = '\n' + section.partition('\n\n')[0]
  for entry in re.split(r'\n(?=  \w)', section):
    names, _, text = entry.partition(':')
    for name in names.split(','):
      texts[name.strip()] = ' '.join(text.split())
  return texts


def _is_nested(value: Any) -> bool:
  return dataclasses.is_dataclass(value) and not isinstance(
    value, schedule.Schedule
  )


def _fields(config: Any) -> Iterator[tuple[str, Any]]:
  for field in dataclasses.fields(config):
    if field.metadata.get('flag', True):
      yield field.name, getattr(config, field.name)
