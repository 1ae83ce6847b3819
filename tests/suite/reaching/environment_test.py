"""Tests of dmc_multimode.suite.reaching_env; the contract: `suite_test`."""

import dataclasses
import functools
import types
from typing import Any

import dm_env
import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode import suite
from dmc_multimode.arenas import track
from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.reaching import environment as reaching_env
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.walkers import mini_biped

# Of pi2; quickstart has the first three.
_IDLE, _WALK, _LEAP, _LAUNCH = range(4)
_load_policy = functools.cache(pretrained.load)


def _load(
  name: str, environment_kwargs: dict[str, Any] | None = None, **kwargs: Any
) -> Any:
  """The registered task with a seed."""
  return suite.load(
    'multimode_biped',
    f'reach_{name}',
    {'random': 3, **kwargs},
    environment_kwargs,
  )


def _assemble(
  policy: pretrained.Policy, arena: str, config: reaching.ReachingConfig
) -> reaching_env.ReachingEnvironment:
  """An environment of one's own track."""
  task = multimode_biped.make_task(
    policy.mode_set,
    episodes.ScheduledEpisodes(schedule.single(np.zeros(1))),
    arena,
    reaching.task_config(policy, config),
  )
  environment = multimode_biped.make_environment(
    task, config.seed, {'time_limit': np.inf}
  )
  return reaching_env.ReachingEnvironment(environment, policy, lambda _: config)


def _run(
  env: Any, plan: list[int]
) -> tuple[list[dm_env.TimeStep], np.ndarray, np.ndarray]:
  """Time steps, and trunk and joints [T, 17] after every control step."""
  path: list[np.ndarray] = []
  env.inner.add_extra_hook(
    'after_step', lambda physics, _: path.append(physics.data.qpos.copy())
  )
  steps = [env.reset()]
  for mode in plan:
    steps.append(env.step(mode))
    if steps[-1].last():
      break
  return steps, np.array(path)[:, :3], np.array(path)


class _Puppet:
  """Stands still, and remembers what it saw."""

  mode_set = library.mode_set('pi2')
  config = task_config.ImitationConfig()

  def __init__(self) -> None:
    self.seen: list[np.ndarray] = []
    self.action = np.zeros(10, dtype=np.float32)

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    self.seen.append(observations)
    return np.tile(self.action, (len(observations), 1))


def _load_puppet(
  name: str, environment_kwargs: dict[str, Any] | None = None, **kwargs: Any
) -> tuple[Any, _Puppet]:
  """The registered task with a puppet that keeps standing."""
  puppet = _Puppet()
  env = _load(name, environment_kwargs, policy=puppet, **kwargs)
  puppet.action = mini_biped.standing_action(env.physics.model.ptr)
  return env, puppet


# --- It is the planner's problem.


@pytest.mark.parametrize(
  ('policy', 'arena', 'plan'),
  [
    ('quickstart', 'flat', [_WALK, _WALK, _LEAP, _LEAP, _IDLE]),
    ('quickstart', 'gap', [_WALK] * 11),  # Falls into it.
    ('pi2', 'flat', [_WALK, _LAUNCH, _LAUNCH, _LAUNCH, _LAUNCH, _WALK]),
  ],
)
def test_what_a_planner_rolls_out(
  policy: str, arena: str, plan: list[int]
) -> None:
  loaded = _load_policy(policy)
  config = reaching.ReachingConfig((0.8, 0.0, 0.5), len(plan), seed=5)
  if arena == 'gap':
    config = dataclasses.replace(config, goal=(2.0, 0.0, 0.5))
  env = _assemble(loaded, arena, config)
  _assert_alike(env, loaded, arena, config, plan)
  # On flat ground launch puts a block where it needs one.
  highest = env.task.root_entity.terrain.tops.max()
  assert highest == (0.4 if _LAUNCH in plan else 0.0)


@pytest.mark.parametrize('name', reaching.TRACKS)
def test_registered_tasks_are_what_planners_get(name: str) -> None:
  if name == reaching.RANDOM_TRACK:
    config = reaching.random_problem(3)
  else:
    config = reaching.PROBLEMS[name].config(3)
  env, random = _load(name), np.random.RandomState(1)
  plan = random.randint(4, size=config.knots).tolist()
  _assert_alike(env, _load_policy('pi2'), name, config, plan)
  assert (tuple(env.goal), env.knots) == (config.goal, config.knots)
  assert env.control_timestep() == config.knot_duration


def _assert_alike(
  env: Any,
  policy: pretrained.Policy,
  arena: str,
  config: reaching.ReachingConfig,
  plan: list[int],
) -> None:
  """Path, rewards and success are those of the planner's problem, exactly."""
  steps, path, _ = _run(env, plan)
  problem = problem_lib.ReachingProblem(policy, track.make(arena), config, 1, 1)
  found = problem.rollout(np.array([plan]))
  np.testing.assert_array_equal(path, found.paths[0, : len(path)])
  rewards = [step.reward for step in steps[1:]]
  assert sum(rewards) == pytest.approx(found.returns[0], abs=1e-12)
  # The planner's goes on after a fall, for nothing.
  fell = steps[-1].discount == 0.0
  assert fell or len(path) == found.paths.shape[1]
  assert env.reached == found.success[0]


# --- A knot.


def test_reward_is_of_every_control_step() -> None:
  env = _load('gap', policy='quickstart')
  steps, path, _ = _run(env, [_WALK, _IDLE])
  assert len(path) == 20
  worth = np.exp(-np.linalg.norm(path - [2.0, 0.0, 0.5], axis=1))
  assert steps[1].reward == pytest.approx(worth[:10].sum())
  assert steps[2].reward == pytest.approx(worth[10:].sum())
  assert (steps[1].discount, steps[2].discount) == (1.0, 1.0)


def test_fall_ends_the_episode() -> None:
  env = _load('gap', policy='quickstart')
  steps, path, _ = _run(env, [_WALK] * env.knots)
  assert steps[-1].last()
  assert steps[-1].discount == 0.0
  assert len(steps) - 1 < env.knots
  assert path[-1, 2] < 0.22 <= path[-2, 2]
  # What comes before the fall in its knot is paid for, the fall is not.
  standing = len(path) - 10 * (len(steps) - 2) - 1
  worth = np.exp(-np.linalg.norm(path - [2.0, 0.0, 0.5], axis=1))
  last = worth[len(path) - 1 - standing : -1].sum()
  assert steps[-1].reward == pytest.approx(last)
  assert not env.reached
  assert env.step(_IDLE).first()


def test_last_knot_ends_the_episode() -> None:
  env, _ = _load_puppet('gap', time_limit=0.7)
  assert env.knots == 2
  for _ in range(2):
    assert env.reset().first()
    middle, last, again = (env.step(_IDLE) for _ in range(3))
    assert middle.mid()
    assert last.last()
    assert last.discount == 1.0
    assert again.first()


def test_policy_acts_on_the_new_command_at_once() -> None:
  env, puppet = _load_puppet('gap')
  env.reset()
  for mode in (_LEAP, _LEAP, _LAUNCH):
    env.step(mode)
  seen = np.concatenate(puppet.seen)
  assert seen.shape == (30, 37)
  assert seen.dtype == np.float32
  latents = puppet.mode_set.latents
  np.testing.assert_allclose(seen[:20, 2:6], latents[[_LEAP] * 20], rtol=1e-6)
  np.testing.assert_allclose(seen[20:, 2:6], latents[[_LAUNCH] * 10], rtol=1e-6)
  # A mode that runs already goes on; a new one begins.
  phase = np.arctan2(seen[:, 0], seen[:, 1]) / (2 * np.pi) % 1
  duration = puppet.mode_set.motions[_LEAP].duration
  np.testing.assert_allclose(phase[:20], np.arange(20) * 0.03 / duration, 1e-5)
  assert phase[20] == 0.0


# --- What is seen.


def test_observation() -> None:
  env = _load('gap', policy='quickstart', time_limit=1.5)
  steps, _, qpos = _run(env, [_WALK, _WALK, _LEAP])
  first, second = steps[0].observation, steps[2].observation
  np.testing.assert_allclose(first['goal'], [2.0, 0.0, 0.0], atol=1e-9)
  np.testing.assert_array_equal(first['mode'], [1, 0, 0])
  np.testing.assert_allclose(first['height'], [0.5], atol=1e-9)
  np.testing.assert_allclose(first['clock'], [0.0, 1.0])
  # The gap reaches from 0.8 m to 1.25 m; rounding decides at its edges.
  np.testing.assert_array_equal(first['ground'][:15], 0.0)
  np.testing.assert_array_equal(first['ground'][16:24], reaching.GAP)
  np.testing.assert_array_equal(first['ground'][25:], 0.0)
  left = [step.observation['knots_left'] for step in steps]
  np.testing.assert_allclose(left, np.array([[1.0], [0.8], [0.6], [0.4]]))
  position, joints = qpos[19, :3], qpos[19, 7:]
  np.testing.assert_allclose(second['goal'], [2.0, 0.0, 0.5] - position)
  np.testing.assert_allclose(second['height'], position[2:])
  np.testing.assert_allclose(second['joints_pos'], joints)
  np.testing.assert_array_equal(second['mode'], [0, 1, 0])
  walk = _load_policy('quickstart').mode_set.motions[_WALK]
  angle = 2 * np.pi * 0.6 / walk.duration
  np.testing.assert_allclose(
    second['clock'], [np.sin(angle), np.cos(angle)], atol=1e-9
  )
  np.testing.assert_array_equal(steps[3].observation['mode'], [0, 0, 1])


def test_modes_have_names() -> None:
  env = _load('gap', policy='quickstart')
  assert env.mode_names == ('idle', 'walk_forward', 'leap_forward')
  assert env.action_spec().num_values == 3
  assert env.reward_spec().maximum == 10
  env.reset()
  env.step(env.mode_names.index('leap_forward'))
  assert env.task.mode == 'leap_forward'


def test_random_track_changes_from_episode_to_episode() -> None:
  env, same = (_load('parkour', policy=_Puppet()) for _ in range(2))
  goals = []
  for _ in range(3):
    first, other = env.reset(), same.reset()
    goals.append(tuple(env.goal))
    assert goals[-1] == tuple(same.goal)
    np.testing.assert_array_equal(
      first.observation['ground'], other.observation['ground']
    )
    # 0.3 m/s, 0.15 s a knot.
    assert env.knots == same.knots == round(env.goal[0] / 0.3 / 0.15)
  assert len(set(goals)) == 3


# --- What is no input.


@pytest.mark.parametrize(
  'action', [-1, 4, 1.0, True, 'idle', None, [1], np.array([0, 1])]
)
def test_no_action(action: Any) -> None:
  env = _load('gap', policy=_Puppet())
  env.reset()
  with pytest.raises(ValueError, match=r'index of a mode \(0 idle, 1 walk_for'):
    env.step(action)


@pytest.mark.parametrize('action', [1, np.int64(1), np.array(1, np.int32)])
def test_action(action: Any) -> None:
  env = _load('gap', policy=_Puppet())
  env.reset()
  env.step(action)
  assert env.task.mode == 'walk_forward'


def test_no_policy() -> None:
  with pytest.raises(FileNotFoundError, match="'pi9'.*pi2.*quickstart"):
    _load('gap', policy='pi9')
  with pytest.raises(TypeError, match='has no config, select_action'):
    _load('gap', policy=types.SimpleNamespace(mode_set=_Puppet.mode_set))
