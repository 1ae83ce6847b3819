"""Tests of dmc_multimode.walkers.mini_biped and of xml/mini_biped.xml."""

from typing import Any

from dm_control import composer
from dm_control.locomotion.arenas import floors
import mujoco
import numpy as np
import pytest

from dmc_multimode.walkers import mini_biped

_STRAIGHT = np.radians([0.0, 0.0, -54.0, 108.0, -54.0] * 2)
_STAND_HEIGHT = 0.5  # Metres.
_WEIGHT = 14.046 * 9.81  # Newtons.
_SWAPPED = np.r_[5:10, 0:5]  # Left joints for right ones.


def _model(
  joint: str = 'free', ground: bool = True, plane: bool = False
) -> mujoco.MjModel:
  """Compiles the robot on a box whose top is at z = 0.

  Args:
    joint: between trunk and world: 'free', or 'lift' (up and down only).
    ground: whether there is the box.
    plane: whether there is a plane at z = 0 too.
  """
  arena = composer.Arena()
  root = arena.mjcf_model
  root.option.timestep = 0.005
  root.option.integrator = 'implicitfast'
  # An arena's no-slip iterations depend on the order of the contacts.
  root.option.cone, root.option.noslip_iterations = 'pyramidal', 0
  if ground:
    root.worldbody.add(
      'geom',
      name='ground',
      type='box',
      size=[5, 3, 0.5],
      pos=[0, 0, -0.5],
      friction=[0.9, 0.005, 0.0001],
    )
  if plane:
    root.worldbody.add('geom', name='plane', type='plane', size=[5, 5, 1])
  walker = mini_biped.MiniBiped()
  frame = arena.attach(walker)
  if joint == 'free':
    walker.create_root_joints(frame)
  else:
    frame.pos = [0, 0, _STAND_HEIGHT]
    frame.add('joint', name='lift', type='slide', axis=[0, 0, 1])
  return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def _lowest_sole(model: mujoco.MjModel, data: mujoco.MjData) -> float:
  """Returns the height of the lowest corner of both soles, metres."""
  corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)
  heights = []
  for side in mini_biped.SIDES:
    foot = model.geom(f'walker/{side}_foot').id
    offsets = data.geom_xmat[foot].reshape(3, 3) @ (
      corners * model.geom_size[foot][:, None]
    )
    heights.append(data.geom_xpos[foot][2] + offsets[2].min())
  return min(heights)


def _settle(
  model: mujoco.MjModel, seconds: float, action: np.ndarray
) -> mujoco.MjData:
  data = mujoco.MjData(model)
  data.ctrl[:] = action
  for _ in range(round(seconds / model.opt.timestep)):
    mujoco.mj_step(model, data)
  return data


def test_mass_and_height() -> None:
  model = _model(ground=False)
  trunk = model.body('walker/trunk')
  assert trunk.subtreemass[0] == pytest.approx(14.05, abs=0.01)
  assert trunk.mass[0] == pytest.approx(5.89, abs=1e-9)
  # Of the hips over the soles, with straight legs and in the crouch.
  data = mujoco.MjData(model)
  for joints, height in ((_STRAIGHT, 0.68), (np.zeros(10), _STAND_HEIGHT)):
    data.qpos[7:] = joints
    mujoco.mj_kinematics(model, data)
    assert -_lowest_sole(model, data) == pytest.approx(height, abs=5e-3)


def test_walker_knows_its_parts() -> None:
  walker = mini_biped.MiniBiped()
  names = lambda elements: tuple(element.name for element in elements)
  assert names(walker.actuators) == mini_biped.JOINTS
  assert names(walker.observable_joints) == mini_biped.JOINTS
  assert names(walker.end_effectors) == ('left_foot', 'right_foot')
  assert walker.root_body.name == 'trunk'
  assert walker.egocentric_camera.name == 'egocentric'
  # Actions are not bounded by the joints' ranges.
  spec = walker.action_spec
  np.testing.assert_allclose(spec.maximum, np.full(10, np.pi), atol=1e-5)
  np.testing.assert_allclose(spec.minimum, np.full(10, -np.pi), atol=1e-5)


def test_joint_ranges_are_degrees_of_the_published_robot() -> None:
  model = _model()
  for side in mini_biped.SIDES:
    for name, low, high in (('hip_yaw', -15, 15), ('hip_roll', -30, 15)):
      joint = model.joint(f'walker/{side}_{name}')
      np.testing.assert_allclose(
        np.degrees(joint.range), [low, high], atol=1e-3
      )
      assert model.dof_damping[joint.dofadr[0]] == 0.1
      assert model.dof_frictionloss[joint.dofadr[0]] == 0.1


def test_torque_is_eq_2() -> None:
  model = _model()
  data = mujoco.MjData(model)
  random = np.random.RandomState(0)
  saturated = free = 0
  for _ in range(50):
    data.qpos[2], data.qpos[7:] = 2.0, random.uniform(-1.5, 1.5, 10)
    data.qvel[:] = 10 * random.standard_normal(16)
    data.ctrl[:] = random.uniform(-3, 3, 10)
    mujoco.mj_forward(model, data)
    wanted = 30 * (data.ctrl - data.qpos[7:]) - 0.5 * data.qvel[6:]
    saturated += np.sum(np.abs(wanted) > 30)
    free += np.sum(np.abs(wanted) < 30)
    np.testing.assert_allclose(
      data.qfrc_actuator[6:], np.clip(wanted, -30, 30), atol=1e-9
    )
    np.testing.assert_array_equal(data.qfrc_actuator[:6], np.zeros(6))
  assert saturated > 50
  assert free > 50


def _mirrored_pose(qpos: np.ndarray) -> np.ndarray:
  signs = [1, -1, 1, 1, -1, 1, -1]  # y; quaternion's x and z.
  return np.concatenate([qpos[:7] * signs, qpos[7:][_SWAPPED]])


def _mirrored_motion(qvel: np.ndarray) -> np.ndarray:
  signs = [1, -1, 1, -1, 1, -1]  # vy; roll and yaw.
  return np.concatenate([qvel[:6] * signs, qvel[6:][_SWAPPED]])


def _random_state(
  model: mujoco.MjModel, random: np.random.RandomState, height: float
) -> tuple[np.ndarray, np.ndarray]:
  """Returns a state whose lowest sole is at `height`."""
  data = mujoco.MjData(model)
  data.qpos[:2] = 0.3 * random.standard_normal(2)
  data.qpos[3:7] = np.eye(4)[0] + 0.1 * random.standard_normal(4)
  data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
  # Some joints are driven beyond their limits.
  data.qpos[7:] = random.uniform(-0.4, 0.4, 10)
  data.qpos[2] = 0.0
  mujoco.mj_kinematics(model, data)
  data.qpos[2] = height - _lowest_sole(model, data)
  return data.qpos.copy(), random.standard_normal(16)


@pytest.mark.parametrize(('height', 'touching'), [(2.0, False), (-0.01, True)])
def test_left_and_right_may_be_exchanged(height: float, touching: bool) -> None:
  """Joints change places, not signs."""
  # A plane, and soles no deeper in it than they are thick: otherwise MuJoCo
  # chooses among contacts by the order of the corners.
  model = _model(ground=False, plane=True)
  # So that what differs is the model, not where the solver stopped.
  model.opt.tolerance, model.opt.iterations = 1e-14, 500
  random = np.random.RandomState(0)
  touches = 0
  for _ in range(20):
    qpos, qvel = _random_state(model, random, height)
    action = random.uniform(-1, 1, 10)
    accelerations = []
    for p, v, a in (
      (qpos, qvel, action),
      (_mirrored_pose(qpos), _mirrored_motion(qvel), action[_SWAPPED]),
    ):
      data = mujoco.MjData(model)
      data.qpos[:], data.qvel[:], data.ctrl[:] = p, v, a
      mujoco.mj_forward(model, data)
      accelerations.append(data.qacc.copy())
      touches += data.ncon
    mine, other = accelerations
    scale = np.abs(mine).max()
    np.testing.assert_allclose(
      _mirrored_motion(other) / scale, mine / scale, atol=1e-9
    )
  assert (touches > 0) == touching


def _sensors(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, Any]:
  names = [model.sensor(i).name for i in range(model.nsensor)]
  return {
    name.removeprefix('walker/'): data.sensor(name).data.copy()
    for name in names
  }


def test_sensors_in_flight() -> None:
  model = _model(ground=False)
  data = mujoco.MjData(model)
  half = np.pi / 4  # Facing +y.
  data.qpos[3:7] = [np.cos(half), 0, 0, np.sin(half)]
  data.qvel[:6] = [0.0, 2.0, 0.5, 0.1, 0.2, 0.3]
  mujoco.mj_forward(model, data)
  sensors = _sensors(model, data)
  for name, expected in (
    ('gyro', [0.1, 0.2, 0.3]),
    ('velocimeter', [2.0, 0.0, 0.5]),
    ('orientation', data.qpos[3:7]),
    ('left_foot', [0.0]),
    ('right_foot', [0.0]),
  ):
    np.testing.assert_allclose(sensors[name], expected, atol=1e-9)


def test_action_balances_gravity() -> None:
  """Half of the weight under each foot leaves nothing to accelerate."""
  model = _model(ground=False)
  model.dof_frictionloss[:] = 0.0  # It would hide a small torque.
  data = mujoco.MjData(model)
  data.ctrl[:] = mini_biped.standing_action(model)
  mujoco.mj_forward(model, data)
  centre = data.body('walker/trunk').subtree_com
  force = np.array([0.0, 0.0, _WEIGHT / 2])
  for side in mini_biped.SIDES:
    foot = data.body(f'walker/{side}_foot')
    arm = np.array([centre[0], foot.xpos[1], foot.xpos[2]]) - foot.xipos
    foot.xfrc_applied[:] = np.concatenate([force, np.cross(arm, force)])
  mujoco.mj_forward(model, data)
  np.testing.assert_allclose(data.qacc, np.zeros(16), atol=2e-3)


def test_without_it_the_robot_sags() -> None:
  model = _model('lift')
  data = _settle(model, 1.5, mini_biped.standing_action(_model()))
  assert data.qpos[0] == pytest.approx(0.0, abs=0.01)
  sensors = _sensors(model, data)
  np.testing.assert_allclose(
    sensors['accelerometer'], [0.0, 0.0, 9.81], atol=0.05
  )
  for side in mini_biped.SIDES:
    assert sensors[f'{side}_foot'][0] == pytest.approx(_WEIGHT / 2, abs=1.0)
  assert _settle(model, 1.0, np.zeros(10)).qpos[0] < -0.03


def test_aliveness() -> None:
  arena = floors.Floor()
  walker = mini_biped.MiniBiped()
  walker.create_root_joints(arena.attach(walker))
  env = composer.Environment(composer.NullTask(arena))
  physics = env.physics
  for quaternion, expected in (
    ([1, 0, 0, 0], 0.0),
    ([0.5**0.5, 0.5**0.5, 0, 0], -0.5),
    ([0, 1, 0, 0], -1.0),
  ):
    walker.set_pose(physics, quaternion=quaternion)
    physics.forward()
    assert walker.aliveness(physics) == pytest.approx(expected, abs=1e-7)


def test_previous_action_is_that_of_the_episode() -> None:
  arena, walker = floors.Floor(), mini_biped.MiniBiped()
  walker.create_root_joints(arena.attach(walker))
  walker.observables.prev_action.enabled = True
  env = composer.Environment(composer.NullTask(arena))
  (before,) = env.reset().observation.values()
  np.testing.assert_array_equal(before, np.zeros((1, 10)))
  given = np.linspace(-1, 1, 10)
  walker.apply_action(env.physics, given, env.random_state)
  given[:] = 0.0  # The caller's array is not the walker's.
  np.testing.assert_array_equal(walker.prev_action, np.linspace(-1, 1, 10))
  np.testing.assert_array_equal(env.physics.data.ctrl, walker.prev_action)
  env.reset()
  np.testing.assert_array_equal(walker.prev_action, np.zeros(10))


def _touching(physics: Any) -> set[frozenset[str]]:
  """Returns the pairs of robots that touch; one name where it is itself."""
  names = [physics.model.id2name(i, 'geom') for i in range(physics.model.ngeom)]
  return {
    frozenset(names[geom].split('/')[0] for geom in (c.geom1, c.geom2))
    for c in physics.data.contact
  }


def test_two_robots_touch_each_other_but_not_themselves() -> None:
  arena = floors.Floor()
  robots = [mini_biped.MiniBiped(name=name) for name in ('home', 'away')]
  for robot in robots:
    robot.create_root_joints(arena.attach(robot))
  env = composer.Environment(composer.NullTask(arena))
  physics = env.physics
  for height, robot in zip((0.5, 1.1), robots, strict=True):
    robot.set_pose(physics, position=[0, 0, height])
    # The legs are one in the other.
    hips = robot.mjcf_model.find_all('joint')[1::5]
    physics.bind(hips).qpos = 0.5
  seen = set()
  for _ in range(100):
    physics.step()
    seen |= _touching(physics)
  assert frozenset(('home', 'away')) in seen
  assert not {frozenset(('home',)), frozenset(('away',))} & seen


def test_that_costs_no_bit_of_one_robots_motion() -> None:
  """As if, to be spared itself, it had to be spared by all others."""
  excluding, sparing = _model(), _model()
  robots = sparing.geom_contype & (sparing.geom_bodyid > 0)
  sparing.geom_conaffinity[robots > 0] = 0
  sparing.body_conaffinity[1:] = 0
  random = np.random.RandomState(0)
  controls = random.uniform(-2, 2, (200, 10))
  states = []
  for model in (excluding, sparing):
    data = mujoco.MjData(model)
    data.qpos[2] = _STAND_HEIGHT
    for control in controls:
      data.ctrl[:] = control
      mujoco.mj_step(model, data, nstep=5)
      states.append(np.concatenate([data.qpos, data.qvel]))
  half = len(states) // 2
  np.testing.assert_array_equal(states[:half], states[half:])
