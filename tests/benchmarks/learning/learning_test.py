"""Tests of benchmarks.learning and of the learners that it compares."""

import importlib
import importlib.util
import json
import pathlib
import sys
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch

from benchmarks.learning import learners
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.experiments import config as run_config
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.walkers import mini_biped
from tests.benchmarks import scripted
from tests.bin import processes

_LIBRARIES = {
  'rsl_rl': ('rsl_rl', 'benchmarks.learning.rsl_rl_learner'),
  'sb3': ('stable_baselines3', 'benchmarks.learning.sb3_learner'),
}
_SCALE = 0.5  # Of the rewards.
_ENDS = [
  [scripted.ON, scripted.ON, scripted.ON],
  [scripted.TERMINATED, scripted.TRUNCATED, scripted.ON],
]
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


# Adapters.


def test_rsl_rl_environment() -> None:
  worlds = scripted.Scripted(_ENDS)
  env = _library('rsl_rl').VecEnv(worlds, _SCALE)
  assert (env.num_envs, env.num_actions, env.max_episode_length) == (3, 2, 7)
  first = env.get_observations()
  assert list(first.keys()) == ['policy'] and first.batch_size == (3,)
  np.testing.assert_array_equal(
    first['policy'], [[1, 0, 0], [1, 0, 1], [1, 0, 2]]
  )

  actions = torch.tensor([[0.0, 0.0], [0.1, 0.2], [-9.0, 9.0]])
  seen, rewards, dones, extras = env.step(actions)
  np.testing.assert_array_equal(worlds.actions, actions)
  assert rewards.dtype == torch.float32
  np.testing.assert_allclose(rewards, [0.5, 1.0, 1.5])
  assert not dones.any() and not extras['time_outs'].any()
  np.testing.assert_array_equal(env.episode_length_buf, [1, 1, 1])
  np.testing.assert_array_equal(seen['policy'][:, 1], [1, 1, 1])

  # Both ends are ends, but only that of world 1 is a matter of time; what is
  # seen then is the next episode's.
  seen, _, dones, extras = env.step(actions)
  np.testing.assert_array_equal(dones, [1, 1, 0])
  np.testing.assert_array_equal(extras['time_outs'], [False, True, False])
  np.testing.assert_array_equal(
    seen['policy'], [[2, 0, 0], [2, 0, 1], [1, 2, 2]]
  )
  np.testing.assert_array_equal(
    seen['policy'], env.get_observations()['policy']
  )
  np.testing.assert_array_equal(env.episode_length_buf, [0, 0, 2])


def test_stable_baselines3_environment() -> None:
  worlds = scripted.Scripted(_ENDS)
  env = _library('sb3').VecEnv(worlds, _SCALE)
  assert env.num_envs == 3 and env.observation_space.shape == (3,)
  np.testing.assert_array_equal(env.action_space.low, [-1, -2])
  np.testing.assert_array_equal(env.action_space.high, [1, 2])
  np.testing.assert_array_equal(env.reset(), [[1, 0, 0], [1, 0, 1], [1, 0, 2]])

  actions = np.array([[0.0, 0.0], [0.1, 0.2], [-1.0, 1.0]], dtype=np.float32)
  seen, rewards, dones, infos = env.step(actions)
  np.testing.assert_array_equal(worlds.actions, actions)
  assert rewards.dtype == np.float32
  np.testing.assert_allclose(rewards, [0.5, 1.0, 1.5])
  assert not dones.any() and infos == [{}, {}, {}]

  seen, _, dones, infos = env.step(actions)
  np.testing.assert_array_equal(dones, [True, True, False])
  np.testing.assert_array_equal(seen, [[2, 0, 0], [2, 0, 1], [1, 2, 2]])
  for world, truncated in ((0, False), (1, True)):
    assert infos[world]['TimeLimit.truncated'] is truncated
    np.testing.assert_array_equal(
      infos[world]['terminal_observation'], [1, 2, world]
    )
  assert infos[2] == {}


def test_privileged_information_is_a_group_of_its_own_or_left_out() -> None:
  worlds = scripted.Scripted(_ENDS, privileged=True)
  seen = _library('rsl_rl').VecEnv(worlds, 1.0).get_observations()
  assert (seen['policy'].shape, seen['privileged'].shape) == ((3, 3), (3, 2))
  assert (seen['privileged'] >= 100).all()
  env = _library('sb3').VecEnv(worlds, 1.0)
  assert env.observation_space.shape == env.reset()[0].shape == (3,)
  env.step(np.zeros((3, 2)))
  _, _, _, infos = env.step(np.zeros((3, 2)))
  assert infos[1]['terminal_observation'].shape == (3,)


# What the libraries make of it.


def _network(worlds: scripted.Scripted) -> networks.ActorCritic:
  torch.manual_seed(0)  # A value next to zero would prove nothing.
  return networks.ActorCritic(
    scripted.SIZE,
    worlds.action_spec().shape[0],
    _PPO.hidden_sizes,
    privileged_size=worlds.privileged_size,
  )


def test_rsl_rl_bootstraps_time_limits_alone() -> None:
  worlds = scripted.Scripted(_ENDS, privileged=True)
  learner = _library('rsl_rl').Learner(
    worlds, _network(worlds), _PPO, 0, _SCALE
  )
  learner.iterate()
  storage = learner.runner.alg.storage
  critic, actor = learner.runner.alg.critic, learner.runner.alg.actor
  assert (actor.obs_dim, critic.obs_dim) == (3, 5)
  paid = _SCALE * torch.tensor([1.0, 2.0, 3.0])
  torch.testing.assert_close(storage.rewards[0, :, 0], paid)
  added = storage.rewards[1, :, 0] - paid
  values = storage.values[1, :, 0]  # Of the state before: the library's way.
  expected = torch.stack([paid[0] * 0, 0.9 * values[1], paid[0] * 0])
  torch.testing.assert_close(added, expected)
  assert abs(float(added[1])) > 1e-3
  np.testing.assert_array_equal(storage.dones[1, :, 0], [1, 1, 0])


def test_stable_baselines3_bootstraps_time_limits_alone() -> None:
  worlds = scripted.Scripted(_ENDS)
  learner = _library('sb3').Learner(worlds, _network(worlds), _PPO, 0, _SCALE)
  asked, predict = [], learner.model.policy.predict_values

  def watch(observation: torch.Tensor) -> torch.Tensor:
    value = predict(observation)
    asked.append((observation.numpy(), value.detach().numpy()))
    return value

  learner.model.policy.predict_values = watch
  kept = {}
  buffer = learner.model.rollout_buffer
  compute = buffer.compute_returns_and_advantage

  def keep(*args: Any, **kwargs: Any) -> None:
    kept['rewards'] = buffer.rewards.copy()
    compute(*args, **kwargs)

  buffer.compute_returns_and_advantage = keep
  learner.iterate()
  (ended, value), _ = asked  # The other one is of what the rollout led to.
  end = np.array([[1, 2, 1]], dtype=np.float32)  # Normalised like all others.
  normaliser = learner.model.get_vec_normalize_env()
  np.testing.assert_allclose(ended, normaliser.normalize_obs(end))
  paid = _SCALE * np.array([1.0, 2.0, 3.0])
  np.testing.assert_allclose(kept['rewards'][0], paid)
  np.testing.assert_allclose(
    kept['rewards'][1] - paid, [0, 0.9 * value.item(), 0], rtol=1e-4, atol=1e-6
  )
  assert not normaliser.norm_reward


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


@pytest.mark.parametrize('name', _LIBRARIES)
def test_without_a_library_one_line_says_what_to_install(name: str) -> None:
  package, module = _LIBRARIES[name]
  pytest.importorskip('gymnasium')
  with mock.patch.dict(sys.modules, {package: None}):
    sys.modules.pop(module, None)
    with pytest.raises(ModuleNotFoundError) as caught:
      importlib.import_module(module)
  assert str(caught.value) == (
    f'{package} is not installed: pip install dmc_multimode[bench]'
  )


def test_unknown_learner() -> None:
  with pytest.raises(ValueError, match='ours, rsl_rl, sb3'):
    learners.make('cleanrl', _config())


def test_timing_leaves_no_trace() -> None:
  class Sleeper:
    def sleep(self, fail: bool = False) -> str:
      if fail:
        raise ValueError
      return 'slept'

  sleep = Sleeper.sleep
  with learners.timing(((Sleeper, 'sleep'),)) as spent:
    assert Sleeper().sleep() == 'slept'
    with pytest.raises(ValueError):
      Sleeper().sleep(fail=True)
  assert len(spent) == 2
  assert Sleeper.sleep is sleep


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
    '--eval_steps=20,40',
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
  assert rows == [(steps, name) for steps in (24, 40) for name in names]
  for row in report['learning']:
    assert 0 < row['mra_modes'] <= 1 and 0 < row['mra_transitions'] <= 1
    assert list(row['modes']) == ['idle']
    assert list(row['transitions']) == ['idle->idle']
    assert row['steps_per_second'] == pytest.approx(
      row['steps'] / row['seconds']
    )
    assert f'{row["mra_modes"]:.3f}' in done.stdout


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--learners=ours,cleanrl'], 'cleanrl'),
    (['--learners='], '--learners'),
    (['--steps=100', '--eval_steps=200'], '--eval_steps'),
    (['--eval_steps=many'], '--eval_steps'),
    (['--out={tmp}/absent/learning.json'], 'absent'),
  ],
  ids=lambda value: value if isinstance(value, str) else ' '.join(value),
)
def test_bad_input(
  benchmark: processes.Binary,
  tmp_path: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  done = benchmark(*_TINY, *(flag.format(tmp=tmp_path) for flag in flags))
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not list(tmp_path.iterdir())
