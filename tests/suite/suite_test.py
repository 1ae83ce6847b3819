"""Tests of dmc_multimode.suite: one contract for every registered task."""

import types
from typing import Any, Iterator

from absl.testing import absltest
from absl.testing import parameterized
from dm_control import suite as dm_suite
import dm_env
from dm_env import specs
from dm_env import test_utils
import numpy as np

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


class ContractTest(parameterized.TestCase):
  """dm_control's checks of its own suite, of every task of ours."""

  @parameterized.parameters(*_TASKS)
  def test_task(self, task: str) -> None:
    env, same = _load(task), _load(task)
    self._check_model(env)
    parts, firsts = env.observation_spec(), []
    self._check_actions(env.action_spec())
    # A step is worth at most 1, or that for each control step in it.
    highest = env.control_timestep() / env.task.control_timestep
    steps = zip(_trajectory(env), _trajectory(same), strict=True)
    for time_step, other in steps:
      self._check_step(time_step, parts, highest)
      self._assert_equal(time_step, other)
      if time_step.first():
        firsts.append(time_step.observation)
    self.assertFalse(  # Initial states are random.
      all(np.array_equal(firsts[0][name], firsts[1][name]) for name in parts)
    )

  def _check_actions(self, spec: Any) -> None:
    self.assertIsInstance(spec, specs.BoundedArray)
    is_mode = isinstance(spec, specs.DiscreteArray)
    self.assertEqual(spec.shape, () if is_mode else (10,))

  def _check_model(self, env: dm_env.Environment) -> None:
    model = env.physics.model
    self.assertGreaterEqual(model.ncam, 2)
    for kind, count in (
      ('body', model.nbody),
      ('joint', model.njnt),
      ('geom', model.ngeom),
      ('actuator', model.nu),
      ('sensor', model.nsensor),
      ('camera', model.ncam),
    ):
      for i in range(count):
        self.assertNotEmpty(model.id2name(i, kind))

  def _check_step(
    self, time_step: dm_env.TimeStep, parts: Any, highest: float
  ) -> None:
    self.assertEqual(list(time_step.observation), list(parts))
    for name, value in time_step.observation.items():
      parts[name].validate(value)
      self.assertTrue(np.isfinite(value).all(), name)
    if not time_step.first():
      self.assertIsInstance(time_step.reward, float)
      self.assertBetween(time_step.reward, 0.0, highest)
      self.assertIn(time_step.discount, (0.0, 1.0))

  def _assert_equal(self, one: dm_env.TimeStep, other: dm_env.TimeStep) -> None:
    self.assertEqual(one[:3], other[:3])
    for name, value in one.observation.items():
      np.testing.assert_array_equal(value, other.observation[name])

  @parameterized.parameters('idle', 'pi2', 'reach_gap')
  def test_seeds_differ(self, task: str) -> None:
    observed = [
      _load(task, seed).reset().observation['joints_pos'] for seed in (0, 1)
    ]
    self.assertFalse(np.array_equal(*observed))

  @parameterized.parameters('idle', 'pi2', 'reach_gap')
  def test_observations_share_no_memory(self, task: str) -> None:
    env = _load(task)
    first = env.reset().observation
    second = env.step(env.action_spec().generate_value()).observation
    for name, value in first.items():
      self.assertFalse(np.may_share_memory(value, second[name]), name)

  def test_observation_is_the_papers(self) -> None:
    sizes = {
      name: spec.shape for name, spec in _load('pi2').observation_spec().items()
    }
    self.assertEqual(
      list(sizes.items()),
      [
        ('clock', (2,)),
        ('command', (4,)),
        ('height', (1,)),
        ('orientation', (4,)),
        ('joints_pos', (10,)),
        ('velocity', (3,)),
        ('angular_velocity', (3,)),
        ('joints_vel', (10,)),
      ],
    )


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


class TasksTest(parameterized.TestCase):
  def test_every_mode_and_set_has_a_task(self) -> None:
    reach = tuple(f'reach_{track}' for track in reaching.TRACKS)
    self.assertEqual(
      _TASKS, (*library.modes(), 'pi1', 'pi2', 'pi3', 'pi_all', *reach)
    )

  @parameterized.parameters(*library.modes())
  def test_single_mode_is_commanded(self, mode: str) -> None:
    env = _load(mode)
    env.reset()
    env.step(np.zeros(10))
    self.assertEqual(env.task.mode, mode)
    np.testing.assert_allclose(
      env.task.core.tracker.commands(),
      library.codebook().subset([mode]).latents,
    )

  def test_sets_command_all_their_modes(self) -> None:
    env, seen = _load('pi2'), set()
    for _ in range(40):
      env.reset()
      seen.add(env.task.mode)
    self.assertEqual(seen, set(library.SETS['pi2']))

  def test_only_pi3_is_paid_for_contacts(self) -> None:
    weights = {
      name: _load(name).task.config.gains.contact_weight
      for name in ('idle', 'pi1', 'pi2', 'pi3')
    }
    self.assertEqual(weights, {'idle': 0.0, 'pi1': 0.0, 'pi2': 0.0, 'pi3': 0.3})

  def test_default_time_limit(self) -> None:
    env = suite.load(_DOMAIN, 'idle')
    self.assertEqual(env.task.config.time_limit, 4.5)

  @parameterized.product(
    task=('idle', 'reach_gap'), seconds=(0.0, -1.0, np.inf, np.nan)
  )
  def test_rejects_time_limit(self, task: str, seconds: float) -> None:
    with self.assertRaisesRegex(ValueError, 'time_limit'):
      suite.load(_DOMAIN, task, {'time_limit': seconds})

  @parameterized.product(task=('idle', 'reach_gap'), visualize=(False, True))
  def test_visualize_reward(self, task: str, visualize: bool) -> None:
    env = _load(task, visualize_reward=visualize)
    self.assertEqual(env.task.visualize_reward, visualize)
    env.reset()
    env.step(env.action_spec().generate_value())

  def test_environment_kwargs(self) -> None:
    env = _load(
      'idle', environment_kwargs={'strip_singleton_obs_buffer_dim': False}
    )
    self.assertEqual(env.observation_spec()['clock'].shape, (1, 2))


class RegistryTest(parameterized.TestCase):
  def test_dm_control_loads_it(self) -> None:
    env = dm_suite.load(_DOMAIN, 'walk_forward', {'random': 0})
    env.reset()
    self.assertBetween(env.step(np.zeros(10)).reward, 0.0, 1.0)

  def test_dm_control_lists_it(self) -> None:
    ours = {(_DOMAIN, task) for task in _TASKS}
    self.assertContainsSubset(ours, dm_suite.ALL_TASKS)
    self.assertEqual(set(dm_suite.TASKS_BY_DOMAIN[_DOMAIN]), set(_TASKS))
    self.assertContainsSubset(ours, dm_suite.EXTRA + dm_suite.BENCHMARKING)
    self.assertContainsSubset(ours, dm_suite.EASY + dm_suite.HARD)
    self.assertIn((_DOMAIN, 'idle'), dm_suite.EASY)
    self.assertIn((_DOMAIN, 'pi1'), dm_suite.HARD)
    self.assertIn((_DOMAIN, 'reach_gap'), dm_suite.HARD)
    self.assertIn(('cartpole', 'swingup'), dm_suite.BENCHMARKING)
    self.assertIn(('walker', 'walk'), dm_suite.ALL_TASKS)
    count = sum(len(tasks) for tasks in dm_suite.TASKS_BY_DOMAIN.values())
    self.assertLen(dm_suite.ALL_TASKS, count)

  def test_dm_controls_benchmark_keeps_its_rule(self) -> None:
    """Its own test wants actions in [-1, 1] of the tasks in it."""
    self.assertNotIn(_DOMAIN, {domain for domain, _ in dm_suite.BENCHMARKING})

  def test_registering_twice_is_harmless(self) -> None:
    before = {name: getattr(dm_suite, name) for name in _FROZEN}
    suite.register()
    for name, tasks in before.items():
      self.assertEqual(getattr(dm_suite, name), tasks)

  def test_clash_is_an_error(self) -> None:
    stranger = types.ModuleType('stranger')
    domains = {**dm_suite._DOMAINS, _DOMAIN: stranger}
    with absltest.mock.patch.object(dm_suite, '_DOMAINS', domains):
      with self.assertRaisesRegex(ValueError, 'already has a domain'):
        suite.register()
      self.assertIs(domains[_DOMAIN], stranger)

  def test_unknown_task(self) -> None:
    with self.assertRaisesRegex(ValueError, "'fly'.*idle, walk_forward"):
      suite.load(_DOMAIN, 'fly')
    with self.assertRaisesRegex(ValueError, 'fly'):
      dm_suite.load(_DOMAIN, 'fly')

  def test_unknown_domain(self) -> None:
    with self.assertRaisesRegex(ValueError, 'centipede'):
      suite.load('centipede', 'walk')

  def test_other_domains_load_as_ever(self) -> None:
    env = suite.load('cartpole', 'balance', {'random': 0})
    self.assertTrue(env.reset().first())


if __name__ == '__main__':
  absltest.main()
