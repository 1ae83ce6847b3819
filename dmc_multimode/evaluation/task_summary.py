"""Summaries of a task in words and tables, for reports and policy cards.

Whatever a section says comes from the configuration and the modes; events that
this module has no words for are named by their fields.
"""

import dataclasses
from typing import Any, Iterator, Mapping, NamedTuple

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import disturbances as disturbances_lib
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.utils import schedule as schedule_lib

_KINDS = {
  motion_lib.PERIODIC: 'repeats',
  motion_lib.TRANSIENT: 'runs once',
  motion_lib.STEADY: 'one pose',
}
_NOWHERE = 0.01  # Metres and radians: less is none.
_FRAMES = {**observations.FRAMES, '': ''}

# Event -> a sentence in which {} is the value in words. An event that the next
# table has besides is in its sentence.
_EVENTS: Mapping[str, str] = {
  'reference_starts': 'Share of the episodes that start mid-stride, on the '
  'reference at a random phase: {}.',
  'edge_noise': 'Ledges are up to {} m nearer or farther than a mode expects.',
  'distance_slack': 'Added to the bound on the distance, metres: {}.',
  'assistance_steps': 'Help at take-offs fades over {} environment steps.',
  'contact_bonus': 'Weight of the bonus for feet that keep to the contacts of '
  'the reference: {}.',
  'precision_bonus': 'Weight of the bonus for precise tracking of place and '
  'orientation: {}.',
  'obstacles': 'Share of the commands that meet an obstacle: {}.',
  'push_speed': 'Largest push, m/s: {}.',
  'push_interval': 'Mean time between pushes: {} s.',
  'push_fraction': 'Probability of an episode to have pushes: {}.',
  'push_cost_share': 'Factor of the costs of loud motions after a push: {}.',
  'push_slack': 'Added to the bound on the distance after a push: {} m.',
  'disturbance_share': 'Share of the way from the nominal robot to the drawn '
  'one: {}.',
  'disturbance_fraction': 'Probability of each of these disturbances in an '
  'episode: {}.',
  'sensor_noise': "Sensor noise, 1 being a real robot's: {}.",
  'cost_share': 'Factor of these costs: {}.',
}
# Event -> the event without which it means nothing.
_DEPENDENT = {
  'push_interval': 'push_speed',
  'push_fraction': 'push_speed',
  'push_cost_share': 'push_speed',
  'push_slack': 'push_speed',
  'disturbance_share': 'disturbances',
  'disturbance_fraction': 'disturbances',
  'cost_share': 'costs',
}
# Events that are of no interest at their defaults.
_DEFAULTS = (
  'push_fraction',
  'push_cost_share',
  'push_slack',
  'disturbance_share',
  'disturbance_fraction',
  'cost_share',
)


class Section(NamedTuple):
  """A part of a summary.

  Attributes:
    title: of the part.
    sentences: in their order.
    columns: titles of the table's columns; none for no table.
    rows: of the table, each with the name of its row first.
  """

  title: str
  sentences: tuple[str, ...] = ()
  columns: tuple[str, ...] = ()
  rows: tuple[tuple[str, ...], ...] = ()


def describe(
  mode_set: mode_set_lib.ModeSet,
  trained: task_config.ImitationConfig,
  evaluated: task_config.ImitationConfig,
) -> list[Section]:
  """Returns the sections of a summary of a policy's task.

  Args:
    mode_set: of the policy.
    trained: the task of its training.
    evaluated: that of its evaluation.
  """
  return [
    _modes(mode_set),
    _reward(evaluated.gains),
    Section('Early ends', tuple(_limits(evaluated))),
    _observation(mode_set.latent_dim, evaluated),
    Section('Time', tuple(_time(trained, evaluated))),
    Section('Initial states', tuple(_initial_states(evaluated))),
    Section('Events of the training', tuple(events(trained.events))),
    Section('Events of the evaluation', tuple(events(evaluated.events))),
  ]


def _modes(mode_set: mode_set_lib.ModeSet) -> Section:
  """Returns the table of the modes' references."""
  columns = (
    *('mode', 'reference', 'duration (s)', 'goes', 'speed (m/s)'),
    *('highest (m)', 'flight (s)', 'ledge'),
  )
  rows = tuple(_mode(motion) for motion in mode_set.motions)
  return Section(
    'Modes',
    (
      'References of the trunk, by keyframes, at the clock rate 1: where it is '
      'after a cycle, and its height over the ground.',
    ),
    columns,
    rows,
  )


def _mode(motion: motion_lib.ReferenceMotion) -> tuple[str, ...]:
  """Returns the row of a mode."""
  way = motion.positions[-1] - motion.positions[0]
  speed = np.linalg.norm(way[:2]) / motion.duration
  flight = 0.0
  if motion.contacts is not None:
    aloft = ~motion.contacts[:-1].any(axis=1)
    flight = float(np.diff(motion.phases)[aloft].sum()) * motion.duration
  ledge = motion.ledge
  return (
    motion.name,
    _KINDS[motion.kind],
    f'{motion.duration:g}',
    _way(motion),
    f'{speed:.2f}' if speed else '',
    f'{motion.positions[:, 2].max():.2f}',
    f'{flight:.2f}' if flight else '',
    f'{ledge.height:+.2f} m after {ledge.edge:.2f} m' if ledge else '',
  )


def _way(motion: motion_lib.ReferenceMotion) -> str:
  """Returns where a reference ends, as seen from its start."""
  x, y, z = motion.positions[-1] - motion.positions[0]
  w, _, _, turn = motion.orientations[-1]
  angle = np.rad2deg(2 * np.arctan2(turn, w))
  angle -= 360 * np.round(angle / 360)
  parts = []
  for value, unit, words in (
    (x, ' m', ('ahead', 'back')),
    (y, ' m', ('left', 'right')),
    (z, ' m', ('up', 'down')),
    (angle, ' degrees', ('left', 'right')),
  ):
    if abs(value) > _NOWHERE:
      parts.append(f'{abs(value):.3g}{unit} {words[int(value < 0)]}')
  return ', '.join(parts)


def _reward(gains: rewards.RewardGains) -> Section:
  """Returns the terms of the reward."""
  rows = []
  for name in rewards.ERRORS:
    gain = getattr(gains, name)
    half = np.log(2) / gain.sensitivity if gain.sensitivity else np.inf
    rows.append(
      (
        name,
        f'{gain.weight:g}',
        f'{gain.sensitivity:g}',
        _half(name, half) if gain.weight else '',
      )
    )
  return Section(
    'Reward',
    (
      'The reward of a control step is the sum over the terms of weight times '
      'exp(-sensitivity times error), each error against the reference. At '
      f'most it is {gains.highest:g}; normalised, 1.',
    ),
    ('term', 'weight', 'sensitivity', 'halved by an error of'),
    tuple(rows),
  )


def _half(term: str, error: float) -> str:
  """Returns the error that halves a term, in a unit to read."""
  if term == 'position':
    return f'{error:.2f} m'
  if term == 'orientation' and error < 1:
    # The error is the squared sine of half the angle.
    return f'{np.rad2deg(2 * np.arcsin(np.sqrt(error))):.0f} degrees'
  return f'{error:.2f}'


def _limits(config: task_config.ImitationConfig) -> Iterator[str]:
  """Yields the bounds whose crossing ends an episode."""
  limits = config.limits
  angle = np.rad2deg(limits.angle) if limits.angle < np.pi else np.inf
  bounds = (
    (limits.distance, 'the trunk is more than {:g} m from its reference'),
    (angle, 'the trunk is turned by more than {:.0f} degrees from it'),
    (limits.height, 'the trunk is lower than {:g} m over the ground'),
    (limits.reward, 'the reward of a step is below {:g}'),
  )
  found = [text.format(bound) for bound, text in bounds if np.isfinite(bound)]
  yield 'An episode ends early when ' + _either([*found, 'the state diverges'])


def _either(parts: list[str]) -> str:
  """Returns the end of a sentence with alternatives."""
  *most, last = parts
  return f'{", ".join(most)}{" or " if most else ""}{last}.'


def _observation(
  latent_dim: int, config: task_config.ImitationConfig
) -> Section:
  """Returns the table of the policy's observation."""
  extra, robot = config.extra_observations, config.robot
  terms = observations.terms(extra=extra)
  layout = observations.layout(latent_dim, extra=extra, robot=robot)
  rows = tuple(
    (term.name.replace('_', ' '), str(size), term.unit, _FRAMES[term.frame])
    for term, (_, size) in zip(terms, layout, strict=True)
  )
  size = sum(length for _, length in layout)
  return Section(
    'Observation',
    (
      f'{size} numbers; the command is the latent of the mode. The action is '
      f'{robot.num_joints} joint targets, radians.',
    ),
    ('term', 'numbers', 'unit', 'frame'),
    rows,
  )


def _time(
  trained: task_config.ImitationConfig, evaluated: task_config.ImitationConfig
) -> Iterator[str]:
  """Yields the periods and the length of an episode."""
  milliseconds = lambda seconds: f'{1000 * seconds:g} ms'
  step = milliseconds(evaluated.physics_timestep)
  if trained.physics_timestep != evaluated.physics_timestep:
    step += f', in the training {milliseconds(trained.physics_timestep)}'
  period = milliseconds(evaluated.control_timestep)
  yield f'The policy acts every {period}. A physics step takes {step}.'
  length = f'{evaluated.time_limit:g} s, {evaluated.horizon} control steps'
  yield (
    f'An episode lasts {length}.'
    if np.isfinite(evaluated.time_limit)
    else 'An episode has no time limit.'
  )
  if evaluated.commands_from_ground:
    yield 'A command that would fall into a flight waits for the ground.'
  if evaluated.feasible_references:
    yield "References of gaits start with the robot's own speed."


def _initial_states(config: task_config.ImitationConfig) -> Iterator[str]:
  """Yields the noise of the initial states."""
  yield (
    'Episodes start in the crouch, with noise of standard deviations '
    f'{config.joint_noise:g} rad of the joints, {config.tilt_noise:g} rad of '
    f'roll and pitch, and {config.velocity_noise:g} m/s and rad/s.'
  )


def events(config: events_lib.TrainingEvents) -> Iterator[str]:
  """Yields a sentence for each event that there is; one if there is none."""
  found = list(_events(config))
  yield from found or ['Nothing: the robot is the nominal one.']


def _events(config: events_lib.TrainingEvents) -> Iterator[str]:
  for field in dataclasses.fields(config):
    name = field.name
    value, other = getattr(config, name), _DEPENDENT.get(name, name)
    if getattr(config, other) == getattr(events_lib.NONE, other):
      continue
    if name in _DEFAULTS and value == getattr(events_lib.NONE, name):
      continue
    if isinstance(value, disturbances_lib.Disturbances):
      yield f'Drawn for each episode: {", ".join(_disturbances(value))}.'
    elif name == 'costs':
      yield f'Costs, by weight: {", ".join(_weights(value))}.'
    else:
      general = f'{name.replace("_", " ").capitalize()}: {{}}.'
      yield _EVENTS.get(name, general).format(in_words(value))


def _disturbances(config: disturbances_lib.Disturbances) -> Iterator[str]:
  """Yields the ranges of the rows that are not nominal."""
  for row in dataclasses.fields(config):
    if row.name in config.active:
      low, high = getattr(config, row.name)
      between = f'{low:g}' if low == high else f'{low:g} to {high:g}'
      unit = row.metadata['unit']
      yield f'{row.name.replace("_", " ")} {between}{unit and f" {unit}"}'


def _weights(costs: Any) -> Iterator[str]:
  """Yields the costs with a weight."""
  for name, weight in vars(costs).items():
    if isinstance(weight, (int, float)) and weight:
      yield f'{name.replace("_", " ")} {weight:g}'


def in_words(value: Any) -> str:
  """Returns a number or a schedule in words."""
  if not isinstance(value, schedule_lib.Schedule):
    is_count = isinstance(value, int) and not isinstance(value, bool)
    return _steps(value) if is_count else f'{value:g}'
  first, last = f'{value.first:g}', f'{value.last:g}'
  if first == last:
    return last
  start, end = _steps(value.start), _steps(value.end)
  until = f'until step {start}' if value.start else 'at first'
  since = 'from then on' if start == end else f'from step {end} on'
  return f'{first} {until}, {last} {since}'


def _steps(count: int) -> str:
  """Returns a number of steps, in millions if there are some."""
  return f'{count / 1e6:g} million' if count >= 1_000_000 else f'{count:,}'
