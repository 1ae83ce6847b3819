"""The suite's tasks in Gymnasium, one at a time and as batches of worlds."""

import functools
import importlib
import math
import pathlib
import sys
from typing import Any
from unittest import mock
import warnings

import numpy as np
import pytest

from dmc_multimode import suite
from dmc_multimode.suite.imitation import observations
from dmc_multimode.utils import durations
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
wrappers = importlib.import_module('gymnasium.wrappers.vector')
_Autoreset = gymnasium.vector.AutoresetMode

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


def test_another_robot() -> None:
  file = pathlib.Path(__file__).parents[2] / 'robots' / 'four_legs.yaml'
  name = 'dmc_multimode/trot_forward-v0'
  one = gymnasium.make(name, robot=file)
  many = gymnasium.make_vec(name, num_envs=3, robot=file)
  observation, _ = one.reset(seed=0)
  observations, _ = many.reset(seed=0)
  assert observations.shape == (3, *observation.shape)
  assert many.single_action_space == one.action_space
  assert one.action_space.shape == (12,)
  one.close()
  many.close()


def test_without_gymnasium_one_line_says_what_to_install() -> None:
  name = gymnasium_env.__name__
  with mock.patch.dict(sys.modules, {'gymnasium': None}):
    del sys.modules[name]
    with pytest.raises(ModuleNotFoundError) as caught:
      importlib.import_module(name)
  assert str(caught.value) == (
    'Gymnasium is not installed: pip install dmc_multimode[gym]'
  )


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
  assert info == {'mode': env.unwrapped.mode_names.index('idle')}
  _, reward, *_, info = env.step(env.action_space.dtype.type(1))
  assert info == {'mode': 1}
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


@pytest.mark.parametrize('count', [None, 2])
def test_nothing_is_done_after_close(count: int | None) -> None:
  env = _batch('idle', count) if count else gymnasium_env.make('idle')
  env.reset(seed=0)
  env.close()
  env.close()  # Which is harmless.
  for call in (env.reset, env.render, lambda: env.step(_KICK)):
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match='closed'):
      call()


# Buffers and axes that Composer environments can be asked for.
@pytest.mark.parametrize(
  ('task', 'depth', 'size'),
  [('walk_forward', 1, 37), ('walk_forward', 3, 41), ('reach_gap', 1, 84)],
)
def test_observation_has_the_declared_size(
  task: str, depth: int, size: int
) -> None:
  kwargs = {'environment_kwargs': {'strip_singleton_obs_buffer_dim': False}}
  env = _make(task, task_kwargs=kwargs)
  inner = env.unwrapped._environment
  if depth > 1:
    inner.task.task_observables['clock'].buffer_size = depth
    inner.task.task_observables['height'].aggregator = 'mean'
    inner._recompile_physics_and_update_observables()
  env = gymnasium_env.GymnasiumEnv(inner)
  observation, _ = env.reset(seed=0)
  assert observation in env.observation_space
  assert observation.shape == (size,)


@pytest.mark.parametrize(
  ('task', 'limit', 'steps'),
  [
    ('walk_forward', {}, 150),
    ('walk_forward', {'time_limit': 9.0}, 300),
    ('walk_forward', {'time_limit': 9.0, 'max_episode_steps': 7}, 7),
    ('walk_forward', {'time_limit': math.inf}, None),
    ('reach_gap', {}, 11),
    ('reach_parkour', {'time_limit': 0.6}, 4),
    ('reach_parkour', {}, None),
  ],
)
def test_spec_tells_the_time_limit(
  task: str, limit: dict[str, Any], steps: int | None
) -> None:
  assert _make(task, **limit).spec.max_episode_steps == steps
  if not task.startswith('reach'):
    envs = _batch(task, 2, **limit)
    assert envs.spec.max_episode_steps == steps
    assert envs._worlds.config.horizon == (steps or durations.UNBOUNDED)
    with pytest.raises(ValueError, match='max_episode_steps.*time_limit'):
      _batch(task, 2, max_episode_steps=151)


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
@pytest.mark.parametrize('size', [(64, 48), (801, 611)])
def test_frame(size: tuple[int, int]) -> None:
  width, height = size
  env = _make('idle', render_mode='rgb_array', width=width, height=height)
  assert env.metadata['render_fps'] == 33
  env.reset(seed=0)
  env.unwrapped._environment.physics.render(32, 32)  # Before, and smaller.
  frame = env.render()
  assert (frame.shape, frame.dtype) == ((height, width, 3), np.uint8)
  assert frame[:, -width // 8 :].std() > 5.0 and frame.std() > 5.0


@pytest.mark.gl
def test_frames_of_a_batch() -> None:
  view = {'render_mode': 'rgb_array', 'width': 64, 'height': 48}
  envs = _batch('pi2', 5, **view)
  envs.reset(seed=0)
  frames = envs.render()
  assert [frame.shape for frame in frames] == [(48, 64, 3)] * 5
  [picture] = _batch_like(envs, **view, render_worlds=3, render_grid=True)
  for frame, place in zip(frames, np.ndindex(2, 2), strict=False):
    row, column = place[0] * 48, place[1] * 64
    cell = picture[row : row + 48, column : column + 64]
    expected = frame if place != (1, 1) else 0 * frame
    np.testing.assert_array_equal(cell, expected)
  envs.unwrapped._worlds.qpos[:, 2] += 5.0  # Out of sight.
  assert abs(envs.render()[0].astype(float) - frames[0]).mean() > 1.0


def _batch_like(envs: Any, **kwargs: Any) -> Any:
  """Frames of other environments in the same state."""
  other = _batch('pi2', envs.num_envs, **kwargs)
  other.reset(seed=0)
  return other.render()


@pytest.mark.parametrize('count', [None, 2])
@pytest.mark.parametrize(
  ('view', 'message'),
  [
    ({'width': 0}, 'width must be a whole number of pixels from 1 to 4096'),
    ({'height': -480}, 'height must'),
    ({'height': 480.0}, 'height must'),
    ({'width': 100_000}, 'width must'),
    ({'camera': 'top'}, "'top'; cameras are .*walker/side"),
    ({'render_mode': 'human'}, 'render mode'),
  ],
)
def test_refuses_what_cannot_be_drawn(
  count: int | None, view: dict[str, Any], message: str
) -> None:
  with pytest.raises(ValueError, match=message):
    if count:
      vector_env.make_vector('idle', count, **view)
    else:
      gymnasium_env.make('idle', **view)


def test_no_frame_without_a_render_mode() -> None:
  env = gymnasium_env.make('idle')
  env.reset()
  assert env.render() is None


@pytest.mark.slow
def test_processes_that_have_imported_nothing() -> None:
  name = gymnasium_env.environment_id('walk_forward')
  make = functools.partial(gymnasium.make, f'{gymnasium_env.__name__}:{name}')
  envs = gymnasium.vector.AsyncVectorEnv([make, make], context='spawn')
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
      assert infos['final_info']['mode'][world] == 0
  assert truncated[[0, 2]].all() and not terminated[[0, 2]].any()
  envs = _batch('idle', 1, time_limit=3.0)
  envs.reset(seed=0)
  assert _last(envs, _KICK[None], 99)[1:] == (True, False)


@pytest.mark.parametrize('mode', _Autoreset)
def test_worlds_begin_anew_as_those_of_gymnasium_do(mode: Any) -> None:
  ours = _batch('idle', 2, time_limit=0.09, autoreset_mode=mode.value)
  theirs = _batch(
    'idle',
    2,
    time_limit=0.09,
    vectorization_mode='sync',
    vector_kwargs={'autoreset_mode': mode},
  )
  assert ours.metadata['autoreset_mode'] is ours.autoreset_mode is mode
  actions = np.tile(ours._worlds.standing_action(), (2, 1)).astype(np.float32)

  def run(envs: Any) -> list[Any]:
    first, _ = envs.reset(seed=0)
    mask = np.array([True, False])
    second, _ = envs.reset(options={'reset_mask': mask})
    assert (first == second).all(axis=1).tolist() == [False, True]
    envs.step(actions)
    envs.reset(options={'reset_mask': mask})  # World 0 is a step behind.
    seen = []
    for _ in range(9):
      observation, reward, terminated, truncated, infos = envs.step(actions)
      assert observation in envs.observation_space
      done = terminated | truncated
      seen.append([(reward > 0.5), terminated, truncated, sorted(infos)])
      if mode is _Autoreset.DISABLED and done.any():
        if envs is ours:  # Theirs would step the other world.
          with pytest.raises(gymnasium.error.ResetNeeded, match='reset_mask'):
            envs.step(actions)
        envs.reset(options={'reset_mask': done})
    return seen

  np.testing.assert_equal(run(ours), run(theirs))


@pytest.mark.parametrize('mode', _Autoreset)
def test_a_world_that_diverged_is_seen_in_finite_numbers(mode: Any) -> None:
  envs = _batch('idle', 2, autoreset_mode=mode)
  envs.reset(seed=0)
  envs._worlds.qvel[1] = np.nan
  observation, reward, terminated, _, infos = envs.step(np.zeros((2, 10)))
  assert np.isfinite(infos.get('final_obs', observation)).all()
  assert terminated.tolist() == [False, True] and reward[1] == 0.0


@pytest.mark.parametrize(
  ('mask', 'error'),
  [
    ([True, False], TypeError),
    (np.array([1, 0]), TypeError),
    (np.array([True]), ValueError),
    (np.zeros(2, dtype=bool), ValueError),
  ],
)
def test_what_is_no_mask(mask: Any, error: type[Exception]) -> None:
  envs = _batch('idle', 2)
  envs.reset()
  with pytest.raises(error, match='reset_mask'):
    envs.reset(options={'reset_mask': mask})


_NEXT, _SAME = _Autoreset.NEXT_STEP, _Autoreset.SAME_STEP


@pytest.mark.parametrize(
  ('name', 'mode', 'kwargs'),
  [
    ('RecordEpisodeStatistics', _SAME, {}),
    ('RecordEpisodeStatistics', _NEXT, {}),
    ('NormalizeObservation', _NEXT, {}),
    ('FlattenObservation', _NEXT, {}),
    ('DtypeObservation', _NEXT, {'dtype': np.float64}),
    ('ReshapeObservation', _NEXT, {'shape': (37, 1)}),
    ('NormalizeReward', _SAME, {}),
    ('ClipReward', _SAME, {'min_reward': 0.1, 'max_reward': 0.2}),
    ('ClipAction', _SAME, {}),
    ('RescaleAction', _SAME, {'min_action': -1.0, 'max_action': 1.0}),
    ('DictInfoToList', _SAME, {}),
    ('NumpyToTorch', _SAME, {}),
  ],
)
def test_gymnasiums_own_wrappers(
  name: str, mode: Any, kwargs: dict[str, Any]
) -> None:
  if name == 'NumpyToTorch':
    pytest.importorskip('array_api_compat')
  inner = _batch('idle', 2, time_limit=0.09, autoreset_mode=mode)
  envs = getattr(wrappers, name)(inner, **kwargs)
  envs.reset(seed=0)
  envs.action_space.seed(0)
  statistics = []
  for _ in range(8):
    actions = envs.action_space.sample()
    if name == 'NumpyToTorch':
      actions = importlib.import_module('torch').from_numpy(actions)
    observation, reward, _, _, infos = envs.step(actions)
    assert np.asarray(observation) in envs.observation_space
    if name == 'ClipReward':
      assert np.all((reward >= 0.1) & (reward <= 0.2))
    if name == 'RecordEpisodeStatistics' and 'episode' in infos:
      statistics += infos['episode']['l'].tolist()
  assert set(statistics) <= {3} and statistics or 'Record' not in name


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
  with pytest.raises(gymnasium.error.ResetNeeded):
    _batch('idle', 1).reset(options={'reset_mask': np.array([True])})
  with pytest.raises(ValueError, match="'Never'.*'NextStep', 'SameStep'"):
    _batch('idle', 1, autoreset_mode='Never')
  with pytest.raises(ValueError, match='render_worlds'):
    _batch('idle', 1, render_worlds=2)
