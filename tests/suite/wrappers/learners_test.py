"""The worlds behind the interfaces of rsl_rl and of Stable-Baselines3."""

import importlib
import sys
from typing import Any
from unittest import mock

import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config

_SIZE, _PRIVILEGED = 37, 13  # Numbers in an observation, and besides.
_SCALE = 0.5  # Of the rewards.
_HORIZON = 3  # Control steps.
_PACKAGES = {
  'rsl_rl_env': ('rsl_rl', 'rsl_rl'),
  'stable_baselines3_env': ('stable_baselines3', 'sb3'),
}


def _wrapper(name: str) -> Any:
  """The module, if its library is installed."""
  package, extra = _PACKAGES[name]
  pytest.importorskip(package, reason=f'No {package}: the extra `{extra}`.')
  return importlib.import_module(f'dmc_multimode.suite.wrappers.{name}')


def _worlds(**kwargs: Any) -> batched_env.BatchedImitation:
  """Three worlds that stand for three control steps."""
  task = multimode_biped.make_task(
    library.mode_set('idle'),
    config=task_config.ImitationConfig(time_limit=_HORIZON * 0.03),
  )
  return batched_env.BatchedImitation(task, 3, seed=0, num_threads=1, **kwargs)


def _twin(**kwargs: Any) -> tuple[np.ndarray, batched_env.BatchedImitation]:
  """The same worlds by themselves, begun, which run on beyond their ends."""
  twin = _worlds(auto_reset=False, **kwargs)
  return twin.reset(), twin


def _lost(*environments: batched_env.BatchedImitation) -> None:
  """Puts the robot of world 0 a metre off its reference."""
  for environment in environments:
    environment.qpos[0, 0] += 1.0


def _standing(environment: batched_env.BatchedImitation) -> np.ndarray:
  return np.tile(environment.standing_action(), (3, 1)).astype(np.float32)


@pytest.mark.parametrize('privileged', [False, True])
def test_rsl_rl_sees_what_the_worlds_see(privileged: bool) -> None:
  module, worlds = _wrapper('rsl_rl_env'), _worlds(privileged=privileged)
  first, twin = _twin(privileged=privileged)
  env = module.RslRlVecEnv(worlds, _SCALE)
  assert (env.num_envs, env.num_actions) == (3, 10)
  assert env.max_episode_length == _HORIZON
  torch = importlib.import_module('torch')
  actions = torch.from_numpy(_standing(worlds))

  seen = env.get_observations()
  step = twin.step(actions.numpy())
  after, rewards, dones, extras = env.step(actions)
  for group, expected in ((seen, first), (after, step.observation)):
    assert group.batch_size == (3,) and group['policy'].dtype == torch.float32
    np.testing.assert_array_equal(group['policy'], expected[:, :_SIZE])
    assert ('privileged' in group.keys()) == privileged
    if privileged:
      assert group['privileged'].shape == (3, _PRIVILEGED)
      np.testing.assert_array_equal(group['privileged'], expected[:, _SIZE:])
  assert rewards.dtype == torch.float32 and dones.dtype == torch.int64
  np.testing.assert_array_equal(
    rewards, (_SCALE * step.reward).astype(np.float32)
  )
  assert not dones.any() and not extras['time_outs'].any()
  np.testing.assert_array_equal(env.episode_length_buf, [1, 1, 1])


def test_rsl_rl_tells_time_limits_from_terminations() -> None:
  env = _wrapper('rsl_rl_env').RslRlVecEnv(worlds := _worlds())
  _, twin = _twin()
  actions = importlib.import_module('torch').from_numpy(_standing(worlds))
  ends = []
  for step in range(_HORIZON):
    if step == 1:
      _lost(worlds, twin)
    seen, _, dones, extras = env.step(actions)
    final = twin.step(actions.numpy()).observation
    ended = dones.bool()
    ends.append((dones.tolist(), extras['time_outs'].tolist()))
    before = extras['final_observations']['policy']
    if step < 2:  # Later, world 0 is in another episode than its twin.
      np.testing.assert_array_equal(before, final)
    np.testing.assert_array_equal(before[1:], final[1:])
    np.testing.assert_array_equal(before[~ended], seen['policy'][~ended])
    assert (before[ended] != seen['policy'][ended]).any(dim=1).all()
    np.testing.assert_array_equal(env.episode_length_buf[ended], 0)
  assert ends == [
    ([0, 0, 0], [False, False, False]),
    ([1, 0, 0], [False, False, False]),
    ([0, 1, 1], [False, True, True]),
  ]


@pytest.mark.parametrize('privileged', [False, True])
def test_stable_baselines3_sees_what_the_worlds_see(privileged: bool) -> None:
  module = _wrapper('stable_baselines3_env')
  worlds = _worlds(privileged=privileged)
  first, twin = _twin(privileged=privileged)
  env = module.StableBaselines3VecEnv(worlds, _SCALE)
  assert env.num_envs == 3 and env.observation_space.shape == (_SIZE,)
  bounds = worlds.action_spec()
  np.testing.assert_allclose(env.action_space.low, bounds.minimum, rtol=1e-6)
  np.testing.assert_allclose(env.action_space.high, bounds.maximum, rtol=1e-6)
  np.testing.assert_array_equal(env.reset(), first[:, :_SIZE])
  step = twin.step(_standing(worlds))
  seen, rewards, dones, infos = env.step(_standing(worlds))
  np.testing.assert_array_equal(seen, step.observation[:, :_SIZE])
  assert (seen.dtype, rewards.dtype, dones.dtype) == ('f4', 'f4', bool)
  np.testing.assert_array_equal(
    rewards, (_SCALE * step.reward).astype(np.float32)
  )
  assert not dones.any() and infos == [{}, {}, {}]


def test_stable_baselines3_tells_time_limits_from_terminations() -> None:
  worlds = _worlds(privileged=True)
  env = _wrapper('stable_baselines3_env').StableBaselines3VecEnv(worlds)
  env.reset()
  _, twin = _twin(privileged=True)
  for step in range(_HORIZON):
    if step == 1:
      _lost(worlds, twin)
    seen, _, dones, infos = env.step(_standing(worlds))
    final = twin.step(_standing(worlds)).observation[:, :_SIZE]
    for world in range(3):
      is_fall, is_limit = (step, world) == (1, 0), step == 2 and world > 0
      assert dones[world] == (is_fall or is_limit)
      if not dones[world]:
        assert infos[world] == {}
        continue
      assert infos[world]['TimeLimit.truncated'] is is_limit
      end = infos[world]['terminal_observation']
      np.testing.assert_array_equal(end, final[world])
      assert (end != seen[world]).any()


def test_stable_baselines3_reaches_into_no_world() -> None:
  env = _wrapper('stable_baselines3_env').StableBaselines3VecEnv(_worlds())
  assert env.get_attr('render_mode') == [None] * 3
  assert not env.has_attr('spec')
  assert env.env_is_wrapped(object, [0, 2]) == [False, False]
  with pytest.raises(NotImplementedError, match='gravity'):
    env.set_attr('gravity', 0.0)
  with pytest.raises(NotImplementedError, match='jump'):
    env.env_method('jump')
  env.close()


def test_stable_baselines3_trains_behind_its_own_wrappers() -> None:
  env = _wrapper('stable_baselines3_env').StableBaselines3VecEnv(_worlds())
  library3 = importlib.import_module('stable_baselines3')
  wrappers = importlib.import_module('stable_baselines3.common.vec_env')
  monitor = wrappers.VecMonitor(env)
  model = library3.PPO(
    'MlpPolicy',
    wrappers.VecNormalize(monitor),
    n_steps=8,
    batch_size=12,
    n_epochs=1,
    device='cpu',
  )
  model.learn(24)
  assert model.num_timesteps == 24
  assert {episode['l'] for episode in model.ep_info_buffer} == {_HORIZON}


def test_rsl_rl_trains() -> None:
  env = _wrapper('rsl_rl_env').RslRlVecEnv(_worlds(privileged=True))
  runners = importlib.import_module('rsl_rl.runners')
  network = {'class_name': 'MLPModel', 'hidden_dims': [8], 'activation': 'elu'}
  distribution = {'class_name': 'GaussianDistribution', 'init_std': 0.1}
  settings = {
    'num_steps_per_env': 4,
    'obs_groups': {'actor': ['policy'], 'critic': ['policy', 'privileged']},
    'algorithm': {'class_name': 'PPO', 'num_mini_batches': 2},
    'actor': {**network, 'distribution_cfg': distribution},
    'critic': network,
  }
  runner = runners.OnPolicyRunner(env, settings, device='cpu')
  before = [p.detach().clone() for p in runner.alg.actor.parameters()]
  runner.learn(2)
  assert (runner.alg.actor.obs_dim, runner.alg.critic.obs_dim) == (37, 50)
  after = runner.alg.actor.parameters()
  assert all((b != a).any() for b, a in zip(before, after, strict=True))


@pytest.mark.parametrize('name', _PACKAGES)
def test_without_a_library_one_line_says_what_to_install(name: str) -> None:
  package, extra = _PACKAGES[name]
  pytest.importorskip('gymnasium')
  module = f'dmc_multimode.suite.wrappers.{name}'
  with mock.patch.dict(sys.modules, {package: None}):
    for loaded in tuple(sys.modules):
      if loaded == module or loaded.startswith(f'{package}.'):
        del sys.modules[loaded]
    with pytest.raises(ModuleNotFoundError) as caught:
      importlib.import_module(module)
  message = str(caught.value)
  assert message.startswith(package)
  assert message.endswith(f'pip install dmc_multimode[{extra}]')
