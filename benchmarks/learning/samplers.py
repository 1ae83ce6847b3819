"""Samplers of modes and transitions, compared after equal numbers of steps.

    python -m benchmarks.learning.samplers --flagfile=flags/pi_all.flags \
      --steps=15000000 --run_dir=runs/samplers --out=samplers.json

Trains a policy with each of --samplers from each of --seeds, all else equal,
and evaluates it deterministically. Runs are in --run_dir; called again, the
benchmark resumes the one that was interrupted and evaluates those that are
done. Each figure is the mean over the seeds, with the lowest and the highest.
"""

import functools
import pathlib
from typing import Any, Mapping, Sequence

from absl import flags
import numpy as np

from benchmarks import common
from dmc_multimode import evaluation
from dmc_multimode import experiments
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.suite.imitation import mode_sampler
from dmc_multimode.utils import files

_ALGORITHM_1 = {'sampling_kind': mode_sampler.ADAPTIVE}
SAMPLERS: Mapping[str, Mapping[str, Any]] = {
  'uniform': {'sampling_kind': mode_sampler.UNIFORM},
  'algorithm_1': {
    **_ALGORITHM_1,
    'sampling_gamma_initial': 0.8,
    'sampling_gamma_final': 0.8,
    'sampling_epsilon': 0.2,
  },
  'longer_memory': {
    **_ALGORITHM_1,
    'sampling_gamma_initial': 0.95,
    'sampling_gamma_final': 0.95,
    'sampling_epsilon': 0.05,
  },
  'failures': {'sampling_kind': mode_sampler.FAILURES},
}

_SAMPLERS = flags.DEFINE_list('samplers', [*SAMPLERS], 'Which.')
_SEEDS = flags.DEFINE_list('seeds', ['0', '1', '2'], 'Of the trainings.')
_STEPS = flags.DEFINE_integer('steps', 15_000_000, 'Of each training.', 1)
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Of each transition at each phase and clip.', 1
)
_RUN_DIR = config_flags.define_path(
  'run_dir', None, 'Folder of the runs.', required=True
)
_OUT = common.define_out()
common.define_run_flags()

_POOR = 0.9  # Survival below which a transition counts as poor.
_COLUMNS = (
  '=sampler | seed | MRA modes=mra_modes:.3f | '
  'transitions=mra_transitions:.3f | worst=worst_transition:.3f | '
  'survival=survival_transitions:.3f | poor=poor_transitions:.3f'
)

Row = common.Row


def settings(config: run_config.RunConfig, sampler: str) -> dict[str, Any]:
  """Returns the settings of a run by the names of flags.

  Args:
    config: of all runs.
    sampler: name of the sampler, whose settings replace the configuration's.
  """
  changed = run_config.differences(config, run_config.RunConfig())
  found = {name: value for name, value, _ in changed}
  for name in ('modes', 'seed'):
    found.pop(name, None)
  return {**found, **SAMPLERS[sampler]}


def scores(report: Mapping[str, Any]) -> Row:
  """Returns the figures of a report of `evaluation.evaluate`.

  `worst_transition` is the lowest MRA of a transition, `poor_transitions` the
  share of the transitions whose survival is below 0.9.
  """
  rows = report['transitions'].values()
  return {
    'mra_modes': report['mra_modes']['mean'],
    'mra_transitions': report['mra_transitions']['mean'],
    'worst_transition': min(row['mra'] for row in rows),
    'survival_transitions': report['survival_transitions'],
    'poor_transitions': float(
      np.mean([row['survival'] < _POOR for row in rows])
    ),
  }


def summary(rows: Sequence[Row]) -> Row:
  """Returns mean, lowest and highest over the seeds of one sampler."""
  figures = [name for name in rows[0] if name not in ('sampler', 'seed')]
  values = {name: [row[name] for row in rows] for name in figures}
  return {
    'sampler': rows[0]['sampler'],
    'seeds': [row['seed'] for row in rows],
    'mean': {name: float(np.mean(values[name])) for name in figures},
    'lowest': {name: min(values[name]) for name in figures},
    'highest': {name: max(values[name]) for name in figures},
  }


def _run(config: run_config.RunConfig, sampler: str, seed: int) -> Row:
  """Trains, or goes on training, and evaluates."""
  folder = pathlib.Path(_RUN_DIR.value) / f'{sampler}_{seed}'
  policy = experiments.train(
    folder,
    config.modes,
    _STEPS.value,
    resume=experiments.RunFolder(folder).holds_run(),
    seed=seed,
    **settings(config, sampler),
  )
  report = evaluation.evaluate(
    policy, episodes=_EPISODES.value, with_motion=False
  )
  return {'sampler': sampler, 'seed': seed, **scores(report)}


def _seeds() -> list[int]:
  """Returns --seeds; raises ValueError in one line if one is none."""
  if not _SEEDS.value or not all(text.isdecimal() for text in _SEEDS.value):
    raise ValueError(
      f'--seeds are whole numbers with commas, got {",".join(_SEEDS.value)!r}.'
    )
  return [*dict.fromkeys(map(int, _SEEDS.value))]


def main(argv: Sequence[str]) -> None:
  """Trains, evaluates, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  unknown = [name for name in _SAMPLERS.value if name not in SAMPLERS]
  if unknown or not _SAMPLERS.value:
    raise ValueError(
      f'--samplers must be some of {", ".join(SAMPLERS)}, got '
      f'{",".join(_SAMPLERS.value) or "none"}.'
    )
  if flags.FLAGS['seed'].present:
    raise ValueError('Name the seeds of the trainings by --seeds.')
  seeds, config = _seeds(), common.configured()
  names = [*dict.fromkeys(_SAMPLERS.value)]
  rows: list[Row] = []
  for seed in seeds:
    for sampler in names:
      rows.append(_run(config, sampler, seed))
      common.show(_COLUMNS, rows[-1])
  table = [
    summary([row for row in rows if row['sampler'] == sampler])
    for sampler in names
  ]
  common.print_table(
    _COLUMNS,
    [
      {'sampler': row['sampler'], 'seed': name, **row[name]}
      for row in table
      for name in ('mean', 'lowest', 'highest')
    ],
  )
  common.write_report(
    out,
    {
      'benchmark': 'samplers',
      'table': table,
      'runs': rows,
      'steps': _STEPS.value,
      'episodes': _EPISODES.value,
      'config': run_config.to_dict(config),
    },
  )


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
