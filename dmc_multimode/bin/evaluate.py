"""Evaluates a policy: every mode, every transition, no exploration.

python -m dmc_multimode.bin.evaluate --policy=quickstart --out=report.json
"""

import json
import pathlib
from typing import Any, Sequence

from absl import flags
import numpy as np

from dmc_multimode import atomic
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.bin import config_flags
from dmc_multimode.bin import figures
from dmc_multimode.bin import outputs
from dmc_multimode.bin import scoring
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import config as config_lib

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


def draw(evaluator: scoring.Evaluator, directory: pathlib.Path) -> None:
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


def main(argv: Sequence[str]) -> None:
  """Evaluates and reports."""
  del argv
  if _EPISODES.value < 1:
    raise ValueError(f'--episodes must be positive, got {_EPISODES.value}.')
  out = outputs.file('out', _OUT.value)
  folder = outputs.folder('figures', _FIGURES.value)
  policy = pretrained.load(_POLICY.value)
  config = config_lib.for_evaluation(policy.config)
  if _TIMESTEP.value is not None:
    config = config_flags.replace(config, physics_timestep=_TIMESTEP.value)
  evaluator = scoring.Evaluator(policy, config, _SEED.value)
  values = scoring.report(evaluator, _EPISODES.value, _CLOCK_RATE.value)
  values['provenance'] = dict(policy.provenance)
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
