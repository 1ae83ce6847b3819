"""Tests of benchmarks.learning.samplers."""

import json
import pathlib
from typing import Any

import pytest

from dmc_multimode.experiments import config as run_config
from tests.benchmarks import modules
from tests.bin import processes

samplers = modules.load('learning.samplers')

_TINY = (
  '--modes=idle',
  '--num_worlds=4',
  '--threads=1',
  '--ppo_rollout_length=2',
  '--ppo_minibatches=1',
  '--task_time_limit=0.09',
  '--steps=16',
  '--episodes=1',
)


def _row(seed: int, worst: float) -> dict[str, Any]:
  return {'sampler': 'uniform', 'seed': seed, 'worst_transition': worst}


def test_scores_and_their_spread() -> None:
  report = {
    'mra_modes': {'mean': 0.9},
    'mra_transitions': {'mean': 0.7},
    'survival_transitions': 0.85,
    'transitions': {
      'a->a': {'mra': 0.8, 'survival': 0.9},
      'a->b': {'mra': 0.6, 'survival': 0.8},
    },
  }
  assert samplers.scores(report) == {
    'mra_modes': 0.9,
    'mra_transitions': 0.7,
    'worst_transition': 0.6,
    'survival_transitions': 0.85,
    'poor_transitions': 0.5,
  }
  found = samplers.summary([_row(0, 0.5), _row(2, 0.75)])
  assert found['seeds'] == [0, 2]
  assert found['mean'] == {'worst_transition': 0.625}
  assert found['lowest'] == {'worst_transition': 0.5}
  assert found['highest'] == {'worst_transition': 0.75}


@pytest.mark.parametrize('name', samplers.SAMPLERS)
def test_samplers_replace_the_recipes(name: str) -> None:
  recipe = run_config.overridden(
    run_config.RunConfig(),
    {
      'seed': 5,
      'ppo_discount': 0.9,
      'sampling_kind': 'uniform',
      'sampling_gamma_final': 0.5,
    },
  )
  made = run_config.overridden(
    run_config.RunConfig(), samplers.settings(recipe, name)
  )
  assert made.seed == 0 and made.ppo.discount == 0.9
  for setting, value in samplers.SAMPLERS[name].items():
    assert getattr(made.sampling, setting.removeprefix('sampling_')) == value


def test_a_comparison_that_goes_on(
  benchmark: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """Called again it trains what is missing."""
  flags = (*_TINY, f'--run_dir={tmp_path}/runs', f'--out={tmp_path}/out.json')
  assert benchmark(*flags, '--samplers=uniform', '--seeds=0').code == 0
  done = benchmark(*flags, '--samplers=uniform,failures', '--seeds=0')
  assert done.code == 0, done.stderr
  report = json.loads((tmp_path / 'out.json').read_text())
  assert [row['sampler'] for row in report['table']] == ['uniform', 'failures']
  for row in report['runs']:
    assert 0 < row['mra_modes'] <= 1
    run = tmp_path / 'runs' / f'{row["sampler"]}_{row["seed"]}'
    config = json.loads((run / 'config.json').read_text())
    assert config['run']['sampling']['kind'] == row['sampler']


@pytest.mark.parametrize(
  ('flag', 'message'),
  [('--samplers=greedy', 'greedy'), ('--seeds=one', 'one')],
)
def test_bad_input(
  benchmark: processes.Binary, tmp_path: pathlib.Path, flag: str, message: str
) -> None:
  done = benchmark(f'--run_dir={tmp_path}/runs', flag)
  assert done.code == 2
  assert message in done.error
  assert not (tmp_path / 'runs').exists()
