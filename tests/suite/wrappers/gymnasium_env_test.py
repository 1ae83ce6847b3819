"""The suite's tasks in Gymnasium, one at a time and as batches of worlds."""

import importlib
import sys
from typing import Any
from unittest import mock
import warnings

import numpy as np
import pytest

from dmc_multimode import suite
from dmc_multimode.suite.imitation import observations
from dmc_multimode.walkers import mini_biped

gymnasium = pytest.importorskip(
  'gymnasium', reason='Gymnasium is not installed: the extra `gym`.'
)
gymnasium_env = importlib.import_module(
  'dmc_multimode.suite.wrappers.gymnasium_env'
)
vector_env = importlib.import_module(
  'dmc_multimode.suite.wrappers.gymnasium_vector_env'
)
env_checker = importlib.import_module('gymnasium.utils.env_checker')

# Joint targets are in radians and what robots do has no bounds: both advised
# against, and meant. Rendering is tested on its own.
_EXPECTED_WARNINGS = (
  'Box observation space minimum value is -infinity',
  'Box observation space maximum value is infinity',
  'we recommend using a symmetric and normalized space',
)
_KICK = np.full(10, 3.0, dtype=np.float32)  # Joint targets, radians: it falls.


def _make(task: str = 'walk_forward', **kwargs: Any) -> Any:
  return gymnasium.make(gymnasium_env.environment_id(task), **kwargs)


def _batch(task: str, count: int, **kwargs: Any) -> Any:
  return gymnasium.make_vec(gymnasium_env.environment_id(task), count, **kwargs)


def _standing(env: Any) -> np.ndarray:
  model = env.unwrapped._environment.physics.model.ptr
  return mini_biped.standing_action(model).astype(np.float32)


def _last(env: Any, action: Any, most: int) -> tuple[int, bool, bool]:
  """Steps until the episode ends: steps, whether terminated, truncated."""
  for step in range(1, most + 1):
    terminated, truncated = map(bool, env.step(action)[2:4])
    if terminated or truncated:
      return step, terminated, truncated
  raise AssertionError(f'No end within {most} steps.')


def test_every_task_is_registered_once() -> None:
  before = dict(gymnasium.registry)
  assert {f'dmc_multimode/{task}-v0' for _, task in suite.ALL_TASKS} <= set(
    before
  )
  with warnings.catch_warnings():
    warnings.simplefilter('error')
    gymnasium_env.register()
  assert dict(gymnasium.registry) == before


def test_without_gymnasium_one_line_says_what_to_install() -> None:
  name = gymnasium_env.__name__
  with mock.patch.dict(sys.modules, {'gymnasium': None}):
    del sys.modules[name]
    with pytest.raises(ModuleNotFoundError) as caught:
      importlib.import_module(name)
  assert str(caught.value) == (
    'Gymnasium is not installed: pip install dmc_multimode[gym]'
  )


@pytest.mark.parametrize('task', [task for _, task in suite.ALL_TASKS])
def test_gymnasiums_own_check(task: str) -> None:
  env = _make(task)
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    env_checker.check_env(env.unwrapped, skip_render_check=True)
  env.close()
  assert not [
    str(warning.message)
    for warning in caught
    if 'gymnasium' in warning.filename
    and not any(text in str(warning.message) for text in _EXPECTED_WARNINGS)
  ]


def test_observation_is_the_suites_in_the_order_of_the_layout() -> None:
  environment = suite.load('multimode_biped', 'pi2', {'random': 1})
  env = gymnasium_env.GymnasiumEnv(environment)
  observation, _ = env.reset()
  twin = suite.load('multimode_biped', 'pi2', {'random': 1}).reset()
  expected = np.concatenate(
    [twin.observation[name] for name, _ in observations.layout(4)]
  )
  np.testing.assert_array_equal(observation, expected.astype(np.float32))
  assert env.observation_space.shape == (37,)
  assert env.action_space.dtype == np.float32


def test_modes_as_actions() -> None:
  env = _make('reach_gap', task_kwargs={'policy': 'quickstart'})
  assert env.action_space == gymnasium.spaces.Discrete(3)
  assert env.action_space.dtype == np.int64
  observation, info = env.reset(seed=1)
  assert observation.shape == env.observation_space.shape
  assert info == {'mode': 'idle'}
  _, reward, *_, info = env.step(env.action_space.dtype.type(1))
  assert info == {'mode': 'walk_forward'}
  assert 0.0 <= reward <= 10.0  # Of ten control steps.
  with pytest.raises(ValueError, match='index of a mode'):
    env.unwrapped.step(1.5)
  assert _last(env, 0, 20) == (10, False, True)
  env.reset()
  steps, *how = _last(env, 1, 9)  # Into the gap, before the last knot.
  assert how == [True, False]


def test_fall_terminates_and_time_limit_truncates() -> None:
  env = _make('idle', time_limit=0.3)
  env.reset(seed=0)
  assert _last(env, _standing(env), 20) == (10, False, True)
  env = _make('idle', time_limit=3.0)
  env.reset(seed=0)
  assert _last(env, _KICK, 99)[1:] == (True, False)


def test_step_needs_a_running_episode() -> None:
  env = gymnasium_env.make('idle', time_limit=0.03)
  with pytest.raises(gymnasium.error.ResetNeeded):
    env.step(_KICK)
  env.reset()
  env.step(_KICK)
  with pytest.raises(gymnasium.error.ResetNeeded):
    env.step(_KICK)
  env.close()
  env.close()  # Which is harmless.


def _run(env: Any, seed: int | None, steps: int) -> tuple[Any, ...]:
  """Observations, rewards and modes under random actions."""
  random_state = np.random.RandomState(0)
  standing = _standing(env)
  observation, info = env.reset(seed=seed)
  seen, rewards, modes = [observation], [], [info['mode']]
  for _ in range(steps):
    noise = 0.3 * random_state.standard_normal(10).astype(np.float32)
    observation, reward, terminated, truncated, info = env.step(
      standing + noise
    )
    rewards.append(reward)
    if terminated or truncated:
      observation, info = env.reset()
    seen.append(observation)
    modes.append(info['mode'])
  return np.array(seen).tolist(), rewards, modes


# Of pi2, where a sampler learns: equal seeds start it anew.
def test_equal_seeds_lead_to_equal_episodes() -> None:
  env = _make('pi2')
  first = _run(env, 7, 60)
  _run(env, None, 25)  # Ends in mid-episode.
  assert _run(env, 7, 60) == first
  assert _run(_make('pi2'), 7, 60) == first


@pytest.mark.parametrize('seed', [8, 2**40, None])
def test_other_seeds_lead_to_other_episodes(seed: int | None) -> None:
  env = _make('walk_forward')
  first, _ = env.reset(seed=7)
  second, _ = env.reset(seed=seed)
  assert not np.array_equal(first, second)


@pytest.mark.gl
def test_frame() -> None:
  env = _make('idle', render_mode='rgb_array', width=64, height=48)
  assert env.metadata['render_fps'] == 33
  env.reset(seed=0)
  frame = env.render()
  assert (frame.shape, frame.dtype) == ((48, 64, 3), np.uint8)
  assert frame.std() > 5.0


def test_no_frame_without_a_render_mode() -> None:
  env = gymnasium_env.make('idle')
  env.reset()
  assert env.render() is None
  with pytest.raises(ValueError, match='render mode'):
    gymnasium_env.make('idle', render_mode='human')


@pytest.mark.slow
def test_processes() -> None:
  envs = _batch('walk_forward', 2, vectorization_mode='async')
  try:
    observation, _ = envs.reset(seed=3)
    again, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(observation, again)
    assert not np.array_equal(observation[0], observation[1])
    _, rewards, *_ = envs.step(np.zeros((2, 10), dtype=np.float32))
    assert np.all((rewards >= 0) & (rewards <= 1))
  finally:
    envs.close()


def test_batch_of_modes_as_actions_is_single_environments() -> None:
  envs = _batch('reach_gap', 2, task_kwargs={'policy': 'quickstart'})
  assert isinstance(envs, gymnasium.vector.SyncVectorEnv)
  envs.close()


@pytest.mark.parametrize('task', ['walk_forward', 'launch', 'pi2'])
def test_batch_keeps_to_its_spaces(task: str) -> None:
  envs = _batch(task, 3)
  assert isinstance(envs, vector_env.BatchedVectorEnv)
  single = _make(task)
  assert envs.single_observation_space == single.observation_space
  assert envs.single_action_space == single.action_space
  observation, infos = envs.reset(seed=1)
  assert observation in envs.observation_space
  assert infos['_mode'].all()
  envs.action_space.seed(1)
  for _ in range(3):
    step = envs.step(envs.action_space.sample())
    assert step[0] in envs.observation_space
    assert [part.shape for part in step[1:4]] == [(3,)] * 3
    assert [part.dtype for part in step[2:4]] == [bool] * 2


def test_worlds_of_a_batch_begin_anew_in_the_step_in_which_they_end() -> None:
  envs = _batch('idle', 3, time_limit=0.3)
  envs.reset(seed=0)
  still = envs._worlds.standing_action()
  actions = np.stack([still, _KICK, still]).astype(np.float32)
  for _ in range(10):
    observation, _, terminated, truncated, infos = envs.step(actions)
    ended = terminated | truncated
    assert ('final_obs' in infos) == ended.any()
    for world in np.flatnonzero(ended):
      assert infos['_final_obs'].tolist() == ended.tolist()
      final = infos['final_obs'][world]
      assert final in envs.single_observation_space
      assert not np.array_equal(final, observation[world])
      assert infos['final_info']['mode'][world] == 'idle'
  assert truncated[[0, 2]].all() and not terminated[[0, 2]].any()
  envs = _batch('idle', 1, time_limit=3.0)
  envs.reset(seed=0)
  assert _last(envs, _KICK[None], 99)[1:] == (True, False)


def test_batch_with_equal_seeds_is_equal() -> None:
  def run(envs: Any, seed: int | None) -> np.ndarray:
    standing = np.tile(envs._worlds.standing_action(), (4, 1))
    first = envs.reset(seed=seed)[0]
    return np.array([first] + [envs.step(standing)[0] for _ in range(40)])

  envs = _batch('pi2', 4, time_limit=0.6)
  first = run(envs, 5)
  np.testing.assert_array_equal(run(envs, 5), first)
  np.testing.assert_array_equal(run(_batch('pi2', 4, time_limit=0.6), 5), first)
  assert not np.array_equal(first, run(envs, 6))
  assert not np.array_equal(first[0, 0], first[0, 1])


def test_batch_needs_worlds_and_a_beginning() -> None:
  with pytest.raises(ValueError, match='num_envs'):
    vector_env.make_vector('idle', 0)
  with pytest.raises(gymnasium.error.ResetNeeded):
    _batch('idle', 1).step(np.zeros((1, 10)))
