"""Policy cards: a README.md in the folder of each shipped policy.

    python -m benchmarks.release.cards

writes those of all shipped policies from their policy.json and metrics.json;
`benchmarks.release.ship` writes that of the policy it ships.
"""

import functools
import shlex
from typing import Any, Iterable, Iterator, Mapping, NamedTuple, Sequence

from dmc_multimode.bin import app
from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.evaluation import task_summary
from dmc_multimode.experiments import config as run_config
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import steering
from dmc_multimode.pretrained import folder as folder_lib
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import files
from dmc_multimode.walkers import robot as robot_lib

CARD_FILE = 'README.md'
_WORST = 3  # Transitions that are named.
_UNSET = ('init_modes', 'steps')  # No flag of their own, or written apart.
_LOW = 0.995  # Survival below which the card warns.


class _Policy(NamedTuple):
  """Content of a policy's folder, as far as a card tells it."""

  name: str
  modes: mode_set_lib.ModeSet
  trained: task_config.ImitationConfig
  evaluated: task_config.ImitationConfig
  run: run_config.RunConfig
  provenance: Mapping[str, Any]
  metrics: Mapping[str, Any]
  selector: Mapping[str, Any] | None

  @property
  def robot(self) -> str:
    """Name of the robot."""
    return self.trained.robot.name

  @property
  def is_old(self) -> bool:
    """True for a policy of version 0.1.0, whose runs did not store steps."""
    return 'steps' not in self.provenance['run']


def card(
  name: str,
  description: Mapping[str, Any],
  metrics: Mapping[str, Any],
  selector: Mapping[str, Any] | None = None,
) -> str:
  """Returns the card of a shipped policy, in Markdown.

  Args:
    name: of the policy.
    description: content of its policy.json.
    metrics: content of its metrics.json.
    selector: content of its selector's selector.json, if it has one.

  Raises:
    KeyError, ValueError: the contents are not those of a shipped policy.
  """
  policy = _Policy(
    name,
    mode_files.mode_set_from_dict(dict(description)),
    task_config.from_dict(description['task']),
    # A report has the robot's name and hash alone.
    task_config.from_dict(
      {**metrics['task'], **_only(description['task'], 'robot')}
    ),
    run_config.from_dict(description['provenance']['run']),
    description['provenance'],
    metrics,
    selector,
  )
  parts = (
    _introduction,
    _scores,
    _modes,
    _acceptance,
    _motion,
    _training,
    _selector,
    _limits,
    _licence,
  )
  return '\n'.join(line for part in parts for line in part(policy))


def _only(values: Mapping[str, Any], name: str) -> dict[str, Any]:
  """Returns one of the values, if it is there."""
  return {name: values[name]} if name in values else {}


def _introduction(policy: _Policy) -> Iterator[str]:
  count = len(policy.modes)
  yield f'# {policy.name}'
  yield ''
  modes = _several(count, 'locomotion mode')
  more = f' and the {count**2} transitions between them' if count > 1 else ''
  yield (
    f'A policy of dmc_multimode for {modes} of the simulated '
    f'{policy.robot.replace("_", " ")}{more}. This card is written by '
    '`python -m benchmarks.release.cards` from `policy.json` and '
    '`metrics.json`.'
  )
  yield ''
  yield '```python'
  yield 'import dmc_multimode as dmm'
  yield ''
  yield f"policy = dmm.load_policy('{policy.name}')"
  yield '```'
  yield ''


def _several(count: int, noun: str) -> str:
  """Returns a number with its noun."""
  return f'{count} {noun}{"s" * (count != 1)}'


def _scores(policy: _Policy) -> Iterator[str]:
  metrics = policy.metrics
  rows = [
    (
      f'{kind} ({len(metrics[kind])})',
      f'{metrics[f"mra_{kind}"]["mean"]:.3f}',
      f'{metrics[f"mra_{kind}"]["std"]:.3f}',
      f'{metrics[f"survival_{kind}"]:.3f}',
    )
    for kind in ('modes', 'transitions')
  ]
  yield '## Scores'
  yield ''
  yield from _table(
    ('mean over', 'MRA', 'standard deviation', 'survival'), rows
  )
  episodes = _several(metrics['episodes_per_case'], 'episode')
  yield (
    'MRA is the mean normalised return, 1 for perfect tracking; survival is '
    'the share of episodes that reach their time limit. Deterministic actions, '
    f'seed {metrics["seed"]}, {episodes} of each transition at each phase and '
    'clip and four times as many of each mode, physics steps of '
    f'{1000 * policy.evaluated.physics_timestep:g} ms.'
  )
  yield ''


def _modes(policy: _Policy) -> Iterator[str]:
  metrics = policy.metrics
  (summary, *_) = task_summary.describe(
    policy.modes, policy.trained, policy.evaluated
  )
  rows = [
    (
      *row,
      f'{metrics["modes"][row[0]]["mra"]:.3f}',
      f'{metrics["modes"][row[0]]["survival"]:.3f}',
    )
    for row in summary.rows
  ]
  yield '## Modes'
  yield ''
  yield from _table((*summary.columns, 'MRA', 'survival'), rows)
  transitions = sorted(
    metrics['transitions'].items(), key=lambda item: float(item[1]['mra'])
  )
  if len(policy.modes) > 1:
    worst = [
      f'{name} ({row["mra"]:.3f}, survival {row["survival"]:.3f})'
      for name, row in transitions[:_WORST]
    ]
    yield f'Transitions with the lowest MRA: {", ".join(worst)}.'
    yield ''


def _acceptance(policy: _Policy) -> Iterator[str]:
  rows = [
    (
      mode,
      metric,
      *(_number(row[key]) for key in ('value', 'worst', 'least', 'most')),
      'yes' if row['passed'] else '**no**',
    )
    for mode, found in policy.metrics['acceptance'].items()
    for metric, row in found.items()
  ]
  yield '## Acceptance criteria'
  yield ''
  passed = sum(row[-1] == 'yes' for row in rows)
  yield (
    "Bounds of the mean that each mode's reference asks for, beyond the "
    f'reward: {passed} of {len(rows)} passed.'
  )
  yield ''
  yield from _table(
    ('mode', 'criterion', 'mean', 'worst', 'least', 'most', 'passed'), rows
  )


def _motion(policy: _Policy) -> Iterator[str]:
  modes = policy.metrics.get('motion', {})
  if not modes:
    return
  rows = [
    (
      metric.name.replace('_', ' ') + (metric.unit and f' ({metric.unit})'),
      *(_number(row.get(metric.name)) for row in modes.values()),
    )
    for metric in motion_metrics.TABLE
  ]
  yield '## Motion'
  yield ''
  yield (
    'From every physics step of episodes that only a fall ends; '
    '`dmc_multimode/evaluation/motion_metrics.py` says what each is.'
  )
  yield ''
  yield from _table(('metric', *modes), rows)


def _training(policy: _Policy) -> Iterator[str]:
  provenance, run = policy.provenance, policy.run
  yield '## Training'
  yield ''
  yield (
    f'{provenance["steps"]:,} environment steps of {run.num_worlds:,} worlds, '
    f'seed {run.seed}, with mujoco {provenance["mujoco"]} and torch '
    f'{provenance["torch"]}; the curves are in `training.csv`. PPO with '
    f'{_commands(policy)}; the {run.sampling.kind} sampler chose modes and '
    'transitions.'
  )
  yield ''
  if policy.is_old:
    yield (
      'It was trained by version 0.1.0, on a robot with softer contacts; the '
      'scores above are those on the robot of this version. With this version '
      'the command is:'
    )
  else:
    yield 'The command:'
  yield ''
  yield '```sh'
  yield ' \\\n  '.join(['python -m dmc_multimode.bin.train', *command(policy)])
  yield '```'
  yield ''
  yield 'Events of the training:'
  yield ''
  yield from (
    f'- {text}' for text in task_summary.events(policy.trained.events)
  )
  yield ''


def _commands(policy: _Policy) -> str:
  """Returns what commands a mode to the network."""
  if policy.run.one_hot:
    return 'one-hot commands'
  return f'latents of length {policy.modes.latent_dim}'


def command(policy: _Policy) -> Iterator[str]:
  """Yields the arguments of the training, as far as they are no defaults."""
  run, default = policy.run, run_config.RunConfig()
  steps = policy.provenance['steps']
  if not policy.is_old:
    steps = min(steps, run.steps)
  yield f'--run_dir=runs/{policy.name}'
  yield f'--steps={steps}'
  if policy.robot != robot_lib.MINI_BIPED:
    yield f'--robot={policy.robot}'
  for name, one, other in run_config.differences(default, run):
    if name not in _UNSET and _text(one) != _text(other):
      yield f'--{name}={shlex.quote(_text(other))}'


def _selector(policy: _Policy) -> Iterator[str]:
  if policy.selector is None:
    return
  provenance = policy.selector['provenance']
  training = provenance['training']
  tracks = ' or '.join(dict.fromkeys(training['arena'].split('+')))
  yield '## Selector'
  yield ''
  yield (
    'A network beside it sees the ground ahead and commands the modes, every '
    f'{policy.selector["knot_duration"]:g} s (`plan --planner=selector`; it '
    'guides `--planner=guided`, too). It learned by PPO from '
    f'{provenance["decisions"]:,} choices on tracks of {tracks}, seed '
    f'{training["seed"]}, pushed by up to '
    f'{training["task"]["push_speed"]:g} m/s.{_began(training)}'
  )
  yield ''


def _began(training: Mapping[str, Any]) -> str:
  """Returns a sentence on the selector that a training went on from."""
  start = training.get('init_from')
  return f' It went on from another: {start}.' if start else ''


def _text(value: Any) -> str:
  """Returns a value as a flag takes it."""
  if isinstance(value, bool):
    return str(value).lower()
  return ','.join(map(str, value if isinstance(value, tuple) else (value,)))


def _limits(policy: _Policy) -> Iterator[str]:
  yield '## Limits of use'
  yield ''
  yield from (f'- {text}' for text in _limitations(policy))
  yield ''


def _model(policy: _Policy) -> str:
  """Returns where the robot's declaration is."""
  of_its_own = policy.robot == robot_lib.MINI_BIPED
  return f'xml/{"" if of_its_own else "robots/"}{policy.robot}.yaml'


def _limitations(policy: _Policy) -> Iterator[str]:
  """Yields the sentences on what the policy is not for."""
  events, metrics = policy.trained.events, policy.metrics
  yield (
    f'It moves the simulated robot of `{_model(policy)}`. It has never been on '
    'a robot, and knows nothing of people, power or heat.'
  )
  yield (
    'It was measured in its own modes. Blends of them and other latents were '
    'not, and a new mode takes a training.'
  )
  drawn = events.disturbances.active
  if drawn and events.disturbance_share.largest > 0:
    names = ', '.join(name.replace('_', ' ') for name in drawn)
    yield (
      f'It was trained within the ranges above of {names}: beyond them, expect '
      'falls.'
    )
  else:
    yield (
      'It was trained on the nominal robot alone: with other masses, '
      'frictions, motors or delays, expect falls.'
    )
  if 'ground_scan' not in policy.trained.extra_observations:
    yield (
      'It does not see the ground. Ledges have to be where its modes expect '
      f'them, within {events.edge_noise:g} m, and obstacles are felt, not seen.'
    )
  low, high = policy.run.sampling.clock_rates
  rates = f'{low:g}' if low == high else f'{low:g} to {high:g}'
  yield f'Its clock rates in the training were {rates}.'
  for kind in ('modes', 'transitions'):
    survival = metrics[f'survival_{kind}']
    if survival < _LOW:
      yield f'{100 * (1 - survival):.1f} % of the episodes of {kind} end early.'
  failed = [
    f'{mode} {metric}'
    for mode, rows in metrics['acceptance'].items()
    for metric, row in rows.items()
    if not row['passed']
  ]
  if failed:
    yield f'It does not pass these criteria: {", ".join(failed)}.'


def _licence(policy: _Policy) -> Iterator[str]:
  del policy
  yield '## Licence'
  yield ''
  yield 'Apache 2.0, as all of dmc_multimode: see the file LICENSE.'
  yield ''


def _number(value: float | None) -> str:
  """Returns three decimals, nothing for None."""
  return '' if value is None else f'{value:.3f}'


def _table(
  columns: Sequence[str], rows: Iterable[Sequence[str]]
) -> Iterator[str]:
  """Yields the lines of a table, and an empty one."""
  yield f'| {" | ".join(columns)} |'
  yield f'|{"---|" * len(columns)}'
  for row in rows:
    yield f'| {" | ".join(row)} |'
  yield ''


def read(name: str) -> str:
  """Returns the card of a shipped policy, from the files in its folder."""
  folder = folder_lib.find(name)
  beside = folder / steering.BESIDE / selector_lib.DESCRIPTION_FILE
  return card(
    name,
    folder_lib.read_description(folder),
    folder_lib.read_json(folder / policy_lib.METRICS_FILE),
    folder_lib.read_json(beside) if beside.is_file() else None,
  )


def main(argv: Sequence[str]) -> None:
  """Writes the cards of all shipped policies."""
  del argv
  for name in folder_lib.names():
    path = folder_lib.find(name) / CARD_FILE
    files.write(path, read(name).encode())
    print(path)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
