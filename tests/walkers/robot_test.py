"""Tests of dmc_multimode.walkers.robot, its derivation, mirror and files."""

import os
import pathlib
import re
import shutil
from typing import Any, Callable

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np
import pytest
import yaml

from dmc_multimode.utils import config
from dmc_multimode.walkers import mini_biped
from dmc_multimode.walkers import mirroring
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_files
from dmc_multimode.walkers import robot_walker
from dmc_multimode.walkers import trial

_FOLDER = pathlib.Path(__file__).parents[1] / 'robots'
_FILE, _MODEL = 'four_legs.yaml', 'four_legs.xml'
_LEGS = ('fl', 'fr', 'hl', 'hr')


@pytest.fixture(scope='module')
def four_legs() -> robot_lib.Robot:
  return robot_lib.load(_FOLDER / _FILE)


# --- What follows.


def test_mini_biped_follows_from_its_declaration() -> None:
  derived = robot_lib.mini_biped().derived
  lengths = derived.stand_height, derived.stance_width, *derived.sole_depth
  assert lengths == (0.5, 0.18, 0.01, 0.01)  # To the bit.
  assert derived.mass == pytest.approx(14.046)
  # From its hip yaw to its sole, with straight legs.
  assert derived.leg_length == pytest.approx(0.548, abs=1e-3)
  np.testing.assert_array_equal(derived.pose, np.zeros(10))
  np.testing.assert_array_equal(derived.action_bounds[1], np.full(10, 3.14159))
  np.testing.assert_array_equal(derived.action_scale, np.ones(10))
  np.testing.assert_array_equal(derived.trunk_size, [0.0625, 0.095, 0.124])
  exchanged = (5, 6, 7, 8, 9, 0, 1, 2, 3, 4)
  assert derived.mirror[:4] == (exchanged, (1,) * 10, (1, 0), ((0, 1),))
  assert derived.mirror.asymmetry < 1e-6


def test_declared_mini_biped_is_the_same_model() -> None:
  walkers = [
    mini_biped.MiniBiped(),
    robot_walker.RobotWalker(robot_lib.mini_biped()),
  ]
  one, other = (each.mjcf_model.to_xml_string() for each in walkers)
  assert one == other
  assert robot_lib.mini_biped().is_mini_biped


def test_four_legs(four_legs: robot_lib.Robot) -> None:
  derived = four_legs.derived
  # Thigh and calf of 0.13 m, each 0.7 rad from the vertical, and a ball.
  height = 2 * 0.13 * np.cos(0.7) + 0.018
  assert derived.stand_height == pytest.approx(height, abs=5e-4)
  assert derived.mass == pytest.approx(2 + 4 * (0.3 + 0.3 + 0.08 + 0.02))
  assert derived.leg_length == pytest.approx(np.hypot(0.26, 0.03), abs=2e-3)
  assert derived.stance_width == 0.18
  np.testing.assert_array_equal(derived.sole_depth, np.full(4, 0.018))
  # Bounds are where a joint at its limit gets the whole torque, 12 Nm.
  np.testing.assert_allclose(derived.action_scale, 12 / 20)
  np.testing.assert_allclose(derived.action_bounds[:, 0], [-1.2, 1.2])
  # Rolls have one axis on both sides.
  assert derived.mirror.joint_order == (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
  assert derived.mirror.joint_signs == (-1, 1, 1) * 4
  assert derived.mirror.foot_order == (1, 0, 3, 2)
  order, signs = derived.mirror.joint_order, derived.mirror.joint_signs
  stand = derived.standing_action
  np.testing.assert_allclose(np.array(signs) * stand[list(order)], stand)
  assert not four_legs.is_mini_biped
  assert four_legs.size == derived.stand_height / 0.5


@pytest.mark.parametrize('height', [0.0, 0.03])
def test_four_legs_stand(four_legs: robot_lib.Robot, height: float) -> None:
  found = trial.drop(four_legs, height, seconds=1.5)
  assert found.stands and found.feet == (True,) * 4
  assert abs(found.sunk) < 0.002 and found.tilt < 0.02 and found.drift < 0.01
  assert (found.load > 2) == (height > 0)


def test_walker(four_legs: robot_lib.Robot) -> None:
  walker = robot_walker.RobotWalker(four_legs)
  names = lambda elements: tuple(element.name for element in elements)
  assert names(walker.actuators) == four_legs.joints
  assert names(walker.observable_joints) == four_legs.joints
  assert names(walker.end_effectors) == tuple(f'{leg}_calf' for leg in _LEGS)
  feet = tuple(f'{leg}_foot' for leg in _LEGS)
  assert names(walker.ground_contact_geoms) == feet
  assert names(walker.foot_sensors) == feet
  np.testing.assert_allclose(walker.action_spec.maximum[:3], [1.2, 2.6, 0.4])
  arena = composer.Arena()
  walker.create_root_joints(arena.attach(walker))
  env = composer.Environment(composer.NullTask(arena))
  env.reset()
  np.testing.assert_allclose(
    env.physics.bind(walker.observable_joints).armature, 0.002
  )


def test_the_mini_biped_falls_and_is_not_broken() -> None:
  """From rest it takes seconds, which a shorter trial would not see."""
  robot = robot_lib.mini_biped()
  model = trial.on_ground(robot)
  found = trial.drop(robot, model=model)
  assert not found.stands and not found.fault
  assert 1.0 < found.seconds < trial.SECONDS and found.tilt > 0.3
  brief = trial.drop(robot, seconds=1.0, model=model)
  assert brief.stands and brief.seconds == 1.0 and brief.feet == (True, True)


# --- Names of left and right.


@pytest.mark.parametrize(
  ('names', 'order'),
  [
    (['left_hip', 'right_hip'], (1, 0)),
    (['LeftHip', 'waist', 'RightHip'], (2, 1, 0)),
    (['hip_l', 'hip_r', 'roll'], (1, 0, 2)),
    (['FL_knee', 'FR_knee', 'RL_knee', 'RR_knee'], (1, 0, 3, 2)),
    (['lf', 'rf', 'lh', 'rh'], (1, 0, 3, 2)),
    (['front_left', 'front_right'], (1, 0)),
  ],
)
def test_partners_by_names(names: list[str], order: tuple[int, ...]) -> None:
  assert mirroring.exchanged(names, 'joint') == order


@pytest.mark.parametrize(
  ('names', 'message'),
  [
    (['left_hip', 'right_knee'], "'left_hip' has no mirror image: there is no"),
    (['ll', 'lr', 'rl'], "'ll' could be mirrored by 'rl' or 'lr'"),
  ],
)
def test_names_without_partners(names: list[str], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    mirroring.exchanged(names, 'joint')


# --- Files.


def test_round_trip(four_legs: robot_lib.Robot) -> None:
  values = four_legs.to_dict()
  again = robot_lib.from_dict(values)
  assert again == four_legs and hash(again) == hash(four_legs)
  assert again.derived.stand_height == four_legs.derived.stand_height
  assert again != robot_lib.mini_biped()
  values['model'] = values['model'].replace('mass="2"', 'mass="3"')
  with pytest.raises(ValueError, match='not that of its hash'):
    robot_lib.from_dict(values)
  for more, reason in (
    ('<include file="x.xml"/>', 'reads other files'),
    ('<compiler meshdir="/"/>', 'reads other files'),
    ('<asset><mesh file="/x.stl"/></asset>', 'reads other files'),
    ('<extension/>', 'loads plugins'),
  ):
    xml = four_legs.model.xml.replace('</mujoco>', f'{more}</mujoco>')
    with pytest.raises(ValueError, match=reason):
      robot_lib.from_dict({**values, 'model': xml})
  with pytest.raises(ValueError, match="not a robot: it lacks 'model'"):
    robot_lib.from_dict({'declaration': values['declaration']})


class _Copy:
  """A copy of the robot's files that a test may change."""

  def __init__(self, folder: pathlib.Path):
    self.folder = folder
    for name in (_FILE, _MODEL):
      shutil.copy(_FOLDER / name, folder)

  def declare(self, **changes: Any) -> None:
    """Changes fields of the declaration; None removes one."""
    path = self.folder / _FILE
    values = {**yaml.safe_load(path.read_text()), **changes}
    kept = {key: value for key, value in values.items() if value is not None}
    path.write_text(yaml.safe_dump(kept, sort_keys=False))

  def edit(self, old: str, new: str, count: int = -1) -> None:
    """Replaces text of the model."""
    path = self.folder / _MODEL
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))

  def load(self) -> robot_lib.Robot:
    return robot_lib.load(self.folder / _FILE)


@pytest.fixture
def files(tmp_path: pathlib.Path) -> _Copy:
  folder = tmp_path / 'robot'
  folder.mkdir()
  return _Copy(folder)


_POSE = {f'{leg}_pitch': 0.7 for leg in _LEGS} | {
  f'{leg}_knee': -1.4 for leg in _LEGS
}
_JOINTS = yaml.safe_load((_FOLDER / _FILE).read_text())['joints']
_SERVOS = {'stiffness': 20, 'damping': 0.5, 'limit': 12}
_FEET = [f'{leg}_foot' for leg in _LEGS]


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'feet': _FEET[:3]}, 'feet: two or four, got 3'),
    (
      {'feet': [*_FEET[:3], 'tail']},
      "foot 'tail' is neither a site nor a geom nor a bo",
    ),
    (
      {'feet': [_FEET[i] for i in (0, 2, 1, 3)]},
      "feet: give 'fr_foot' right after 'fl_foot', its other side: front left",
    ),
    ({'feet': [_FEET[i] for i in (2, 3, 0, 1)]}, 'feet: give the front feet'),
    (
      {'feet': [_FEET[i] for i in (1, 0, 2, 3)]},
      "give 'fl_foot', the left one",
    ),
    ({'feet': ['base', *_FEET[1:]]}, "foot 'base' is .* mm over the ground"),
    (
      {'joints': _JOINTS[:-1], 'pose': {}},
      'joints must be all of the model, in its order',
    ),
    ({'joints': [*_JOINTS[:-1], 'tail'], 'pose': {}}, "there is no 'tail'"),
    ({'joints': _JOINTS[::-1]}, 'in its order: it has fl_roll, fl_pitch'),
    ({'trunk': 'torso'}, "only body of the world must be the trunk 'torso'"),
    ({'model': 'gone.xml'}, "the model 'gone.xml' cannot be read"),
    ({'model': '../four_legs.xml'}, 'is outside the folder of the robot'),
    ({'model': '/etc/hostname'}, 'is outside the folder of the robot'),
    ({'pose': {'fl_neck': 1.0}}, "pose: 'fl_neck' matches none of the"),
    ({'pose': {**_POSE, 'fl_knee': 0.5}}, "'fl_knee' is 0.5, outside of its"),
    ({'pose': {**_POSE, 'fl_knee': -1.2}}, 'correct the pose'),
    ({'pose': {**_POSE, 'fl_roll': 0.1}}, "are not where each is|each other's"),
    ({'servos': {**_SERVOS, 'limit': 0.5}}, 'is too weak to stand: it takes'),
    ({'servos': {**_SERVOS, 'limit': {'fl_roll': 1}}}, "'fl_pitch' is missing"),
    ({'servos': {**_SERVOS, 'limit': {'*_[rp]*': 9}}}, "'fl_knee' is missing"),
    (
      {'servos': {**_SERVOS, 'damping': {'*': 1, '?r_toe': 2}}},
      "servos.damping: '.r_toe' matches none of the joints",
    ),
    (
      {'servos': {**_SERVOS, 'damping': {'*_knee': 1, '*': 2}}},
      "servos.damping: '._knee' counts for no joint: its name or a later",
    ),
    ({'servos': {'stiffness': 20}}, 'servos.damping: Field required'),
    ({'servos': {**_SERVOS, 'stiffness': -1}}, 'servos.stiffness'),
    ({'servos': None}, 'declare servos'),
    ({'ranges': {'tail': [0, 1]}}, "ranges: 'tail' matches none of the"),
    ({'ranges': {'fl_roll': [1, -1]}}, "ranges: 'fl_roll' has 1 to -1"),
    ({'control_timestep': 0}, 'control_timestep: Input should be greater'),
    ({'name': '../x'}, 'name: at most 64 letters'),
    ({'armature': float('nan')}, 'armature'),
    ({'colour': 'red'}, 'colour'),
  ],
)
def test_bad_declarations(
  files: _Copy, changes: dict[str, Any], message: str
) -> None:
  files.declare(**changes)
  with pytest.raises(ValueError, match=message) as error:
    files.load()
  assert '\n' not in str(error.value)
  assert str(error.value).startswith(str(files.folder / _FILE))


@pytest.mark.parametrize(
  ('old', 'new', 'message'),
  [
    ('axis="1 0 0" range="-.6 .6"', 'axis="1 0 0"', 'fl_roll. has no limits'),
    ('name="hr_knee" ', 'name="hr_knee" type="ball" ', 'hr_knee'),
    ('<freejoint/>', '<joint name="lift" type="slide"/>', 'the trunk has a'),
    ('name="base" pos="0 0 .25"', 'name="base" euler="9 0 0"', 'trunk is tur'),
    ('pos="0.14 -0.06 0"', 'pos="0.15 -0.06 0"', 'image in the standing'),
    ('.3" diaginertia', '.4" diaginertia', 'left and right differ'),
    ('name="fr_knee"', 'name="fr_knee" axis="0 0 1"', "'fl_knee' and 'fr_kn"),
    ('size=".18 .05 .03"', 'size=".18 .05 .3"', "'base' is .* mm in the grou"),
    ('size=".018"', 'size=".018" contype="0"', 'touches nothing'),
    ('<freejoint/>', '<freejoint/><geom mass="9" size=".01" pos=".5 0 0"/>',
     'the centre of mass is not over the feet'),
    ('</worldbody>', '<body name="box"/></worldbody>', 'model has base, box'),
    ('<freejoint/>', '<replicate count="999999"/>', 'makes many bodies of one'),
    ('mass=".3"', 'mass="nan"', "has mass 'nan', which is not finite"),
    ('</mujoco>', '<extension/></mujoco>', 'loads plugins'),
    ('</mujoco>', '<asset><texture name="t" type="2d" builtin="flat" '
     'width="99999" height="9"/></asset></mujoco>', "has width '99999'"),
    ('</mujoco>', '<asset><mesh file="leg.stl"/></asset></mujoco>',
     "mesh 'leg.stl' cannot be read"),
    ('</mujoco>', '<asset><mesh file="../leg.stl"/></asset></mujoco>',
     'outside the folder'),
    ('</mujoco>', '<asset><mesh file="leg.so"/></asset></mujoco>', 'is none'),
    ('</mujoco>', '<include file="four_legs.xml"/></mujoco>', 'twice'),
    ('</mujoco>', '<include file="../x.xml"/></mujoco>', 'outside the folder'),
    ('<mujoco model="four_legs">', '<!DOCTYPE x [<!ENTITY a "b">]><mujoco>',
     'it declares entities'),
    ('</mujoco>', '', 'is not MJCF: no element found'),
    ('class="foot"/>', 'class="foot" wheels="4"/>', 'is not MJCF'),
    ('condim="3"', 'condim="7"', 'MuJoCo refuses|is not MJCF'),
    ('<joint damping=".05"/>', '<joint damping=".05"/>' + 101 * '<default>'
     + 101 * '</default>', 'nested 100 deep'),
  ],
)  # fmt: skip
def test_bad_models(files: _Copy, old: str, new: str, message: str) -> None:
  files.edit(old, new, 1)
  with pytest.raises(ValueError, match=message) as error:
    files.load()
  assert '\n' not in str(error.value)
  assert str(error.value).startswith(str(files.folder / _FILE))


def test_file_and_line_of_bad_yaml(files: _Copy) -> None:
  path = files.folder / _FILE
  path.write_text('name: x\nname: y\n')
  with pytest.raises(ValueError, match=f'{_FILE}:2: .*given twice'):
    files.load()
  path.write_bytes(b'\xff\xfe')
  with pytest.raises(ValueError, match='not text in UTF-8'):
    files.load()
  path.unlink()
  with pytest.raises(FileNotFoundError):
    files.load()


@pytest.mark.skipif(not hasattr(os, 'symlink'), reason='no links here')
def test_links_out_of_the_folder(files: _Copy) -> None:
  path = files.folder / _MODEL
  path.rename(files.folder.parent / _MODEL)
  path.symlink_to(files.folder.parent / _MODEL)
  with pytest.raises(ValueError, match='is outside the folder of the robot'):
    files.load()


def test_sizes_are_bounded(
  files: _Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(robot_files, 'MAX_MODEL_BYTES', 1000)
  with pytest.raises(ValueError, match='is too large: 1,000 bytes are the'):
    files.load()


def _tetrahedron() -> str:
  """Returns a solid of about a centimetre, as OBJ."""
  corners = ('0 0 0', '.01 0 0', '0 .01 0', '0 0 .01')
  faces = ('1 3 2', '1 2 4', '2 3 4', '3 1 4')
  lines = [f'v {corner}' for corner in corners]
  return '\n'.join([*lines, *(f'f {face}' for face in faces)]) + '\n'


def test_meshes_and_includes_in_the_folder(
  files: _Copy, four_legs: robot_lib.Robot
) -> None:
  (files.folder / 'meshes').mkdir()
  (files.folder / 'meshes' / 'eye.obj').write_text(_tetrahedron())
  (files.folder / 'assets.xml').write_text(
    '<mujoco><asset><mesh name="eye" file="eye.obj"/></asset></mujoco>'
  )
  files.edit('<compiler ', '<compiler meshdir="meshes" ')
  files.edit('<worldbody>', '<include file="assets.xml"/><worldbody>')
  eye = '<freejoint/><geom type="mesh" mesh="eye" mass="0" contype="0"/>'
  files.edit('<freejoint/>', eye)
  robot = files.load()
  assert list(robot.model.assets) == ['eye.obj']
  assert robot != four_legs
  shutil.rmtree(files.folder)  # It has all that it needs.
  again = robot_lib.from_dict(robot.to_dict())
  assert again.derived.mass == pytest.approx(four_legs.derived.mass)
  assert trial.drop(again).stands


def test_meshes_of_one_name_in_two_folders(files: _Copy) -> None:
  """Are two; others keep their bare names, of which hashes are made."""
  eye = _tetrahedron()
  for folder, text in (('a', eye), ('b', eye.replace('.01', '.02'))):
    (files.folder / folder).mkdir()
    (files.folder / folder / 'eye.obj').write_text(text)
    (files.folder / folder / 'ear.obj').write_text(eye)
  assets = ''.join(
    f'<mesh name="{f}_{n}" file="{f}/{n}.obj"/>'
    for f in 'ab'
    for n in ('eye', 'ear')
  )
  files.edit('</mujoco>', f'<asset>{assets}</asset></mujoco>')
  geoms = ''.join(
    f'<geom type="mesh" mesh="{f}_eye" mass="0" contype="0"/>' for f in 'ab'
  )
  files.edit('<freejoint/>', f'<freejoint/>{geoms}')
  robot = files.load()
  assert set(robot.model.assets) == {'a/eye.obj', 'b/eye.obj', 'ear.obj'}
  again = robot_lib.from_dict(robot.to_dict())
  model = robot_walker.compile_alone(robot_walker.RobotWalker(again))
  sizes = [
    model.geom_rbound[model.geom_dataid == model.mesh(f'walker/{f}_eye').id]
    for f in 'ab'
  ]
  np.testing.assert_allclose(2 * sizes[0], sizes[1], rtol=1e-4)


def test_sizes_of_meshes_are_those_of_all(
  files: _Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(robot_files, 'MAX_ASSET_BYTES', 1 << 20)
  for name in ('ear.obj', 'eye.obj'):
    (files.folder / name).write_bytes(b'\n' * (3 << 18))  # 0.75 MB.
  meshes = '<mesh file="ear.obj"/><mesh file="eye.obj"/>'
  files.edit('</mujoco>', f'<asset>{meshes}</asset></mujoco>')
  with pytest.raises(ValueError, match='visuals: false') as error:
    files.load()
  assert (
    'textures are 1.5 MB in all, and 1 MB are the most: eye.obj does not fit'
    in str(error.value)
  )
  files.declare(visuals=False)  # No geom has them.
  assert not files.load().model.assets


def test_visuals_are_left_out(files: _Copy, four_legs: robot_lib.Robot) -> None:
  """But for geoms that weigh, or that a sensor names."""
  (files.folder / 'solid.obj').write_text(_tetrahedron())
  files.edit(
    '<default class="foot">',
    '<default class="seen"><geom type="mesh" contype="0"/></default>'
    '<default class="foot">',
  )
  meshes = '<mesh file="gone.obj"/><mesh name="solid" file="solid.obj"/>'
  files.edit('<worldbody>', f'<asset>{meshes}</asset><worldbody>')
  files.edit(
    '<freejoint/>',
    '<freejoint/>'
    '<geom class="seen" mesh="gone" mass="0"/>'
    '<geom class="seen" type="sphere" size=".01" mass="1"/>'
    '<geom type="mesh" mesh="solid" mass="0"/>'
    '<geom name="named" type="sphere" size=".01" mass="0" contype="0"/>',
  )
  inertial = '<inertial pos="0 0 0" mass=".3" diaginertia=".0002 .0002 .0002"/>'
  files.edit(inertial, inertial + '<geom class="seen" mesh="gone"/>')
  sensor = '<sensor><distance geom1="named" geom2="base" cutoff="1"/></sensor>'
  files.edit('</mujoco>', f'{sensor}</mujoco>')
  with pytest.raises(ValueError, match="mesh 'gone.obj' cannot be read"):
    files.load()
  files.declare(visuals=False)
  robot = files.load()
  assert list(robot.model.assets) == ['solid.obj']
  assert 'name="named"' in robot.model.xml
  assert robot.derived.mass == pytest.approx(four_legs.derived.mass + 1)
  assert robot_lib.from_dict(robot.to_dict()) == robot


def test_ranges_of_joints_without_one(
  files: _Copy, four_legs: robot_lib.Robot
) -> None:
  files.edit('<joint axis="1 0 0" range="-.6 .6"/>', '<joint axis="1 0 0"/>')
  ranges = {f'{leg}_roll': [-0.6, 0.6] for leg in _LEGS}
  files.declare(ranges=ranges)
  robot, known = files.load().derived, four_legs.derived
  np.testing.assert_array_equal(robot.joint_limits, known.joint_limits)
  np.testing.assert_array_equal(robot.action_bounds, known.action_bounds)
  # A model knows what its joints bear: its ranges are not widened or narrowed.
  for bounds in ([-0.1, 0.1], [-3, 3]):
    files.declare(ranges={**ranges, 'fl_pitch': bounds})
    with pytest.raises(ValueError, match="'fl_pitch' has a range in the model"):
      files.load()


def _with_hidden_geoms(files: _Copy, more: str = '') -> mujoco.MjModel:
  """Returns the robot with all geoms in group 3, and more in its compiler."""
  files.edit('<geom contype="1" ', '<geom contype="1" group="3" ')
  files.edit('<compiler ', f'<compiler {more}')
  return trial.on_ground(files.load())


def test_robots_of_hidden_geoms_are_shown(files: _Copy) -> None:
  """The whole of bodies without a geom that is drawn, and no other."""
  files.edit('<geom name="fl_foot"', '<geom name="fl_foot" group="1"')
  model = _with_hidden_geoms(files)
  groups = model.geom_group[model.geom_bodyid > 0]
  calf = model.geom_bodyid == model.body('walker/fl_calf').id
  assert sorted(model.geom_group[calf]) == [1, 3]
  assert (np.sort(groups) == [0] * (len(groups) - 2) + [1, 3]).all()
  assert 'group="0"' not in files.load().model.xml  # Its hash is of the file.


def test_groups_that_weigh_stay(
  files: _Copy, four_legs: robot_lib.Robot
) -> None:
  model = _with_hidden_geoms(files, 'inertiagrouprange="3 3" ')
  assert (model.geom_group[model.geom_bodyid > 0] == 3).all()
  assert files.load().derived.mass == four_legs.derived.mass


@pytest.mark.gl
def test_pictures_show_hidden_geoms(files: _Copy) -> None:
  model = _with_hidden_geoms(files)
  pictures = []
  for height in (0.2, -9.0):  # There, the floor hides it.
    data = mujoco.MjData(model)
    data.qpos[2] = height
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 48, 64) as renderer:
      renderer.update_scene(data)
      pictures.append(renderer.render().astype(int))
  assert (np.abs(pictures[0] - pictures[1]).max(axis=-1) > 30).mean() > 0.02


def _with_sites(files: _Copy, radius: str = '.023') -> None:
  for leg in _LEGS:
    old = f'<geom name="{leg}_foot" class="foot"/>'
    files.edit(old, f'<geom class="foot"/><site name="{leg}" pos="0 0 -.13" '
      f'size="{radius}"/>')  # fmt: skip
  files.declare(feet=list(_LEGS))


def _with_bodies(files: _Copy) -> None:
  """Feet without names, each the only geom of a body that collides."""
  for leg in _LEGS:
    old = f'<geom name="{leg}_foot" class="foot"/>'
    body = f'<body name="{leg}"><geom class="foot"/></body>'
    files.edit(old, body)
  files.declare(feet=list(_LEGS))


def _without_names_of_bodies(files: _Copy) -> None:
  for leg in _LEGS:
    files.edit(f'<body name="{leg}_calf"', '<body')


def _with_own_servos(files: _Copy) -> None:
  servos = ''.join(
    f'<position joint="{name}" kp="20" kv=".5" forcerange="-12 12" '
    'ctrlrange="-3 3"/>'
    for name in _JOINTS
  )
  files.edit('</mujoco>', f'<actuator>{servos}</actuator></mujoco>')
  files.declare(servos=None)


@pytest.mark.parametrize(
  'change',
  [_with_sites, _with_bodies, _with_own_servos, _without_names_of_bodies],
)
def test_other_ways_to_say_the_same(
  files: _Copy, four_legs: robot_lib.Robot, change: Callable[[_Copy], None]
) -> None:
  change(files)
  one, other = files.load().derived, four_legs.derived
  assert one.stand_height == other.stand_height
  assert one.mirror[:4] == other.mirror[:4]
  np.testing.assert_allclose(one.sole_depth, other.sole_depth)
  np.testing.assert_allclose(one.standing_action, other.standing_action)


@pytest.mark.parametrize(
  ('change', 'fault'),
  [
    # The servos' frequency is beyond what the physics' time step resolves.
    (
      lambda files: files.declare(
        servos={'stiffness': 2e4, 'damping': 0.5, 'limit': 1e4}
      ),
      'it bursts',
    ),
    (
      lambda files: _with_sites(files, '.001'),
      "'fl' feels no ground: its site",
    ),
    (
      lambda files: files.declare(servos={**_SERVOS, 'stiffness': 0.3}),
      'it sinks by .* mm upright: stiffen',
    ),
  ],
)
def test_broken_robots(
  files: _Copy, change: Callable[[_Copy], None], fault: str
) -> None:
  change(files)
  assert re.match(f'.*{fault}', trial.drop(files.load()).fault)


def test_servos_that_inherit_the_ranges_of_their_joints(files: _Copy) -> None:
  """In a class, with limits of the joints: as in models of MuJoCo Menagerie."""
  files.edit(
    '<joint damping=".05"/>',
    '<joint damping=".05" actuatorfrcrange="-12 12"/>'
    '<position kp="20" kv=".5" inheritrange="1"/>',
  )
  servos = ''.join(f'<position joint="{name}"/>' for name in _JOINTS)
  files.edit('</mujoco>', f'<actuator>{servos}</actuator></mujoco>')
  files.declare(servos=None)
  robot = files.load()
  np.testing.assert_allclose(robot.derived.action_scale, 12 / 20)
  low, high = robot.derived.action_bounds
  assert (low[0], high[0]) == (-0.6, 0.6)
  model = mjcf.Physics.from_mjcf_model(
    robot_walker.RobotWalker(robot).mjcf_model
  ).model
  np.testing.assert_allclose(model.actuator_ctrlrange[0], [-0.6, 0.6])


def test_patterns_are_the_tables_that_they_stand_for(files: _Copy) -> None:
  """To the bit of the hash: the last one counts, and a name more than these."""
  stiffness = {'fr_roll': 9, '*': 20, '*_[pk]*': 21, 'f?_*e*': 22}
  files.declare(
    servos={**_SERVOS, 'stiffness': stiffness},
    pose={'*_pitch': 0.7, '*_knee': -1.4},
  )
  declared = yaml.safe_load((files.folder / _FILE).read_text())
  assert list(declared['servos']['stiffness']) == list(stiffness)
  one = config.build(robot_lib.Declaration, declared)
  written = dict.fromkeys(_JOINTS, 21) | {'fl_knee': 22, 'fr_knee': 22}
  written |= {name: 20 for name in _JOINTS if name.endswith('_roll')}
  written |= {'fr_roll': 9}
  declared['servos']['stiffness'], declared['pose'] = written, _POSE
  assert one == config.build(robot_lib.Declaration, declared)


def test_declared_servos_replace_the_models(
  files: _Copy, four_legs: robot_lib.Robot
) -> None:
  """And classes, with the gear of a motor in them, do not reach them."""
  files.edit(
    '<joint damping=".05"/>', '<joint damping=".05"/><motor gear="7"/>'
  )
  motors = ''.join(f'<motor joint="{name}"/>' for name in _JOINTS)
  files.edit('</mujoco>', f'<actuator>{motors}</actuator></mujoco>')
  stiff = dict.fromkeys(_JOINTS, 20)
  files.declare(servos={**_SERVOS, 'stiffness': stiff})
  np.testing.assert_allclose(
    files.load().derived.standing_action, four_legs.derived.standing_action
  )
