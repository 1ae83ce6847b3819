"""Every entrance takes and refuses the same actions, and counts alike.

Whatever drives a robot goes through one of these: the two engines, the wrappers
around them, and policies.
"""

import dataclasses
import importlib
import math
import re
from typing import Any, Callable

import numpy as np
import pytest
import torch

from dmc_multimode import pretrained
from dmc_multimode import suite
from dmc_multimode.agents.ppo import acting
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import durations

gymnasium = pytest.importorskip('gymnasium', reason='The extra `gym`.')

_ENDLESS = task_config.ImitationConfig(
  events=events.NONE, limits=terminations.NO_LIMITS
)
_ID = 'dmc_multimode/idle-v0'
_WORLDS = 3
Step = Callable[[Any], Any]


def _wrapper(name: str) -> Any:
  return importlib.import_module(f'dmc_multimode.suite.wrappers.{name}')


def _composer(**kwargs: Any) -> Any:
  return multimode_biped.imitation(
    'idle', random=0, **{'config': _ENDLESS, **kwargs}
  )


def _batched(
  config: task_config.ImitationConfig = _ENDLESS, auto_reset: bool = True
) -> Any:
  task = multimode_biped.make_modes_task('idle', config=config)
  return batched_env.BatchedImitation(task, _WORLDS, 0, 1, auto_reset)


def _gymnasium(**kwargs: Any) -> Any:
  _wrapper('gymnasium_env')
  kwargs.setdefault('task_kwargs', {'config': _ENDLESS})
  return gymnasium.make(_ID, disable_env_checker=True, **kwargs)


def _vector(**kwargs: Any) -> Any:
  _wrapper('gymnasium_env')
  kwargs.setdefault('task_kwargs', {'config': _ENDLESS})
  return gymnasium.make_vec(_ID, num_envs=_WORLDS, **kwargs)


def _stable_baselines3() -> Any:
  pytest.importorskip('stable_baselines3', reason='The extra `sb3`.')
  wrapper = _wrapper('stable_baselines3_env')
  return wrapper.StableBaselines3VecEnv(_batched())


def _rsl_rl() -> Any:
  pytest.importorskip('rsl_rl', reason='The extra `rsl_rl`.')
  env = _wrapper('rsl_rl_env').RslRlVecEnv(_batched())
  return lambda action: env.step(torch.from_numpy(np.asarray(action)))


Entrances = dict[str, Callable[..., Any]]
_SINGLE: Entrances = {'composer': _composer, 'gymnasium': _gymnasium}
_MANY: Entrances = {
  'batched': _batched,
  'vector': _vector,
  'stable_baselines3': _stable_baselines3,
  'rsl_rl': _rsl_rl,
}


def _begun(name: str) -> Step:
  """Returns the step of an entrance that has been reset."""
  env: Any = (_SINGLE | _MANY)[name]()
  if name == 'rsl_rl':
    return env
  env.reset(**({'seed': 0} if name in ('gymnasium', 'vector') else {}))
  return env.step


@pytest.mark.parametrize('name', [*_SINGLE, *_MANY])
def test_actions(name: str) -> None:
  step = _begun(name)
  shape = (10,) if name in _SINGLE else (_WORLDS, 10)
  good = np.full(shape, 0.25)
  wanted = re.escape(f'must have shape {shape}')
  for other in ((1,), (10, 1), (_WORLDS, 1), (1, 10), (4, 10), (11,)):
    with pytest.raises(ValueError, match=wanted):
      step(np.zeros(other))
  for value in (math.nan, math.inf, -math.inf):
    bad = good.copy()
    bad[(1, 4) if name in _MANY else 4] = value
    message = 'action must be finite'
    if name in _MANY:
      message = 'actions of world 1 must be finite'
    with pytest.raises(ValueError, match=message):
      step(bad)
  # Nothing has happened to the worlds, and numbers of any kind are the same.
  twin = _begun(name)
  for action in (
    good.astype(np.float32),
    np.repeat(good, 2, axis=-1)[..., ::2],
    np.zeros(shape, dtype=np.int64),
    *([] if name == 'rsl_rl' else [good.tolist()]),
  ):
    mine, other = step(action), twin(np.asarray(action, dtype=np.float64))
    np.testing.assert_array_equal(_reward(mine), _reward(other))


def _reward(step: Any) -> Any:
  return step.reward if hasattr(step, 'reward') else step[1]


def test_worlds_that_do_not_act_need_no_actions() -> None:
  worlds = _batched(auto_reset=False)
  worlds.reset()
  worlds.moving[0] = False
  actions = np.zeros((_WORLDS, 10))
  actions[0] = math.nan
  worlds.step(actions)
  worlds.qpos[1, 0] = math.nan  # It has diverged.
  actions[1] = math.nan
  worlds.step(actions)
  actions[2] = math.nan
  with pytest.raises(ValueError, match='of world 2 must'):
    worlds.step(actions)


@pytest.mark.parametrize('modes', [[0], [0, 0, 1], [0.0] * 3, [[0]] * 3, 0])
def test_commands_refused(modes: Any) -> None:
  worlds = _batched()
  worlds.reset()
  with pytest.raises(ValueError, match='modes must'):
    worlds.command(modes)
  with pytest.raises(ValueError, match='sources must'):
    worlds.copy_state(np.array([0, 1, _WORLDS]))


# --- Observations of policies.


@pytest.mark.parametrize('which', ['policy', 'actor', 'batched'])
def test_observations(which: str) -> None:
  policy = pretrained.load('pi2_paper')
  size, more = 37, policy.network.privileged_size
  select: Step = {
    'policy': policy.select_action,
    'actor': lambda rows: policy.actor.select_action({'all': rows[0]})[None],
    'batched': acting.BatchedActor(policy.network, 0).select_action,
  }[which]
  seen = np.random.RandomState(0).standard_normal((2, size))
  expected = select(seen.astype(np.float32))[:1]
  for rows in (
    seen,
    seen.astype(np.float32)[::-1][::-1],
    np.asfortranarray(seen),
    np.concatenate([seen, np.full((2, more), math.nan)], axis=1),
  ):
    np.testing.assert_allclose(select(rows)[:1], expected, atol=1e-6)
  for width in (47, 36, 1):
    with pytest.raises(ValueError, match=f'has 37 numbers.* got {width}'):
      select(np.zeros((2, width)))
  with pytest.raises(ValueError, match='real numbers'):
    select(np.full((2, size), 'a'))


# --- Time limits.


def _composer_steps(env: Any) -> int:
  step, count = env.reset(), 0
  while not step.last():
    step, count = env.step(np.zeros(10)), count + 1
  return count


def _gymnasium_steps(env: Any, shape: tuple[int, ...]) -> int:
  env.reset(seed=0)
  for step in range(1, 1000):
    *_, truncated, _ = env.step(np.zeros(shape, dtype=np.float32))
    if np.any(truncated):
      return step
  raise AssertionError('The episode never ends.')


@pytest.mark.parametrize(
  ('seconds', 'expected'), [(1.0, 33), (0.31, 10), (0.3, 10), (0.05, 2)]
)
def test_time_limits_are_the_same_everywhere(
  seconds: float, expected: int
) -> None:
  """The nearest whole number of control steps of 0.03 s."""
  limited = dataclasses.replace(_ENDLESS, time_limit=seconds)
  batch = _batched(limited)
  batch.reset()
  counts = {
    'config': limited.horizon,
    'batched': next(
      i for i in range(1, 99) if batch.step(np.zeros((_WORLDS, 10))).last.all()
    ),
    'composer': _composer_steps(_composer(time_limit=seconds)),
    'dm_control': _composer_steps(
      suite.load(
        suite.DOMAIN,
        'idle',
        {'config': _ENDLESS, 'random': 0},
        {'time_limit': seconds},
      )
    ),
    'gymnasium': _gymnasium_steps(_gymnasium(time_limit=seconds), (10,)),
    'vector': _gymnasium_steps(_vector(time_limit=seconds), (_WORLDS, 10)),
  }
  assert counts == dict.fromkeys(counts, expected)


def test_episodes_without_a_time_limit() -> None:
  env = _composer(time_limit=math.inf)
  assert env.task.config.horizon == durations.UNBOUNDED
  env.reset()
  assert not any(env.step(np.zeros(10)).last() for _ in range(200))
  falling = dataclasses.replace(
    _ENDLESS,
    time_limit=math.inf,
    limits=terminations.falls_alone(terminations.TerminationLimits()),
  )
  batch, total, ends = _batched(falling), np.zeros(_WORLDS), 0
  batch.reset()
  while not ends:
    step = batch.step(np.full((_WORLDS, 10), 3.0))
    total += step.reward
    results = step.results
    # Of as many steps as they had.
    np.testing.assert_allclose(
      results.returns, total[results.worlds] / results.lengths
    )
    ends += len(results.worlds)
