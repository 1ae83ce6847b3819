"""Evaluates a policy: every mode, every transition, no exploration.

python -m dmc_multimode.bin.evaluate --policy=quickstart --out=report.json
"""

import copy
import dataclasses
import itertools
import json
import os
import pathlib
from typing import Any, Sequence

from absl import flags
import numpy as np
import tqdm

from dmc_multimode import atomic
from dmc_multimode import pretrained
from dmc_multimode.agents import evaluation
from dmc_multimode.bin import app
from dmc_multimode.bin import config_flags
from dmc_multimode.bin import figures
from dmc_multimode.modes import reference
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import batched
from dmc_multimode.suite import behaviour
from dmc_multimode.suite import body
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes as episodes_lib
from dmc_multimode.suite import multimode_biped

_POLICY = flags.DEFINE_string(
  'policy', None, 'Name of a shipped policy, or a folder.', required=True
)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write the report to.')
_FIGURES = flags.DEFINE_string(
  'figures', None, 'Folder to draw into: heights over time, and through a plan.'
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.')
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Of each transition at each phase and clip; modes get 4 times.'
)
_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, 'Seconds; that of the training by default.'
)
_CLOCK_RATE = flags.DEFINE_float('clock_rate', 1.0, 'Of the modes.')
MODE_FACTOR = 4  # Episodes of a mode for one of each transition.


class Evaluator:
  """Runs schedules of one policy, one episode a world."""

  def __init__(
    self,
    policy: pretrained.Policy,
    config: config_lib.ImitationConfig,
    seed: int,
  ):
    """Evaluates `policy` on the task of `config`."""
    self.policy, self.config, self.seed = policy, config, seed
    self.bank = reference.ReferenceBank(policy.motions)

  def lasting(self, seconds: float) -> 'Evaluator':
    """Returns one whose episodes are that long."""
    other = copy.copy(self)
    other.config = dataclasses.replace(self.config, time_limit=seconds)
    return other

  def traces(
    self, episodes: evaluation.Episodes, cycle: float
  ) -> list[body.Trace]:
    """Returns what the body did in episodes of a mode with that cycle, s."""
    return body.traces(
      episodes.traces, episodes.lengths, self.config.control_timestep, cycle
    )

  def run(
    self, schedule: schedule_lib.ModeSchedule, label: str
  ) -> evaluation.Episodes:
    """Runs one episode of each row of `schedule`."""
    task = multimode_biped.make_task(
      self.policy.motions,
      self.policy.codebook,
      episodes_lib.ScheduledEpisodes(schedule),
      config=self.config,
    )
    worlds = batched.BatchedImitation(
      task, len(schedule), self.seed, auto_reset=False
    )
    with tqdm.tqdm(total=self.config.horizon, desc=label, unit='step') as bar:
      return evaluation.run_episodes(
        worlds, self.policy.select_action, bar.update
      )


def evaluate_modes(
  evaluator: Evaluator, episodes: int, clock_rate: float
) -> dict[str, dict[str, float]]:
  """Every mode alone: its MRA, survival and what the body did."""
  bank = evaluator.bank
  modes = np.repeat(np.arange(len(bank)), episodes)
  found = evaluator.run(schedule_lib.single(modes, clock_rate), 'modes')
  result = {}
  for i, name in enumerate(bank.names):
    mine = found.rows(np.flatnonzero(modes == i))
    traces = evaluator.traces(mine, bank.durations[i] / clock_rate)
    rows = [body.metrics(trace) for trace in traces]
    result[name] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
      **{key: float(np.mean([row[key] for row in rows])) for key in rows[0]},
    }
  return result


def evaluate_behaviour(
  evaluator: Evaluator, episodes: int
) -> dict[str, dict[str, dict[str, Any]]]:
  """What every mode promises, and how it is kept: see `suite.behaviour`."""
  bank = evaluator.bank
  longer = evaluator.lasting(behaviour.DURATION)
  modes = np.repeat(np.arange(len(bank)), episodes)
  found = longer.run(schedule_lib.single(modes), 'behaviour')
  result = {}
  for i, motion in enumerate(bank.motions):
    mine = found.rows(np.flatnonzero(modes == i))
    traces = longer.traces(mine, motion.duration)
    result[motion.name] = {
      verdict.metric: {
        'value': verdict.value,
        'worst': verdict.worst,
        'least': verdict.least if np.isfinite(verdict.least) else None,
        'most': verdict.most if np.isfinite(verdict.most) else None,
        'kept': verdict.kept,
      }
      for verdict in behaviour.judge(motion, traces)
    }
  return result


def evaluate_transitions(
  evaluator: Evaluator, episodes: int
) -> dict[str, dict[str, float]]:
  """All n x n transitions, at every switch phase and clip of Algorithm 1."""
  bank = evaluator.bank
  n = len(bank)
  cases = np.array(
    list(
      itertools.product(
        range(n),
        range(n),
        schedule_lib.CLIPS,
        schedule_lib.SWITCH_PHASES,
        range(episodes),
      )
    )
  )
  initial, final = cases[:, 0].astype(int), cases[:, 1].astype(int)
  found = evaluator.run(
    schedule_lib.transitions(bank, initial, final, cases[:, 2], cases[:, 3]),
    'transitions',
  )
  result = {}
  for i, f in itertools.product(range(n), range(n)):
    mine = found.rows(np.flatnonzero((initial == i) & (final == f)))
    result[f'{bank.names[i]}->{bank.names[f]}'] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
    }
  return result


def report(
  evaluator: Evaluator, episodes: int, clock_rate: float
) -> dict[str, Any]:
  """Returns the whole report as JSON-able values."""
  modes = evaluate_modes(evaluator, MODE_FACTOR * episodes, clock_rate)
  transitions = evaluate_transitions(evaluator, episodes)
  gather = lambda rows, key: np.array([row[key] for row in rows.values()])
  return {
    'mra_modes': evaluation.summary(gather(modes, 'mra')),
    'mra_transitions': evaluation.summary(gather(transitions, 'mra')),
    'survival_modes': float(gather(modes, 'survival').mean()),
    'survival_transitions': float(gather(transitions, 'survival').mean()),
    'modes': modes,
    'behaviour': evaluate_behaviour(evaluator, MODE_FACTOR * episodes),
    'transitions': transitions,
    'seed': evaluator.seed,
    'episodes_per_case': episodes,
    'clock_rate': clock_rate,
    'task': config_lib.to_dict(evaluator.config),
    'provenance': dict(evaluator.policy.provenance),
  }


def draw(evaluator: Evaluator, directory: pathlib.Path) -> None:
  """Draws the trunk's height in every mode, and through transitions."""
  bank, timestep = evaluator.bank, evaluator.config.control_timestep
  alone = evaluator.run(schedule_lib.single(np.arange(len(bank))), 'heights')
  drawn = figures.heights(bank.names, alone.traces, alone.lengths, timestep)
  figures.save(directory / figures.HEIGHTS_FILE, drawn)
  schedule, seconds = figures.sequence(bank)
  found = evaluator.lasting(seconds).run(schedule, 'sequence')
  drawn = figures.transitions(
    bank, schedule, found.traces, found.lengths[0], timestep
  )
  figures.save(directory / figures.SEQUENCE_FILE, drawn)


_COLUMNS = (
  'mra',
  'survival',
  'velocity',
  'lateral_velocity',
  'height',
  'apex',
  'rise',
  'flight',
  'alternation',
  'drift',
  'position_error',
)


def print_report(values: dict[str, Any]) -> None:
  """Prints the report as tables."""
  print(f'{"mode":16}' + ''.join(f'{name[:9]:>10}' for name in _COLUMNS))
  for name, row in values['modes'].items():
    print(f'{name:16}' + ''.join(f'{row[key]:10.3f}' for key in _COLUMNS))
  print(
    f'\n{"promise":32}{"value":>10}{"worst":>10}{"least":>10}{"most":>10}'
    f'{"kept":>6}'
  )
  for name, promises in values['behaviour'].items():
    for metric, row in promises.items():
      least, most = (
        '' if row[key] is None else f'{row[key]:.3f}'
        for key in ('least', 'most')
      )
      print(
        f'{f"{name}: {metric}":32}{row["value"]:10.3f}{row["worst"]:10.3f}'
        f'{least:>10}{most:>10}{"yes" if row["kept"] else "NO":>6}'
      )
  print(f'\n{"transition":36}{"mra":>10}{"survival":>10}')
  for name, row in values['transitions'].items():
    print(f'{name:36}{row["mra"]:10.3f}{row["survival"]:10.3f}')
  for kind in ('modes', 'transitions'):
    mra = values[f'mra_{kind}']
    print(
      f'MRA over {kind}: {mra["mean"]:.3f} +- {mra["std"]:.3f}, survival '
      f'{values[f"survival_{kind}"]:.3f}'
    )


def _checked_out(out: str | None) -> pathlib.Path | None:
  """Returns where to write; raises OSError now rather than at the end."""
  if not out:
    return None
  path = pathlib.Path(out)
  if path.is_dir():
    raise IsADirectoryError(f'--out={out} is a folder; name a file.')
  _check_writable(path.absolute().parent, f'--out={out}')
  return path


def _checked_figures(value: str | None) -> pathlib.Path | None:
  """Returns where to draw into; raises OSError now rather than at the end."""
  if not value:
    return None
  path = pathlib.Path(value)
  if path.exists() and not path.is_dir():
    raise NotADirectoryError(f'--figures={value} is a file; name a folder.')
  _check_writable(path.absolute(), f'--figures={value}')
  return path


def _check_writable(folder: pathlib.Path, flag: str) -> None:
  parent = next(p for p in (folder, *folder.parents) if p.exists())
  if not (parent.is_dir() and os.access(parent, os.W_OK)):
    raise NotADirectoryError(f'{flag}: cannot write into {parent}.')


def main(argv: Sequence[str]) -> None:
  """Evaluates and reports."""
  del argv
  if _EPISODES.value < 1:
    raise ValueError(f'--episodes must be positive, got {_EPISODES.value}.')
  out, folder = _checked_out(_OUT.value), _checked_figures(_FIGURES.value)
  policy = pretrained.load(_POLICY.value)
  config = config_lib.for_evaluation(policy.config)
  if _TIMESTEP.value is not None:
    config = config_flags.replace(config, physics_timestep=_TIMESTEP.value)
  evaluator = Evaluator(policy, config, _SEED.value)
  values = report(evaluator, _EPISODES.value, _CLOCK_RATE.value)
  print_report(values)
  if out:
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic.write(out, json.dumps(values, indent=1).encode())
    print(f'The report is in {out}')
  if folder:
    draw(evaluator, folder)
    print(f'The figures are in {folder}')


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
