"""Tests of dmc_multimode.suite.gymnasium_env."""

import importlib
import sys
from typing import Any
from unittest import mock
import warnings

from absl.testing import absltest
from absl.testing import parameterized
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
env_checker = importlib.import_module('gymnasium.utils.env_checker')

# Joint targets are in radians and what robots do has no bounds: both advised
# against, and meant. Rendering is tested on its own.
_EXPECTED_WARNINGS = (
  'Box observation space minimum value is -infinity',
  'Box observation space maximum value is infinity',
  'we recommend using a symmetric and normalized space',
)


def _make(task: str = 'walk_forward', **kwargs: Any) -> Any:
  return gymnasium.make(gymnasium_env.environment_id(task), **kwargs)


def _standing(env: Any) -> np.ndarray:
  model = env.unwrapped._environment.physics.model.ptr
  return mini_biped.standing_action(model).astype(np.float32)


def _run(
  env: Any, seed: int | None, steps: int
) -> tuple[list[np.ndarray], list[float], list[str]]:
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
  return seen, rewards, modes


class RegistryTest(parameterized.TestCase):
  def test_every_task_is_registered(self) -> None:
    for _, task in suite.ALL_TASKS:
      self.assertIn(f'dmc_multimode/{task}-v0', gymnasium.registry)

  def test_registering_again_is_harmless(self) -> None:
    before = dict(gymnasium.registry)
    with warnings.catch_warnings():
      warnings.simplefilter('error')
      gymnasium_env.register()
    self.assertEqual(dict(gymnasium.registry), before)

  def test_without_gymnasium_one_line_says_what_to_install(self) -> None:
    name = gymnasium_env.__name__
    with mock.patch.dict(sys.modules, {'gymnasium': None}):
      del sys.modules[name]
      with self.assertRaises(ModuleNotFoundError) as caught:
        importlib.import_module(name)
    self.assertEqual(
      str(caught.exception),
      'Gymnasium is not installed: pip install dmc_multimode[gym]',
    )


class InterfaceTest(parameterized.TestCase):
  @parameterized.parameters(task for _, task in suite.ALL_TASKS)
  def test_gymnasiums_own_check(self, task: str) -> None:
    env = _make(task)
    with warnings.catch_warnings(record=True) as caught:
      warnings.simplefilter('always')
      env_checker.check_env(env.unwrapped, skip_render_check=True)
    env.close()
    surprises = [
      str(warning.message)
      for warning in caught
      if 'gymnasium' in warning.filename
      and not any(text in str(warning.message) for text in _EXPECTED_WARNINGS)
    ]
    self.assertEmpty(surprises)

  def test_observation_is_the_suites_in_the_order_of_the_layout(self) -> None:
    environment = suite.load('multimode_biped', 'pi2', {'random': 1})
    env = gymnasium_env.GymnasiumEnv(environment)
    observation, _ = env.reset()
    twin = suite.load('multimode_biped', 'pi2', {'random': 1}).reset()
    expected = np.concatenate(
      [twin.observation[name] for name, _ in observations.layout(4)]
    )
    np.testing.assert_array_equal(observation, expected.astype(np.float32))
    self.assertEqual(env.observation_space.shape, (37,))
    self.assertEqual(env.action_space.dtype, np.float32)

  def test_modes_as_actions(self) -> None:
    env = _make('reach_gap', task_kwargs={'policy': 'quickstart'})
    self.assertEqual(env.action_space, gymnasium.spaces.Discrete(3))
    self.assertEqual(env.action_space.dtype, np.int64)
    observation, info = env.reset(seed=1)
    twin = suite.load(
      'multimode_biped', 'reach_gap', {'policy': 'quickstart'}
    ).observation_spec()
    size = sum(part.shape[0] for part in twin.values())
    self.assertEqual(observation.shape, (size,))
    self.assertEqual(info, {'mode': 'idle'})
    _, reward, *_, info = env.step(env.action_space.dtype.type(1))
    self.assertEqual(info, {'mode': 'walk_forward'})
    self.assertBetween(reward, 0.0, 10.0)  # Of ten control steps.
    with self.assertRaisesRegex(ValueError, 'index of a mode'):
      env.unwrapped.step(1.5)
    ends = [env.step(0)[2:4] for _ in range(10)]
    self.assertEqual(ends, [(False, False)] * 9 + [(False, True)])
    env.reset()
    for _ in range(9):  # Into the gap, before the last knot.
      terminated, truncated = env.step(1)[2:4]
      if terminated or truncated:
        break
    self.assertEqual((terminated, truncated), (True, False))

  def test_fall_terminates_and_time_limit_truncates(self) -> None:
    env = _make('idle', time_limit=0.3)
    env.reset(seed=0)
    standing = _standing(env)
    ends = [env.step(standing)[2:4] for _ in range(10)]
    self.assertEqual(ends, [(False, False)] * 9 + [(False, True)])
    env = _make('idle', time_limit=3.0)
    env.reset(seed=0)
    kicking = np.full(10, 3.0, dtype=np.float32)
    for _ in range(100):
      terminated, truncated = env.step(kicking)[2:4]
      if terminated or truncated:
        break
    self.assertEqual((terminated, truncated), (True, False))

  def test_step_needs_a_running_episode(self) -> None:
    env = gymnasium_env.make('idle', time_limit=0.03)
    action = np.zeros(10, dtype=np.float32)
    with self.assertRaises(gymnasium.error.ResetNeeded):
      env.step(action)
    env.reset()
    env.step(action)
    with self.assertRaises(gymnasium.error.ResetNeeded):
      env.step(action)

  def test_close_twice(self) -> None:
    env = gymnasium_env.make('idle')
    env.reset()
    env.close()
    env.close()


class SeedingTest(parameterized.TestCase):
  # Of pi2, where a sampler learns: equal seeds start it anew.
  def test_equal_seeds_lead_to_equal_episodes(self) -> None:
    env = _make('pi2')
    first = _run(env, 7, 60)
    _run(env, None, 25)  # Ends in mid-episode.
    second = _run(env, 7, 60)
    np.testing.assert_array_equal(first[0], second[0])
    self.assertEqual(first[1:], second[1:])
    self.assertEqual(first[2], _run(_make('pi2'), 7, 60)[2])

  @parameterized.parameters(8, 2**40, None)
  def test_other_seeds_lead_to_other_episodes(self, seed: int | None) -> None:
    env = _make('walk_forward')
    first, _ = env.reset(seed=7)
    second, _ = env.reset(seed=seed)
    self.assertFalse(np.array_equal(first, second))


class RenderTest(parameterized.TestCase):
  def test_frame(self) -> None:
    env = _make('idle', render_mode='rgb_array', width=64, height=48)
    self.assertEqual(env.metadata['render_fps'], 33)
    env.reset(seed=0)
    try:
      frame = env.render()
    except Exception as error:  # Of whichever backend is there, or is not.
      self.skipTest(f'This machine cannot render: {error}')
    self.assertEqual((frame.shape, frame.dtype), ((48, 64, 3), np.uint8))
    self.assertGreater(frame.std(), 5.0)

  def test_no_frame_without_a_render_mode(self) -> None:
    env = gymnasium_env.make('idle')
    env.reset()
    self.assertIsNone(env.render())

  def test_unknown_render_mode(self) -> None:
    with self.assertRaisesRegex(ValueError, 'render mode'):
      gymnasium_env.make('idle', render_mode='human')


class VectorTest(parameterized.TestCase):
  def test_processes(self) -> None:
    name = gymnasium_env.environment_id('walk_forward')
    envs = gymnasium.make_vec(name, 2, 'async')
    try:
      observation, _ = envs.reset(seed=3)
      again, _ = envs.reset(seed=3)
      np.testing.assert_array_equal(observation, again)
      self.assertFalse(np.array_equal(observation[0], observation[1]))
      _, rewards, *_ = envs.step(np.zeros((2, 10), dtype=np.float32))
      self.assertTrue(np.all((rewards >= 0) & (rewards <= 1)))
    finally:
      envs.close()

  def _batch(self, task: str, count: int, **kwargs: Any) -> Any:
    envs = gymnasium.make_vec(
      gymnasium_env.environment_id(task), count, **kwargs
    )
    self.addCleanup(envs.close)
    return envs

  @parameterized.parameters('walk_forward', 'launch', 'pi2')
  def test_batch_keeps_to_its_spaces(self, task: str) -> None:
    envs = self._batch(task, 3)
    self.assertIsInstance(envs, gymnasium_env.BatchedVectorEnv)
    single = _make(task)
    self.assertEqual(envs.single_observation_space, single.observation_space)
    self.assertEqual(envs.single_action_space, single.action_space)
    observation, infos = envs.reset(seed=1)
    self.assertIn(observation, envs.observation_space)
    self.assertTrue(infos['_mode'].all())
    envs.action_space.seed(1)
    for _ in range(3):
      step = envs.step(envs.action_space.sample())
      self.assertIn(step[0], envs.observation_space)
      self.assertEqual([part.shape for part in step[1:4]], [(3,)] * 3)
      self.assertEqual([part.dtype for part in step[2:4]], [bool] * 2)

  def test_batch_of_modes_as_actions_is_single_environments(self) -> None:
    envs = self._batch('reach_gap', 2, task_kwargs={'policy': 'quickstart'})
    self.assertIsInstance(envs, gymnasium.vector.SyncVectorEnv)

  def test_worlds_of_a_batch_begin_anew_in_the_step_in_which_they_end(
    self,
  ) -> None:
    envs = self._batch('idle', 3, time_limit=0.3)
    envs.reset(seed=0)
    still = envs._worlds.standing_action()
    kicking = np.full(10, 3.0)
    actions = np.stack([still, kicking, still]).astype(np.float32)
    for _ in range(10):
      observation, _, terminated, truncated, infos = envs.step(actions)
      ended = terminated | truncated
      if not ended.any():
        self.assertNotIn('final_obs', infos)
        continue
      np.testing.assert_array_equal(infos['_final_obs'], ended)
      for world in np.flatnonzero(ended):
        final = infos['final_obs'][world]
        self.assertIn(final, envs.single_observation_space)
        self.assertFalse(np.array_equal(final, observation[world]))
        self.assertEqual(infos['final_info']['mode'][world], 'idle')
    np.testing.assert_array_equal(truncated[[0, 2]], [True, True])
    self.assertFalse(terminated[[0, 2]].any())
    # One that falls before its time limit.
    envs = self._batch('idle', 1, time_limit=3.0)
    envs.reset(seed=0)
    for _ in range(100):
      _, _, terminated, truncated, _ = envs.step(kicking[None])
      if terminated[0] or truncated[0]:
        break
    self.assertEqual((terminated[0], truncated[0]), (True, False))

  def test_batch_with_equal_seeds_is_equal(self) -> None:
    def run(envs: Any, seed: int | None) -> list[np.ndarray]:
      standing = np.tile(envs._worlds.standing_action(), (4, 1))
      seen = [envs.reset(seed=seed)[0]]
      return seen + [envs.step(standing)[0] for _ in range(40)]

    envs = self._batch('pi2', 4, time_limit=0.6)
    first = run(envs, 5)
    for other in (run(envs, 5), run(self._batch('pi2', 4, time_limit=0.6), 5)):
      np.testing.assert_array_equal(first, other)
    self.assertFalse(np.array_equal(first, run(envs, 6)))
    self.assertFalse(np.array_equal(first[0][0], first[0][1]))

  def test_batch_needs_worlds_and_a_beginning(self) -> None:
    with self.assertRaisesRegex(ValueError, 'num_envs'):
      gymnasium_env.make_vector('idle', 0)
    envs = self._batch('idle', 1)
    with self.assertRaises(gymnasium.error.ResetNeeded):
      envs.step(np.zeros((1, 10)))


class StableBaselinesTest(parameterized.TestCase):
  def test_trains(self) -> None:
    stable_baselines3 = pytest.importorskip(
      'stable_baselines3',
      reason='Stable-Baselines3 is not installed: the extra `bench`.',
    )
    env = _make('walk_forward', time_limit=1.5)
    learner = stable_baselines3.PPO(
      'MlpPolicy', env, n_steps=512, batch_size=128, n_epochs=2, seed=0
    )
    parameters = lambda: [
      p.detach().numpy().copy() for p in learner.policy.parameters()
    ]
    before = parameters()
    learner.learn(2048)
    self.assertEqual(learner.num_timesteps, 2048)
    for old, new in zip(before, parameters(), strict=True):
      self.assertFalse(np.array_equal(old, new))
      self.assertTrue(np.isfinite(new).all())
    self.assertGreater(len(learner.ep_info_buffer), 10)  # Episodes that ended.
    observation, _ = env.reset(seed=0)
    action, _ = learner.predict(observation, deterministic=True)
    self.assertIn(action, env.action_space)


if __name__ == '__main__':
  absltest.main()
