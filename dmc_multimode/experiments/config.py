"""Configuration of a run, in one dataclass."""

import dataclasses
import difflib
import json
import math
from typing import Annotated, Any, Iterator, Mapping

import pydantic

from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import mode_sampler
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import constants
from dmc_multimode.utils import schedule
from dmc_multimode.walkers import robot as robot_lib

_Seed = Annotated[int, pydantic.Field(ge=0, lt=2**32)]
_Worlds = Annotated[int, pydantic.Field(ge=1, le=1_000_000)]


@config_lib.dataclass
class RunConfig:
  """Configuration that determines the result of a run.

  Defaults are the best values of docs/LEARNING.md.

  Attributes:
    modes: a set's name or mode names, comma-separated.
    steps: environment steps in all; a resumed run may be given others.
    seed: of all randomness.
    num_worlds: number of worlds of all processes.
    threads: of the physics and of torch, in each process; part of
      bit-reproducibility.
    one_hot: one-hot commands instead of an encoder's latents.
    init_from: initial policy, as the user named it; empty for none.
    init_modes: modes that the initial policy knows, comma-separated.
    ppo: of the learner.
    sampling: of Algorithm 1.
    task: of the imitation task.
  """

  modes: str = 'quickstart'
  steps: config_lib.PositiveInt = constants.TRAINING_STEPS
  seed: _Seed = 0
  num_worlds: _Worlds = 1024
  threads: config_lib.PositiveInt = 2
  one_hot: bool = False
  init_from: str = ''
  init_modes: str = ''
  ppo: ppo_config.PPOConfig = ppo_config.PPOConfig(
    symmetry='alternate',
    std_floor=schedule.Schedule(0.17, 0.05, 6_000_000, 9_000_000),
  )
  sampling: mode_sampler.SamplingConfig = mode_sampler.SamplingConfig(
    clock_rates=(0.5, 3.0)
  )
  task: task_config.ImitationConfig = task_config.ImitationConfig(
    # Longer than those of users, and faster: see docs/LEARNING.md.
    physics_timestep=0.0075,
    extra_observations=('displacement', 'clock_rate', 'previous_action'),
    events=events.TrainingEvents(
      # A looser bound on the distance at first.
      distance_slack=schedule.Schedule(0.15, 0.0, 0, 3_000_000),
      assistance_steps=2_000_000,
    ),
  )

  def __post_init__(self) -> None:
    config_lib.check_finite(self)


def for_robot(config: RunConfig, robot: robot_lib.Robot) -> RunConfig:
  """Returns a configuration, made for the mini biped, for another robot.

  Its task is scaled by `task_config.for_robot`, and its discount, so that the
  horizon, 1 / (1 - gamma) control steps, is as long in units of sqrt(h / g), h
  the height of the trunk: a tall robot takes longer to fall, and must see it
  coming.

  Args:
    config: with the lengths and times of the mini biped.
    robot: that is trained; its model is compiled.
  """
  task = task_config.for_robot(config.task, robot)
  shorter = task.control_timestep / config.task.control_timestep
  ahead = (1 - config.ppo.discount) * shorter / math.sqrt(robot.size)
  ppo = dataclasses.replace(config.ppo, discount=round(1 - ahead, 4))
  return dataclasses.replace(config, task=task, ppo=ppo)


def overridden(
  config: Any, changes: Mapping[str, Any], prefix: str = ''
) -> Any:
  """Returns a configuration with some values changed.

  Args:
    config: a `RunConfig`, or a part of it.
    changes: values by the names of flags: `ppo_discount` is the field
      `discount` of the part `ppo`.
    prefix: of these names, for errors.

  Raises:
    ValueError: in one line, there is no such field, or it refuses the value.
  """
  rest, new = dict(changes), {}
  for field in dataclasses.fields(config):
    name, value = field.name, getattr(config, field.name)
    if name in rest:
      new[name] = rest.pop(name)
    elif dataclasses.is_dataclass(value):
      inner = {
        key.removeprefix(f'{name}_'): rest.pop(key)
        for key in list(rest)
        if key.startswith(f'{name}_')
      }
      if inner:
        new[name] = overridden(value, inner, f'{prefix}{name}_')
  if rest:
    unknown = f'{prefix}{next(iter(rest))}'
    near = _nearest(unknown, _names(config, prefix))
    hint = f'; do you mean {" or ".join(near)}?' if near else ''
    raise ValueError(f'{unknown} is no setting of a run{hint}')
  try:
    return dataclasses.replace(config, **new)
  except ValueError as error:
    raise ValueError(f'{prefix}{error}') from error


def _nearest(unknown: str, names: list[str]) -> list[str]:
  """Returns up to three names that are like an unknown one, the likest first.

  Or like it when all words but the first are initials: `ppo_lr`.
  """
  spellings = {name: name for name in names}
  for name in names:
    first, *words = name.split('_')
    initials = ''.join(word[0] for word in words)
    spellings.setdefault(f'{first}_{initials}', name)
  near = difflib.get_close_matches(unknown, spellings, 3, 0.7)
  return list(dict.fromkeys(spellings[spelling] for spelling in near))


def _names(config: Any, prefix: str) -> list[str]:
  """Returns the names of the flags of a configuration's values."""
  found = []
  for field in dataclasses.fields(config):
    value, name = getattr(config, field.name), f'{prefix}{field.name}'
    is_part = dataclasses.is_dataclass(value)
    if is_part and not isinstance(value, schedule.Schedule):
      found += _names(value, f'{name}_')
    else:
      found.append(name)
  return found


def differences(
  one: Any, other: Any, prefix: str = ''
) -> Iterator[tuple[str, Any, Any]]:
  """Yields the values that two configurations differ in, by names of flags.

  Args:
    one, other: a `RunConfig` each, or the same part of one.
    prefix: of the names.
  """
  for field in dataclasses.fields(one):
    mine, yours = getattr(one, field.name), getattr(other, field.name)
    is_part = dataclasses.is_dataclass(mine)
    if is_part and not isinstance(mine, schedule.Schedule):
      yield from differences(mine, yours, f'{prefix}{field.name}_')
    elif mine != yours:
      yield f'{prefix}{field.name}', mine, yours


def to_dict(config: RunConfig) -> dict[str, Any]:
  """Returns the configuration as JSON values."""
  values = {
    **config_lib.to_dict(config),
    'task': task_config.to_dict(config.task),
  }
  # Tuples become lists, as in a file that is read.
  plain: dict[str, Any] = json.loads(json.dumps(values))
  return plain


def from_dict(values: Mapping[str, Any]) -> RunConfig:
  """Returns the configuration of a `to_dict`, also of an earlier version.

  Raises:
    ValueError: in one line, a field is unknown, missing or of the wrong type.
  """
  try:
    return config_lib.build(
      RunConfig,
      {
        **values,
        'ppo': ppo_config.upgraded(values['ppo']),
        'sampling': mode_sampler.upgraded(values['sampling']),
        'task': task_config.upgraded(values['task']),
      },
    )
  except (AttributeError, KeyError, TypeError, ValueError) as error:
    lacks = isinstance(error, KeyError)
    reason = f'it lacks {error}' if lacks else str(error).rstrip('.')
    raise ValueError(f'Not the configuration of a run: {reason}.') from error
