"""Tests of benchmarks.learning and of the learners that it compares."""

import importlib
import importlib.util
import json
import pathlib
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.learning import learners
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.experiments import config as run_config
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.walkers import mini_biped
from tests.bin import processes

_LIBRARIES = {
  'rsl_rl': ('rsl_rl', 'benchmarks.learning.rsl_rl_learner'),
  'sb3': ('stable_baselines3', 'benchmarks.learning.sb3_learner'),
}
_PPO = ppo_config.PPOConfig(
  hidden_sizes=(8, 4),
  rollout_length=2,
  epochs=2,
  minibatches=2,
  discount=0.9,
  privileged_critic=False,
)


def _library(name: str) -> Any:
  """The module that adapts a library, if that is installed."""
  package, module = _LIBRARIES[name]
  pytest.importorskip(package, reason=f'{package} is not installed: `bench`.')
  return importlib.import_module(module)


def _skip_if_missing(name: str) -> None:
  if name != 'ours':
    _library(name.removesuffix('_gru'))


# Learners.


def _config(**changes: Any) -> run_config.RunConfig:
  return run_config.RunConfig(
    modes='idle',
    num_worlds=4,
    threads=1,
    ppo=_PPO,
    task=task_config.ImitationConfig(time_limit=0.09),
    **changes,
  )


def _weights(learner: Any) -> list[torch.Tensor]:
  """Trainable parameters of any of the learners."""
  if isinstance(learner, learners.Ours):
    return list(learner.network.parameters())
  if hasattr(learner, 'model'):
    return list(learner.model.policy.parameters())
  alg = learner.runner.alg
  return [*alg.actor.parameters(), *alg.critic.parameters()]


def _first_action(learner: learners.Learner, seen: np.ndarray) -> np.ndarray:
  learner.begin_episodes()
  return learner.select_action(seen)


@pytest.mark.parametrize('name', learners.NAMES)
def test_learns(name: str) -> None:
  _skip_if_missing(name)
  learner = learners.make(name, _config())
  seen = np.zeros((5, learner.environment.observation_spec().shape[0]))
  seen = seen.astype(np.float32)
  before = [weight.detach().clone() for weight in _weights(learner)]
  first = _first_action(learner, seen)
  assert first.shape == (5, 10)
  if name in learners.ALIKE:
    standing = mini_biped.standing_action(learner.environment.physics.model)
    np.testing.assert_allclose(first[0], standing, atol=1e-6)
  with learners.timing(learner.update) as spent:
    learner.iterate()
    learner.iterate()
  assert len(spent) == 2 * len(learner.update) and min(spent) > 0
  for old, new in zip(before, _weights(learner), strict=True):
    assert torch.isfinite(new).all() and not torch.equal(old, new)
  last = _first_action(learner, seen)
  remembers = not np.array_equal(last, learner.select_action(seen))
  assert remembers == (name not in learners.ALIKE)
  np.testing.assert_array_equal(last, _first_action(learner, seen))
  assert not np.array_equal(first, last)


@pytest.mark.parametrize('name', learners.NAMES)
def test_equal_seeds_learn_the_same(name: str) -> None:
  _skip_if_missing(name)

  def learned(seed: int) -> torch.Tensor:
    learner = learners.make(name, _config(seed=seed))
    learner.iterate()
    return torch.cat([weight.flatten() for weight in _weights(learner)])

  assert torch.equal(learned(3), learned(3))
  assert not torch.equal(learned(3), learned(4))


def test_all_have_networks_and_hyperparameters_alike() -> None:
  for name in _LIBRARIES:
    _library(name)
  all_three = {name: learners.make(name, _config()) for name in learners.ALIKE}
  shapes = [
    sorted(tuple(weight.shape) for weight in _weights(learner))
    for learner in all_three.values()
  ]
  assert shapes[0] == shapes[1] == shapes[2]
  seen = all_three['ours'].environment.reset()
  expected = all_three['ours'].select_action(seen)
  assert expected.std(axis=0).min() > 1e-5
  for learner in all_three.values():  # Their normalisers differ a little.
    np.testing.assert_allclose(learner.select_action(seen), expected, atol=1e-3)
  theirs = all_three['rsl_rl'].runner.alg  # type: ignore[attr-defined]
  length = theirs.storage.num_transitions_per_env
  model = all_three['sb3'].model  # type: ignore[attr-defined]
  for value, *others in (
    (_PPO.discount, theirs.gamma, model.gamma),
    (_PPO.gae_lambda, theirs.lam, model.gae_lambda),
    (_PPO.clip, theirs.clip_param, model.clip_range(1.0)),
    (_PPO.epochs, theirs.num_learning_epochs, model.n_epochs),
    (_PPO.minibatches, theirs.num_mini_batches, 8 // model.batch_size),
    (_PPO.rollout_length, length, model.n_steps),
    (_PPO.entropy_coefficient, theirs.entropy_coef, model.ent_coef),
    (learners.VALUE_COEFFICIENT, theirs.value_loss_coef, model.vf_coef),
    (_PPO.max_gradient_norm, theirs.max_grad_norm, model.max_grad_norm),
    (_PPO.learning_rate, theirs.learning_rate, model.learning_rate),
  ):
    assert others == [value, value]
  assert (theirs.schedule, theirs.desired_kl) == ('adaptive', _PPO.target_kl)
  for std in (
    theirs.actor.distribution.log_std_param.exp(),
    model.policy.log_std.exp(),
  ):
    np.testing.assert_allclose(std.detach(), _PPO.initial_std, rtol=1e-6)


# The benchmark, in processes of its own: flags are global.

_TINY = (
  '--modes=idle',
  '--num_worlds=4',
  '--threads=1',
  '--ppo_rollout_length=2',
  '--ppo_minibatches=2',
  '--ppo_hidden_sizes=8',
  '--task_time_limit=0.09',
)


def test_report(benchmark: processes.Binary, tmp_path: pathlib.Path) -> None:
  names = ['ours']
  for name, (package, _) in _LIBRARIES.items():
    names += [name] if importlib.util.find_spec(package) else []
  out = tmp_path / 'learning.json'
  done = benchmark(
    *_TINY,
    f'--learners={",".join(names)}',
    '--steps=40',
    '--eval_steps=0,20,40',
    '--rounds=2',
    f'--out={out}',
  )
  assert done.code == 0, done.stderr
  assert 'Traceback' not in done.stderr
  report = json.loads(out.read_text())
  assert report['config']['ppo']['symmetry'] == 'none'
  assert not report['config']['ppo']['privileged_critic']
  assert report['config']['ppo']['target_kl'] == 0.03  # The quick start's.
  assert [row['name'] for row in report['speed']] == names
  assert report['speed'][0]['update_ratio'] == 1
  for row in report['speed']:
    numbers = [value for value in row.values() if isinstance(value, float)]
    assert len(numbers) > 5 and min(numbers) > 0
    low, high = row['update_ratio_range']
    assert low <= row['update_ratio'] <= high
  # Evaluations follow the end of an iteration, here of 8 steps.
  rows = [(row['steps'], row['name']) for row in report['learning']]
  assert rows == [(steps, name) for steps in (0, 24, 40) for name in names]
  for row in report['learning']:
    assert 0 < row['mra_modes'] <= 1 and 0 < row['mra_transitions'] <= 1
    assert list(row['modes']) == ['idle']
    assert list(row['transitions']) == ['idle->idle']
    assert row['steps_per_second'] * row['seconds'] == pytest.approx(
      row['steps']
    )
    first = report['learning'][names.index(row['name'])]
    assert row['gain'] == pytest.approx(row['mra_modes'] / first['mra_modes'])
    assert f'{row["mra_modes"]:.3f}' in done.stdout


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--learners=ours,cleanrl'], 'cleanrl'),
    (['--steps=100', '--eval_steps=200'], '--eval_steps'),
  ],
)
def test_bad_input(
  benchmark: processes.Binary, flags: list[str], message: str
) -> None:
  done = benchmark(*_TINY, *flags)
  assert done.code == 2, done.stderr
  assert message in done.error
