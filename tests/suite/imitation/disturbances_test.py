"""Tests of dmc_multimode.suite.imitation.disturbances."""

import dataclasses

import mujoco
import numpy as np
import pytest

from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import schedule


def _worlds(
  num_worlds: int = 2, sensor_noise: float = 0.0, **fixed: float
) -> batched_env.BatchedImitation:
  task = config.ImitationConfig(
    events=dataclasses.replace(
      events.NONE,
      disturbances=disturbances.NOMINAL.fixed(**fixed),
      sensor_noise=schedule.constant(sensor_noise),
    )
  )
  worlds = batched_env.BatchedImitation(
    multimode_biped.make_task('idle', config=task), num_worlds, 0, 1
  )
  worlds.reset()
  return worlds


@pytest.mark.parametrize(
  ('delay', 'targets'),
  [
    # Physics steps of 10 ms, three a control step; actions 3, 2, 1 of late.
    (0.0, [3, 3, 3]),
    (0.01, [2, 3, 3]),
    (0.024, [2, 2, 3]),
    (0.03, [2, 2, 2]),
    (0.05, [1, 1, 2]),
  ],
)
def test_delayed(delay: float, targets: list[int]) -> None:
  actions = np.array([[[3.0], [2.0], [1.0]]])
  found = disturbances.delayed(actions, np.array([delay]), 0.01, 3)
  np.testing.assert_array_equal(found[0, :, 0], targets)


def test_draws_within_ranges_and_share() -> None:
  ranges = dataclasses.replace(
    disturbances.RANDOMISED, slope=(0.0, 0.0), friction=(0.4, 0.4)
  )
  random_state = np.random.RandomState(0)
  for share in (0.0, 0.5, 1.0):
    drawn = disturbances.draw(ranges, share, 4000, random_state)
    for row in dataclasses.fields(disturbances.Disturbances):
      nominal = row.metadata['nominal']
      low, high = (
        nominal + share * (end - nominal) for end in getattr(ranges, row.name)
      )
      values = drawn[row.name]
      assert low - 1e-12 <= values.min() and values.max() <= high + 1e-12
      slack = 0.01 * (high - low)
      assert np.ptp(values) >= high - low - slack
  some = disturbances.draw(ranges, 1.0, 4000, random_state, fraction=0.25)
  assert np.mean(some['friction'] != 0.9) == pytest.approx(0.25, abs=0.03)
  assert disturbances.NOMINAL.active == ()
  before = random_state.get_state(legacy=False)
  disturbances.draw(disturbances.NOMINAL, 1.0, 9, random_state)
  after = random_state.get_state(legacy=False)
  assert after['state']['pos'] == before['state']['pos']


def test_body_by_hand() -> None:
  worlds = _worlds(
    friction=0.4, mass=1.1, payload=2.0, centre_of_mass=0.01, motor_strength=0.8
  )
  nominal, model = worlds.physics.model, worlds.physics.batch.get_model(1)
  trunk = nominal.body('walker/trunk').id
  mass = 1.1 * nominal.body_mass
  mass[trunk] += 2.0
  np.testing.assert_allclose(model.body_mass, mass)
  robot = 1.1 * nominal.body_subtreemass[trunk] + 2.0
  np.testing.assert_allclose(model.body_subtreemass[trunk], robot)
  np.testing.assert_allclose(model.body_ipos[trunk, 0], 0.01)
  np.testing.assert_allclose(model.geom_friction[:, 0], 0.4)
  np.testing.assert_allclose(model.geom_friction[-1, 1:], [0.005, 1e-4])
  np.testing.assert_allclose(model.actuator_gainprm[:, 0], 24)
  np.testing.assert_allclose(model.actuator_biasprm[:, 1:3], [[-24, -0.4]] * 10)
  np.testing.assert_allclose(model.actuator_forcerange, [[-24, 24]] * 10)
  assert nominal.body_subtreemass[trunk] == pytest.approx(14.05, abs=0.1)


def test_delay_and_slope_act_in_the_physics() -> None:
  nominal, late, tilted = (
    _worlds(1, **fixed)
    for fixed in ({}, {'action_delay': 0.03}, {'slope': 0.2})
  )
  np.testing.assert_allclose(
    tilted.physics.batch.get_model(0).opt.gravity,
    9.81 * np.array([-np.sin(0.2), 0.0, -np.cos(0.2)]),
  )
  # A whole control step late, the first action is the initial angles.
  first = late.core.actions[:, 0].copy()
  action = nominal.standing_action()[None] + 0.1
  late.step(action)
  nominal.step(first)
  np.testing.assert_allclose(late.qpos, nominal.qpos, atol=1e-12)
  late.step(action)
  nominal.step(action)
  np.testing.assert_allclose(late.qpos, nominal.qpos, atol=1e-12)


def test_state_holds_disturbances_and_sensor_errors() -> None:
  ranges = dataclasses.replace(disturbances.RANDOMISED, slope=(-0.1, 0.1))
  task = config.ImitationConfig(
    events=dataclasses.replace(
      events.NONE,
      disturbances=ranges,
      sensor_noise=schedule.constant(1.0),
    )
  )
  worlds, other = (
    batched_env.BatchedImitation(
      multimode_biped.make_task('pi2', config=task), 6, seed, 1
    )
    for seed in (0, 1)
  )
  worlds.reset()
  other.reset()
  actions = np.tile(worlds.standing_action(), (6, 1))
  for _ in range(20):
    step = worlds.step(actions)
  np.testing.assert_array_equal(other.restore(worlds.state()), step.observation)
  for _ in range(40):
    one, two = worlds.step(actions), other.step(actions)
    np.testing.assert_array_equal(one.observation, two.observation)
  assert one.results.worlds.size or worlds.core.tracker.state.step.min() < 60


def test_sensor_noise_has_the_declared_deviation() -> None:
  plain, noisy = _worlds(500), _worlds(500, sensor_noise=2.0)
  assert not plain._noisy
  errors = noisy._sensor_errors.std(axis=0)
  np.testing.assert_allclose(errors, 2.0 * noisy._errors.noise, rtol=0.15)


def test_odometry_error_by_hand() -> None:
  travelled = np.array([[3.0, 4.0], [0.0, -2.0], [1.0, 0.0]])
  error = disturbances.odometry_error(travelled, np.array([1.0, -1.0, 0.0]))
  turn, back = np.deg2rad(2.5), np.deg2rad(-1.0)
  expected = [
    [
      1.02 * (3 * np.cos(turn) - 4 * np.sin(turn)) - 3,
      1.02 * (3 * np.sin(turn) + 4 * np.cos(turn)) - 4,
    ],
    [0.98 * 2 * np.sin(back), -0.98 * 2 * np.cos(back) + 2],
    [0.0, 0.0],
  ]
  np.testing.assert_allclose(error, expected, atol=1e-12)


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'friction': (1.0, 0.5)}, 'a range is LOW,HIGH, got 1.0,0.5'),
    ({'action_delay': (-0.01, 0.0)}, 'action_delay is at least 0'),
    ({'action_delay': (0.0, 0.5)}, 'action_delay is at most 0.3 s'),
    ({'slope': (0.0, 1.0)}, 'slope is between'),
    ({'mass': (0.0, 1.0)}, 'mass is at least 0.1'),
  ],
)
def test_rejects(changes: dict[str, tuple[float, float]], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    disturbances.Disturbances(**changes)


def test_model_of_another_mass_is_a_model_of_that_mass() -> None:
  """The derived constants are those of a model compiled with the payload."""
  worlds = _worlds(payload=1.5)
  model = worlds.physics.batch.get_model(0)
  expected = worlds.physics.model
  trunk = expected.body('walker/trunk').id
  expected.body_mass[trunk] += 1.5
  mujoco.mj_setConst(expected, mujoco.MjData(expected))
  np.testing.assert_allclose(model.dof_invweight0, expected.dof_invweight0)


def test_parity_of_the_engines() -> None:
  """The same draws, and the same motion, in Composer and in the batch."""
  task_config = config.ImitationConfig(
    events=dataclasses.replace(
      events.NONE,
      disturbances=dataclasses.replace(
        disturbances.RANDOMISED,
        slope=(-0.1, 0.1),
        action_delay=(0.0, 0.05),
        odometry_drift=(-1.0, 1.0),
      ),
      push_speed=schedule.constant(1.0),
      push_interval=0.1,
      sensor_noise=schedule.constant(1.0),
    ),
    limits=terminations.NO_LIMITS,
    extra_observations=observations.EXTRA_NAMES,
  )
  task = multimode_biped.make_task('idle', config=task_config)
  env = multimode_biped.make_environment(task, 5)
  worlds = batched_env.BatchedImitation(task, 1, 5, 1, auto_reset=False)
  random_state = np.random.RandomState(0)
  for _ in range(2):  # Episodes; the second has another robot.
    env.reset()
    worlds.reset()
    for _ in range(15):
      action = random_state.uniform(-0.4, 0.4, 10)
      step = env.step(action)
      batch = worlds.step(action[None])
      np.testing.assert_allclose(
        env.physics.data.qpos, worlds.qpos[0], atol=1e-9
      )
      seen = np.concatenate(list(step.observation.values()))
      np.testing.assert_allclose(seen, batch.observation[0], atol=1e-5)
