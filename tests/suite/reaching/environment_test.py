"""Tests of dmc_multimode.suite.reaching.environment, beside the contract."""

import functools
import types
from typing import Any

from dm_control import composer
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


def _load(name: str, **kwargs: Any) -> Any:
  """The registered task with a seed; a puppet keeps standing in it."""
  env = suite.load('multimode_biped', f'reach_{name}', {'random': 3, **kwargs})
  if isinstance(puppet := kwargs.get('policy'), _Puppet):
    puppet.action = mini_biped.standing_action(env.physics.model.ptr)
  return env


def _run(env: Any, plan: list[int]) -> tuple[list[dm_env.TimeStep], np.ndarray]:
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
  return steps, np.array(path)


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


# --- It is the planner's problem.


def _assert_alike(
  env: Any,
  policy: pretrained.Policy,
  arena: str,
  config: reaching.ReachingConfig,
  plan: list[int],
) -> None:
  """Path, rewards and success are those of the planner's problem, exactly."""
  steps, qpos = _run(env, plan)
  problem = problem_lib.ReachingProblem(policy, track.make(arena), config, 1, 1)
  found = problem.rollout(np.array([plan]))
  np.testing.assert_array_equal(qpos[:, :3], found.paths[0, : len(qpos)])
  rewards = [step.reward for step in steps[1:]]
  assert sum(rewards) == pytest.approx(found.returns[0], abs=1e-12)
  # The planner's goes on after a fall, for nothing.
  fell = steps[-1].discount == 0.0
  assert fell or len(qpos) == found.paths.shape[1] - 50  # Without the rest.


def test_what_a_planner_rolls_out() -> None:
  """On flat ground, where launch puts a block where it needs one."""
  policy, plan = _load_policy('pi2'), [_WALK, *[_LAUNCH] * 4, _WALK]
  config = reaching.ReachingConfig((0.8, 0.0, 0.5), len(plan), seed=5)
  task = multimode_biped.make_task(
    policy.mode_set,
    episodes.ScheduledEpisodes(schedule.single(np.zeros(1))),
    'flat',
    reaching.task_config(policy, config),
  )
  inner = multimode_biped.make_environment(
    task, config.seed, {'time_limit': np.inf}
  )
  env = reaching_env.ReachingEnvironment(inner, policy, lambda _: config)
  _assert_alike(env, policy, 'flat', config, plan)
  assert env.task.root_entity.terrain.tops.max() == 0.4


@pytest.mark.parametrize('name', reaching.TRACKS)
def test_registered_tasks_are_what_planners_get(name: str) -> None:
  config = reaching.random_problem(3, name)
  if name in reaching.PROBLEMS:
    assert config == reaching.PROBLEMS[name].config(3)
  env, random = _load(name), np.random.RandomState(1)
  plan = random.randint(4, size=config.knots).tolist()
  _assert_alike(env, _load_policy('pi2'), name, config, plan)
  assert (tuple(env.goal), env.knots) == (config.goal, config.knots)
  assert env.control_timestep() == config.knot_duration


# --- A knot.


def test_reward_is_of_every_control_step_until_a_fall() -> None:
  env = _load('gap', policy='quickstart')
  steps, qpos = _run(env, [_WALK] * env.knots)
  assert [step.discount for step in steps[1:]] == [1.0] * (len(steps) - 2) + [0]
  assert len(steps) - 1 < env.knots
  assert qpos[-1, 2] < 0.22 <= qpos[-2, 2]
  # What comes before the fall in its knot is paid for, the fall is not.
  worth = np.exp(-np.linalg.norm(qpos[:, :3] - [2.0, 0.0, 0.5], axis=1))
  worth[-1] = 0.0
  for i, step in enumerate(steps[1:]):
    assert step.reward == pytest.approx(worth[10 * i : 10 * i + 10].sum())
  assert not env.reached
  assert env.step(_IDLE).first()


def test_last_knot_ends_the_episode() -> None:
  env = _load('gap', time_limit=0.7, policy=_Puppet())
  assert env.knots == 2
  for _ in range(2):
    assert env.reset().first()
    middle, last, again = (env.step(_IDLE) for _ in range(3))
    assert middle.mid()
    assert last.last()
    assert last.discount == 1.0
    assert again.first()


def test_policy_acts_on_a_new_command_as_soon_as_it_stands() -> None:
  puppet = _Puppet()
  env = _load('gap', policy=puppet)
  env.reset()
  for mode in (_LEAP, _LEAP, _LAUNCH):
    env.step(mode)
  seen = np.concatenate(puppet.seen)
  assert seen.shape == (30, 37)
  assert seen.dtype == np.float32
  latents = puppet.mode_set.latents
  # The launch is commanded in mid-leap, which lands after 0.84 s.
  modes = [_LEAP] * 28 + [_LAUNCH] * 2
  np.testing.assert_allclose(seen[:, 2:6], latents[modes], rtol=1e-6)
  # A mode that runs already goes on; a new one begins.
  phase = np.arctan2(seen[:, 0], seen[:, 1]) / (2 * np.pi) % 1
  duration = puppet.mode_set.motions[_LEAP].duration
  np.testing.assert_allclose(phase[:28], np.arange(28) * 0.03 / duration, 1e-5)
  assert phase[28] == 0.0


# --- What is seen.


def test_observation() -> None:
  env = _load('gap', policy='quickstart', time_limit=1.5)
  assert env.mode_names == ('idle', 'walk_forward', 'leap_forward')
  assert env.action_spec().num_values == 3
  assert env.reward_spec().maximum == 10
  steps, qpos = _run(env, [_WALK, _WALK, _LEAP])
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


def test_track_of_other_sizes() -> None:
  sizes = {'difficulty': 0.9, 'length': 6.0}
  env = _load('obstacle_course', random=2, policy=_Puppet(), sizes=sizes)
  env.reset()
  config = reaching.random_problem(2, 'obstacle_course', sizes)
  assert (tuple(env.goal), env.knots) == (config.goal, config.knots)
  assert env.most_knots is None
  assert _load('stairs', policy=_Puppet()).most_knots == 56  # 2.5 m.
  with pytest.raises(ValueError, match="no size 'depth'"):
    _load('obstacle_course', policy=_Puppet(), sizes={'depth': 1.0})


# --- What is no input.


def test_action_is_a_mode() -> None:
  env = _load('gap', policy=_Puppet())
  env.reset()
  wrong_ones = (-1, 4, 3.4, -0.1, np.nan, True, 'idle', None, [1], np.zeros(2))
  for wrong in wrong_ones:
    with pytest.raises(ValueError, match=r'a mode \(0 idle, 1 walk_for'):
      env.step(wrong)
  # Floating-point numbers are what dm_control's policies have for every task.
  for right in (1, np.int64(1), np.array(1, np.int32), 1.0, np.float32(0.6)):
    env.step(right)
    assert env.task.mode == 'walk_forward'


def test_is_wrapped_and_seeded_as_composer_environments_are() -> None:
  env = _load('gap', policy=_Puppet())
  assert isinstance(env._env, composer.Environment)
  firsts = []
  for seed in (7, 7, 8):
    env._random_state = np.random.RandomState(seed)  # As shimmy does.
    firsts.append(env.reset().observation['joints_pos'])
  assert env.random_state is env._env.random_state
  np.testing.assert_array_equal(firsts[0], firsts[1])
  assert not np.array_equal(firsts[0], firsts[2])
  assert not hasattr(env, 'no_such_name')


def test_no_policy() -> None:
  with pytest.raises(FileNotFoundError, match="'pi9'.*pi2.*quickstart"):
    _load('gap', policy='pi9')
  with pytest.raises(TypeError, match='has no config, select_action'):
    _load('gap', policy=types.SimpleNamespace(mode_set=_Puppet.mode_set))
