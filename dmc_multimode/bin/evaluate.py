"""Evaluates a policy: every mode, every transition, no exploration.

python -m dmc_multimode.bin.evaluate --policy=quickstart --out=report.json
"""

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
from dmc_multimode.modes import reference
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import batched
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes as episodes_lib
from dmc_multimode.suite import multimode_biped

_POLICY = flags.DEFINE_string(
  'policy', None, 'Name of a shipped policy, or a folder.', required=True
)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write the report to.')
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.')
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Of each transition at each phase and clip; modes get 4 times.'
)
_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, 'Seconds; that of the training by default.'
)
_CLOCK_RATE = flags.DEFINE_float('clock_rate', 1.0, 'Of the modes.')
_MODE_FACTOR = 4


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
    durations = np.full(episodes, bank.durations[i] / clock_rate)
    result[name] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
      **evaluation.body_metrics(
        mine, durations, evaluator.config.control_timestep
      ),
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
  modes = evaluate_modes(evaluator, _MODE_FACTOR * episodes, clock_rate)
  transitions = evaluate_transitions(evaluator, episodes)
  gather = lambda rows, key: np.array([row[key] for row in rows.values()])
  return {
    'mra_modes': evaluation.summary(gather(modes, 'mra')),
    'mra_transitions': evaluation.summary(gather(transitions, 'mra')),
    'survival_modes': float(gather(modes, 'survival').mean()),
    'survival_transitions': float(gather(transitions, 'survival').mean()),
    'modes': modes,
    'transitions': transitions,
    'seed': evaluator.seed,
    'episodes_per_case': episodes,
    'clock_rate': clock_rate,
    'task': config_lib.to_dict(evaluator.config),
    'provenance': dict(evaluator.policy.provenance),
  }


_COLUMNS = (
  'mra',
  'survival',
  'velocity',
  'lateral_velocity',
  'height',
  'apex',
  'rise',
  'flight',
  'single_support',
  'drift',
  'position_error',
)


def print_report(values: dict[str, Any]) -> None:
  """Prints the report as tables."""
  print(f'{"mode":16}' + ''.join(f'{name[:9]:>10}' for name in _COLUMNS))
  for name, row in values['modes'].items():
    print(f'{name:16}' + ''.join(f'{row[key]:10.3f}' for key in _COLUMNS))
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
  parent = next(p for p in path.absolute().parents if p.exists())
  if not (parent.is_dir() and os.access(parent, os.W_OK)):
    raise NotADirectoryError(f'--out={out}: cannot write into {parent}.')
  return path


def main(argv: Sequence[str]) -> None:
  """Evaluates and reports."""
  del argv
  if _EPISODES.value < 1:
    raise ValueError(f'--episodes must be positive, got {_EPISODES.value}.')
  out = _checked_out(_OUT.value)
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


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
