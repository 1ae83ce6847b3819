"""Evaluates a policy: every mode, every transition, no exploration.

python -m dmc_multimode.bin.evaluate --policy=quickstart --out=report.json

Under `torchrun` in place of `python`, several processes share the episodes.
"""

import json
import math
import pathlib
from typing import Any, Sequence

from absl import flags
import numpy as np

from dmc_multimode import atomic
from dmc_multimode import pretrained
from dmc_multimode.agents import distributed
from dmc_multimode.bin import app
from dmc_multimode.bin import config_flags
from dmc_multimode.bin import figures
from dmc_multimode.bin import outputs
from dmc_multimode.bin import ranks
from dmc_multimode.bin import scoring
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import config as config_lib

_POLICY = flags.DEFINE_string(
  'policy', None, 'Name of a shipped policy, or a folder.', required=True
)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write the report to.')
_FIGURES = flags.DEFINE_string(
  'figures',
  None,
  'Folder to draw into: heights, contacts, a sequence of modes.',
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.')
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Of each transition at each phase and clip; modes get 4 times.'
)
_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, 'Seconds; that of the training by default.'
)
_CLOCK_RATES = flags.DEFINE_list(
  'clock_rates', None, 'Also measure how fast the modes go at these.'
)
_CLOCK_RATE = flags.DEFINE_float('clock_rate', 1.0, 'Of the modes.')


def draw(
  evaluator: scoring.Evaluator,
  values: dict[str, Any],
  directory: pathlib.Path,
) -> None:
  """Draws every mode, a sequence of them, and what `values` has of speeds."""
  bank, timestep = evaluator.bank, evaluator.config.control_timestep
  alone = evaluator.run(schedule_lib.single(np.arange(len(bank))), 'heights')
  for name, function in (
    (figures.HEIGHTS_FILE, figures.heights),
    (figures.CONTACTS_FILE, figures.contacts),
  ):
    drawn = function(bank.names, alone.traces, alone.lengths, timestep)
    figures.save(directory / name, drawn)
  if 'clock_rates' in values:
    drawn = figures.clock_rates(values['clock_rates'])
    figures.save(directory / figures.CLOCK_RATES_FILE, drawn)
  schedule, seconds = figures.sequence(bank)
  found = evaluator.changed(time_limit=seconds).run(schedule, 'sequence')
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
  'single_support',
  'agreement',
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
  for rate, row in values.get('clock_rates', {}).items():
    speeds = ', '.join(
      f'{name} {found["velocity"]:.2f} m/s ({found["survival"]:.2f})'
      for name, found in row.items()
    )
    print(f'clock rate {rate}: {speeds}')
  for kind in ('modes', 'transitions'):
    mra = values[f'mra_{kind}']
    print(
      f'MRA over {kind}: {mra["mean"]:.3f} +- {mra["std"]:.3f}, survival '
      f'{values[f"survival_{kind}"]:.3f}'
    )


def _rates() -> list[float]:
  """Returns --clock_rates; raises ValueError if they are none."""
  try:
    rates = [float(rate) for rate in _CLOCK_RATES.value or ()]
  except ValueError as error:
    raise ValueError(f'--clock_rates: {error}.') from error
  if not all(0 < rate < math.inf for rate in rates):
    raise ValueError('--clock_rates must be positive and finite.')
  return rates


def _evaluate(communicator: distributed.Communicator) -> None:
  """Evaluates; rank 0 reports."""
  if _EPISODES.value < 1:
    raise ValueError(f'--episodes must be positive, got {_EPISODES.value}.')
  rates = _rates()
  out = outputs.file('out', _OUT.value)
  folder = outputs.folder('figures', _FIGURES.value)
  policy = pretrained.load(_POLICY.value)
  config = config_lib.for_evaluation(policy.config)
  if _TIMESTEP.value is not None:
    config = config_flags.replace(config, physics_timestep=_TIMESTEP.value)
  evaluator = scoring.Evaluator(
    policy, config, _SEED.value, communicator=communicator
  )
  values = scoring.report(evaluator, _EPISODES.value, _CLOCK_RATE.value)
  if rates:
    values['clock_rates'] = scoring.evaluate_clock_rates(
      evaluator, scoring.MODE_FACTOR * _EPISODES.value, rates
    )
  values['provenance'] = dict(policy.provenance)
  if communicator.rank == 0:
    _report(values, out, folder, scoring.Evaluator(policy, config, _SEED.value))


def _report(
  values: dict[str, Any],
  out: pathlib.Path | None,
  folder: pathlib.Path | None,
  evaluator: scoring.Evaluator,
) -> None:
  """Prints, writes and draws what there is to be told."""
  print_report(values)
  if out:
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic.write(out, json.dumps(values, indent=1).encode())
    print(f'The report is in {out}')
  if folder:
    draw(evaluator, values, folder)
    print(f'The figures are in {folder}')


def main(argv: Sequence[str]) -> int:
  """Evaluates and reports, with the other ranks if there are any."""
  del argv
  return ranks.run(_evaluate)


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
