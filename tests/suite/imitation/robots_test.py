"""Tests of the imitation task with a robot that is not the mini biped."""

import dataclasses
import pathlib
import re
from typing import Any, Callable

import mujoco
import numpy as np
import pytest

from dmc_multimode import suite
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import motion_costs
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import symmetry
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import schedule as schedules
from dmc_multimode.walkers import legs
from dmc_multimode.walkers import robot as robot_lib

_FOLDER = pathlib.Path(__file__).parents[2] / 'robots'
_TOLERANCE, _FLOAT32 = 1e-9, 1e-6
_STEPS = 60
_EXTRA = observations.EXTRA_NAMES


@pytest.fixture(scope='module')
def robot() -> robot_lib.Robot:
  return robot_lib.load(_FOLDER / 'four_legs.yaml')


@pytest.fixture(scope='module')
def modes() -> mode_set_lib.ModeSet:
  return mode_set_lib.one_hot(mode_files.load(_FOLDER / 'four_legs_modes.yaml'))


def _task(
  robot: robot_lib.Robot,
  modes: mode_set_lib.ModeSet,
  plan: schedule.ModeSchedule,
  **changes: Any,
) -> composer_task.Imitation:
  """Returns a task of a schedule, with every term of the observation."""
  config = task_config.for_robot(
    task_config.ImitationConfig(extra_observations=_EXTRA), robot
  )
  config = dataclasses.replace(config, **changes)
  return multimode_biped.make_task(
    modes, episodes.ScheduledEpisodes(plan), config=config
  )


def _switching(start: int) -> schedule.ModeSchedule:
  """Returns a schedule of one world: a mode, the other, and back."""
  return schedule.ModeSchedule(
    np.array([[start, 1 - start, start]]),
    np.array([[0.0, 0.4, 0.9]]),  # Seconds.
    np.ones(1),
  )


def test_configuration_follows_the_robot(robot: robot_lib.Robot) -> None:
  base, config = task_config.ImitationConfig(), multimode_biped.config_for(
    robot
  )  # fmt: skip
  assert (config.control_timestep, config.physics_timestep) == (0.02, 0.005)
  assert config.limits.distance == pytest.approx(0.35 * robot.size)
  assert config.limits.height == pytest.approx(0.22 * robot.size)
  # What costs half of the position's reward is in proportion as well.
  sensitivity = config.gains.position.sensitivity
  assert sensitivity == pytest.approx(5 / robot.size)
  assert task_config.for_robot(base, robot_lib.mini_biped()) == base
  assert task_config.evaluated(config).physics_timestep == 0.005
  longer = dataclasses.replace(base, physics_timestep=0.0075)
  # The longest that divides the robot's 20 ms.
  assert task_config.for_robot(longer, robot).physics_timestep == 0.02 / 3


def test_tasks_of_four_feet_take_a_robot(robot: robot_lib.Robot) -> None:
  env = suite.load(suite.DOMAIN, 'trot_forward', {'robot': robot, 'random': 0})
  assert env.reset().observation['joints_pos'].shape == (12,)
  with pytest.raises(ValueError, match='contacts of 4 feet, and the robot has'):
    suite.load(suite.DOMAIN, 'quadruped')


def test_visual_geoms_that_weigh_stay(robot: robot_lib.Robot) -> None:
  """Trainings need them, as bodies have no inertia of their own."""
  eye = '<geom size=".02" mass=".5" contype="0" conaffinity="0"/>'
  xml = robot.model.xml.replace('<freejoint />', f'<freejoint />{eye}')
  model = robot.model._replace(xml=xml)
  heavier = robot_lib.Robot(robot.declaration, model)
  masses = [
    mujoco_worlds.compile_model(
      multimode_biped.make_task(
        'quadruped', config=multimode_biped.config_for(each)
      )
    ).body_mass.sum()
    for each in (robot, heavier)
  ]
  assert masses[1] - masses[0] == pytest.approx(0.5)


def test_starts_mid_stride(robot: robot_lib.Robot) -> None:
  """Feet that stand are on the ground, those that swing over it."""
  pytest.importorskip('mink')
  config = multimode_biped.config_for(robot)
  sure = dataclasses.replace(config.events, reference_starts=1.0)
  config = dataclasses.replace(
    config, events=sure, joint_noise=0, tilt_noise=0, velocity_noise=0
  )
  task = multimode_biped.make_task('trot_forward', config=config)
  worlds = batched_env.BatchedImitation(task, 32, 0, 1)
  worlds.reset()
  model = worlds.physics.model
  data, soles = mujoco.MjData(model), []
  for qpos in worlds.physics.qpos:
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    soles.append(data.site_xpos[model.sensor_objid[:4], 2])
  heights = np.array(soles) - robot.derived.sole_depth
  contact = worlds.core.tracker.reference().contact > 0
  assert np.abs(heights[contact]).max() < 0.003
  assert heights[~contact].min() > -0.003 and heights.max() > 0.015
  assert np.abs(worlds.physics.qvel[:, 6:]).max() > 1


def test_configuration_round_trip(robot: robot_lib.Robot) -> None:
  config = multimode_biped.config_for(robot)
  values = task_config.to_dict(config)
  assert task_config.from_dict(values) == config
  assert values['robot']['digest'] == robot.digest
  assert 'robot' not in task_config.to_dict(task_config.ImitationConfig())
  summary = task_config.summary(config)['robot']
  assert summary == {'name': 'four_legs', 'digest': robot.digest}


def test_layout(robot: robot_lib.Robot) -> None:
  sizes = dict(observations.layout(2, True, _EXTRA, robot))
  assert (sizes['joints_pos'], sizes['joints_vel']) == (12, 12)
  assert (sizes['previous_action'], sizes['contact']) == (12, 4)
  assert observations.size(2, robot=robot) == 2 + 2 + 11 + 24


@pytest.mark.parametrize('start', [0, 1])
def test_both_engines_are_the_same(
  robot: robot_lib.Robot, modes: mode_set_lib.ModeSet, start: int
) -> None:
  task = _task(robot, modes, _switching(start), limits=terminations.NO_LIMITS)
  env = multimode_biped.make_environment(task, start, None)
  worlds = batched_env.BatchedImitation(task, 1, start, 1, auto_reset=False)
  time_step, observation = env.reset(), worlds.reset()
  random, stand = np.random.RandomState(0), worlds.standing_action()
  ran = set()
  for _ in range(_STEPS):
    seen = np.concatenate(list(time_step.observation.values()))
    np.testing.assert_allclose(observation[0], seen, _FLOAT32, _FLOAT32)
    qpos = env.physics.data.qpos
    np.testing.assert_allclose(worlds.qpos[0], qpos, atol=_TOLERANCE)
    np.testing.assert_array_equal(task.core.contact, worlds.core.contact)
    action = stand + random.uniform(-0.3, 0.3, 12)
    time_step, step = env.step(action), worlds.step(action[None])
    observation = step.observation
    assert step.reward[0] == pytest.approx(time_step.reward, abs=_TOLERANCE)
    ran.add(int(worlds.core.tracker.state.mode[0]))
  assert ran == {0, 1}
  assert (worlds.core.contact.shape, time_step.reward > 0) == ((1, 4), True)


def test_it_stands_and_counts_its_feet(
  robot: robot_lib.Robot, modes: mode_set_lib.ModeSet
) -> None:
  plan = schedule.single(np.zeros(4, dtype=np.int64))
  task = _task(robot, modes, plan, events=events.NONE)
  worlds = batched_env.BatchedImitation(task, 4, 0, 1, auto_reset=False)
  worlds.reset()
  action = np.tile(worlds.standing_action(), (4, 1))
  rewards = []
  for _ in range(100):
    step = worlds.step(action)
    assert not step.last.any()
    rewards.append(step.reward)
  assert np.min(rewards[20:]) > 0.85
  np.testing.assert_array_equal(worlds.feet_contact(), np.ones((4, 4)))
  clearance = worlds.core.clearance(worlds.physics.soles())
  np.testing.assert_allclose(clearance, 0.0, atol=2e-3)
  np.testing.assert_allclose(worlds.measure()['reference_contact'], 1.0)


def test_starts_without_mink_are_in_the_standing_pose(
  robot: robot_lib.Robot,
  modes: mode_set_lib.ModeSet,
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  monkeypatch.setattr(legs, 'find', lambda robot: None)
  plan = schedule.single(np.ones(64, dtype=np.int64))
  started = events.TrainingEvents(reference_starts=1.0)
  task = _task(robot, modes, plan, events=started)
  worlds = batched_env.BatchedImitation(task, 64, 0, 1)
  worlds.reset()
  off = worlds.qpos[:, 7:] - robot.derived.pose
  assert off.std() == pytest.approx(task.config.joint_noise, rel=0.2)
  assert worlds.qpos[:, 2].min() >= robot.stand_height
  # Half to all of the trot's speed, 0.3 m/s.
  assert 0.15 < worlds.qvel[:, 0].mean() < 0.3
  assert np.ptp(worlds.core.tracker.state.phase) > 0.8


def test_mirrored_worlds_move_as_mirror_images(
  robot: robot_lib.Robot, modes: mode_set_lib.ModeSet
) -> None:
  plan = schedule.single(np.zeros(2, dtype=np.int64))
  task = _task(
    robot, modes, plan, events=events.NONE, limits=terminations.NO_LIMITS
  )
  worlds = batched_env.BatchedImitation(
    task, 2, 0, 1, auto_reset=False, privileged=True
  )
  worlds.reset()
  image = worlds.mirror_image()
  expected = symmetry.mirror_image(modes, True, _EXTRA, robot)
  for mine, other in zip(image, expected, strict=True):
    np.testing.assert_array_equal(mine, other)
  order, signs = image.action_order, image.action_signs
  axial = np.array([1, -1, 1, -1, 1, -1])
  worlds.qpos[1] = worlds.qpos[0]
  worlds.qpos[1, [1, 4, 6]] *= -1  # y; the quaternion's x and z.
  worlds.qpos[1, 7:] = signs * worlds.qpos[0, 7:][order]
  worlds.qvel[1, :6] = axial * worlds.qvel[0, :6]
  worlds.qvel[1, 6:] = signs * worlds.qvel[0, 6:][order]
  worlds.core.actions[1] = signs * worlds.core.actions[0][:, order]
  worlds.core.tracker.state.anchor[:] *= [1, 0, 1]
  random, stand = np.random.RandomState(1), worlds.standing_action()
  clock = observations.part('clock', 2, robot=robot)
  for _ in range(10):
    action = stand + random.uniform(-0.2, 0.2, 12)
    step = worlds.step(np.stack([action, signs * action[order]]))
    one, other = step.observation
    mirrored = image.observation_signs * one[image.observation_order]
    # Both modes are their own images; the clock's depends on the mode.
    mirrored[clock] = one[clock]
    np.testing.assert_allclose(other, mirrored, atol=1e-4)


def test_training_events_and_costs(
  robot: robot_lib.Robot, modes: mode_set_lib.ModeSet
) -> None:
  """Everything that a training may have runs with four feet."""
  everything = events.TrainingEvents(
    contact_bonus=schedules.constant(0.3),
    push_speed=schedules.constant(0.2),
    obstacles=schedules.constant(0.5),
    sensor_noise=schedules.constant(1.0),
    costs=motion_costs.QUIET,
    disturbances=disturbances.RANDOMISED,
  )
  task = _task(robot, modes, _switching(1), events=everything)
  task.episodes = episodes.TransitionEpisodes(modes)
  worlds = batched_env.BatchedImitation(task, 16, 0, 1, privileged=True)
  worlds.reset()
  stand = np.tile(worlds.standing_action(), (16, 1))
  steps = [worlds.step(stand) for _ in range(60)]
  assert all(np.isfinite(step.observation).all() for step in steps)
  assert any(step.last.any() for step in steps)
  saved = worlds.state()
  expected = worlds.step(stand)
  worlds.restore(saved)
  again = worlds.step(stand)
  np.testing.assert_array_equal(expected.observation, again.observation)
  np.testing.assert_array_equal(expected.reward, again.reward)


def test_modes_of_other_feet_are_refused(robot: robot_lib.Robot) -> None:
  with pytest.raises(ValueError, match='idle has contacts of 2 feet, and the'):
    multimode_biped.make_modes_task('pi2', robot=robot)


def test_another_robots_walker_is_refused(
  robot: robot_lib.Robot, modes: mode_set_lib.ModeSet
) -> None:
  task = _task(robot, modes, _switching(0))
  with pytest.raises(ValueError, match='The walker is four_legs'):
    composer_task.Imitation(task.walker, task.root_entity, modes, task.episodes)


def test_robot_and_config_must_agree(robot: robot_lib.Robot) -> None:
  config = multimode_biped.config_for(robot)
  assert multimode_biped.config_for(robot, config) is config
  assert multimode_biped.config_for(None, config) is config
  with pytest.raises(ValueError, match='the config is of the robot mini_biped'):
    multimode_biped.config_for(robot, task_config.ImitationConfig())


# Attributes of the model, and the power of the size that they grow with, for a
# robot that moves alike: times grow with its root.
_POWERS = {
  'pos': 1,
  'fromto': 1,
  'size': 1,
  'mass': 3,
  'diaginertia': 5,
  'armature': 5,
  'damping': 4.5,
  'frictionloss': 4,
  'kp': 4,
  'kv': 4.5,
  'forcerange': 4,
}


def _scaled(factor: float) -> Callable[[re.Match[str]], str]:
  """Returns a replacement of the numbers of an attribute."""

  def replacement(found: re.Match[str]) -> str:
    numbers = (f'{factor * float(n):.9g}' for n in found[2].split())
    return found[1] + ' '.join(numbers)

  return replacement


def _small_biped(folder: pathlib.Path, size: float) -> robot_lib.Robot:
  """Returns a mini biped of another size, in files of its own."""
  source = robot_lib.resources.path('xml', 'mini_biped.xml').parent
  text = (source / 'mini_biped.xml').read_text()
  for name, power in _POWERS.items():
    text = re.sub(rf'(\b{name}=")([^"]+)', _scaled(size**power), text)
  (folder / 'small.xml').write_text(text)
  declared = (source / 'mini_biped.yaml').read_text()
  declared = declared.replace('model: mini_biped', 'model: small')
  path = folder / 'small.yaml'
  path.write_text(declared.replace('name: mini_biped', 'name: small'))
  return robot_lib.load(path)


def test_library_modes_of_a_small_biped(tmp_path: pathlib.Path) -> None:
  small = _small_biped(tmp_path, 0.64)
  mini = robot_lib.mini_biped().derived
  assert small.stand_height == 0.32
  assert small.derived.mass == pytest.approx(mini.mass * 0.64**3)
  # Angles do not know of sizes.
  np.testing.assert_allclose(
    small.derived.standing_action, mini.standing_action, atol=1e-6
  )
  task = multimode_biped.make_modes_task('pi_all', robot=small)
  launch = task.mode_set.motions[task.mode_set.index('launch')]
  assert launch.duration == pytest.approx(1.1 * 0.8)
  assert launch.ledge and launch.ledge.height == pytest.approx(0.4 * 0.64)
  worlds = batched_env.BatchedImitation(task, 32, 0, 1)
  worlds.reset()
  action = np.tile(worlds.standing_action(), (32, 1))
  steps = [worlds.step(action) for _ in range(40)]
  assert all(np.isfinite(step.observation).all() for step in steps)
  tops = worlds.core.terrain.tops
  known = 0.4 * 0.64 * np.array([-1.0, 0.0, 1.0])
  assert np.isclose(tops[..., None], known).any(axis=-1).all()


def test_a_named_robot_of_the_mini_bipeds_is_the_default() -> None:
  path = robot_lib.resources.path('xml', 'mini_biped.yaml')
  env = multimode_biped.imitation('idle', random=0, robot=path)
  other = multimode_biped.imitation('idle', random=0)
  one, two = env.reset().observation, other.reset().observation
  for name in two:
    np.testing.assert_array_equal(one[name], two[name])
  assert env.task.config == other.task.config
  assert library.mode_set('idle').bank.num_feet == 2
