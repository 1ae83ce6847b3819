"""Tests of dmc_multimode.suite: one contract for every registered task."""

import types
from typing import Any, Iterator
from unittest import mock

from absl.testing import absltest
from dm_control import suite as dm_suite
from dm_control.suite.wrappers import action_noise
import dm_env
from dm_env import specs
from dm_env import test_utils
import numpy as np
import pytest

from dmc_multimode import suite
from dmc_multimode.modes import library
from dmc_multimode.suite.reaching import problem as reaching

_DOMAIN = 'multimode_biped'
_TASKS = tuple(task for _, task in suite.ALL_TASKS)
_TIME_LIMIT = 0.3  # Seconds: short episodes, so that their ends are met.
_FROZEN = ('ALL_TASKS', 'BENCHMARKING', 'EASY', 'HARD', 'EXTRA', 'REWARD_VIZ')


def _load(task: str, seed: int = 0, **kwargs: Any) -> dm_env.Environment:
  return suite.load(
    _DOMAIN, task, {'random': seed, 'time_limit': _TIME_LIMIT}, **kwargs
  )


def _trajectory(
  env: dm_env.Environment, episodes: int = 2
) -> Iterator[dm_env.TimeStep]:
  """Random actions within the specification."""
  random, spec = np.random.RandomState(0), env.action_spec()

  def act() -> np.ndarray:
    if isinstance(spec, specs.DiscreteArray):
      return random.randint(spec.num_values)
    return random.uniform(spec.minimum, spec.maximum)

  for _ in range(episodes):
    time_step = env.reset()
    yield time_step
    while not time_step.last():
      time_step = env.step(act())
      yield time_step


@pytest.mark.parametrize('task', _TASKS)
def test_contract(task: str) -> None:
  """Checks what dm_control's own tests leave open; see `upstream_test`."""
  env, same = _load(task), _load(task)
  spec = env.action_spec()
  assert isinstance(spec, specs.BoundedArray)
  assert spec.shape == (() if isinstance(spec, specs.DiscreteArray) else (10,))
  parts = env.observation_spec()
  # A step is worth at most 1, or that for each control step in it.
  highest = env.control_timestep() / env.task.control_timestep
  for step, other in zip(_trajectory(env), _trajectory(same), strict=True):
    assert list(step.observation) == list(parts)
    assert step[:3] == other[:3]
    for name, value in step.observation.items():
      parts[name].validate(value)
      np.testing.assert_array_equal(value, other.observation[name])
    if not step.first():
      assert isinstance(step.reward, float)
      assert 0.0 <= step.reward <= highest
      assert step.discount in (0.0, 1.0)


@pytest.mark.parametrize('task', ['idle', 'pi2', 'reach_gap'])
def test_seeds_differ(task: str) -> None:
  first, other = (
    _load(task, seed).reset().observation['joints_pos'] for seed in range(2)
  )
  assert not np.array_equal(first, other)


class _EnvironmentTests(test_utils.EnvironmentTestMixin):
  """dm_env's own tests; the subclasses below name a task each."""

  task = ''

  def make_object_under_test(self) -> dm_env.Environment:
    return _load(self.task)

  def make_action_sequence(self) -> Iterator[np.ndarray]:
    for _ in range(12):  # One more than an episode has.
      yield self.make_action()


for _task in _TASKS:
  _name = f'{_task.title().replace("_", "")}EnvironmentTest'
  globals()[_name] = type(
    _name, (_EnvironmentTests, absltest.TestCase), {'task': _task}
  )


def test_every_mode_and_set_has_a_task() -> None:
  reach = tuple(f'reach_{track}' for track in reaching.TRACKS)
  assert _TASKS == (
    *library.modes(),
    *('pi1', 'pi2', 'pi3', 'pi_all', 'pi_parkour'),
    *reach,
  )


@pytest.mark.parametrize('mode', library.modes())
def test_single_mode_is_commanded(mode: str) -> None:
  env = _load(mode)
  env.reset()
  env.step(np.zeros(10))
  assert env.task.mode == mode
  np.testing.assert_allclose(
    env.task.core.tracker.commands(), library.codebook().subset([mode]).latents
  )


def test_only_pi3_is_paid_for_contacts() -> None:
  weights = {
    name: _load(name).task.config.gains.contact.weight
    for name in ('idle', 'pi1', 'pi2', 'pi3')
  }
  assert weights == ({'idle': 0.0, 'pi1': 0.0, 'pi2': 0.0, 'pi3': 0.3})


@pytest.mark.parametrize('seconds', (0.0, 0.014, np.inf, np.nan))
@pytest.mark.parametrize('task', ('idle', 'reach_gap'))
def test_rejects_time_limit(task: str, seconds: float) -> None:
  if task == 'idle' and seconds == np.inf:
    return  # Unbounded episodes.
  limit = {'time_limit': seconds}
  for task_kwargs, environment_kwargs in ((limit, None), (None, limit)):
    with pytest.raises(ValueError, match='time_limit') as error:
      suite.load(_DOMAIN, task, task_kwargs, environment_kwargs)
    assert '\n' not in str(error.value)


def test_dm_controls_action_noise() -> None:
  """It draws from the task's `random`, before the first reset, too."""
  rewards = []
  for scale in (0.1, 0.1, 0.0):
    env = action_noise.Wrapper(_load('idle'), scale=scale)
    env.step(np.zeros(10))
    rewards.append(env.step(np.zeros(10)).reward)
  assert rewards[0] == rewards[1] != rewards[2]


@pytest.mark.parametrize('task', ('idle', 'reach_gap'))
def test_keywords_reach_the_environment(task: str) -> None:
  env = _load(
    task,
    visualize_reward=True,
    environment_kwargs={'strip_singleton_obs_buffer_dim': task != 'idle'},
  )
  assert env.task.visualize_reward
  env.reset()
  env.step(env.action_spec().generate_value())
  if task == 'idle':
    assert env.observation_spec()['clock'].shape == (1, 2)


def test_dm_control_lists_it_and_loads_it() -> None:
  before = {name: getattr(dm_suite, name) for name in _FROZEN}
  suite.register()  # Once more, which is harmless.
  for name, tasks in before.items():
    assert getattr(dm_suite, name) == tasks
  ours = {(_DOMAIN, task) for task in _TASKS}
  assert ours <= set(dm_suite.ALL_TASKS)
  assert set(dm_suite.TASKS_BY_DOMAIN[_DOMAIN]) == set(_TASKS)
  assert ours <= set(dm_suite.EXTRA)
  assert not ours & set(dm_suite.REWARD_VIZ)
  # Its own test wants actions in [-1, 1] of the tasks in this one.
  assert not ours & set(dm_suite.BENCHMARKING)
  assert ours <= set(dm_suite.EASY + dm_suite.HARD)
  assert (_DOMAIN, 'idle') in dm_suite.EASY
  assert (_DOMAIN, 'reach_gap') in dm_suite.HARD
  assert ('cartpole', 'swingup') in dm_suite.BENCHMARKING
  count = sum(len(tasks) for tasks in dm_suite.TASKS_BY_DOMAIN.values())
  assert len(dm_suite.ALL_TASKS) == count
  env = dm_suite.load(_DOMAIN, 'walk_forward', {'random': 0})
  env.reset()
  assert 0.0 <= env.step(np.zeros(10)).reward <= 1.0
  # Other domains load as ever.
  assert suite.load('cartpole', 'balance', {'random': 0}).reset().first()


def test_clash_is_an_error() -> None:
  stranger = types.ModuleType('stranger')
  domains = {**dm_suite._DOMAINS, _DOMAIN: stranger}
  with mock.patch.object(dm_suite, '_DOMAINS', domains):
    with pytest.raises(ValueError, match='already has a domain'):
      suite.register()
    assert domains[_DOMAIN] is stranger


def test_unknown_names() -> None:
  with pytest.raises(ValueError, match="'fly'.*idle, walk_forward"):
    suite.load(_DOMAIN, 'fly')
  with pytest.raises(ValueError, match='fly'):
    dm_suite.load(_DOMAIN, 'fly')
  with pytest.raises(ValueError, match='centipede'):
    suite.load('centipede', 'walk')
