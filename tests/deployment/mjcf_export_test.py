"""Tests of dmc_multimode.deployment.mjcf_export and of xml/scene.xml."""

import pathlib
from typing import Any

import mujoco
import numpy as np
import pytest

from dmc_multimode import deployment
from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.utils import resources
from dmc_multimode.walkers import mini_biped

_STEPS = 40  # Control steps.


def _load(path: pathlib.Path) -> tuple[mujoco.MjModel, mujoco.MjData]:
  """Returns a model and its data at the keyframe `stand`."""
  model = mujoco.MjModel.from_xml_path(str(path))
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key('stand').id)
  return model, data


@pytest.mark.parametrize('timestep', [0.001, 0.005])
def test_the_keyframe_stands(timestep: float, tmp_path: pathlib.Path) -> None:
  path = deployment.write_mjcf(tmp_path, timestep=timestep)
  scene = resources.path('xml', 'scene.xml')
  for model, data in (_load(path), _load(scene)):
    mujoco.mj_step(model, data, nstep=round(5 / model.opt.timestep))
    upright = data.body('trunk').xmat[8]
    assert upright > 0.99
    assert data.qpos[2] == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(data.qpos[:2], 0, atol=0.05)


@pytest.mark.parametrize('arena', layouts.NAMES)
def test_the_track_is_in_place(arena: str, tmp_path: pathlib.Path) -> None:
  model, data = _load(deployment.write_mjcf(tmp_path, arena=arena, seed=2))
  drawn = track.make(arena).generate(np.random.RandomState(2))
  num = np.isfinite(drawn.starts[0]).sum()
  centres, halves = (values[0, :num] for values in terrain_lib.boxes(drawn))
  mujoco.mj_forward(model, data)
  found = [model.geom(f'segment_{i}').id for i in range(num)]
  np.testing.assert_array_equal(data.geom_xpos[found], centres)
  np.testing.assert_array_equal(model.geom_size[found], halves)
  grounds = np.flatnonzero(model.geom_bodyid == 0)
  np.testing.assert_array_equal(grounds, found)
  names = [model.actuator(i).name for i in range(model.nu)]
  assert tuple(names) == mini_biped.JOINTS


# Where the robot is dropped: at the start, and over the edge of the block.
@pytest.mark.parametrize(
  ('arena', 'x', 'timestep'),
  [('parkour', 0.0, 0.005), ('gap_block', 1.6, 2e-3)],
)
def test_it_steps_as_both_engines_do(
  arena: str, x: float, timestep: float, tmp_path: pathlib.Path
) -> None:
  settings = config.ImitationConfig(physics_timestep=timestep)
  task = multimode_biped.make_task('idle', arena=arena, config=settings)
  env = multimode_biped.make_environment(task, 0)
  env.reset()
  num, substeps = np.array([0]), task.config.substeps
  path = deployment.write_mjcf(tmp_path, arena=arena, timestep=timestep)
  model, data = _load(path)
  data.qpos[[0, 2]] += [x, x / 2]
  compiled = mujoco_worlds.compile_model(task)
  worlds = mujoco_worlds.MujocoWorlds(compiled, task.root_entity, 1, 1)
  worlds.reset(num, data.qpos[None], data.qvel[None])
  worlds.move_boxes(num, task.root_entity.terrain)
  physics = env.physics
  with physics.reset_context():
    physics.data.qpos[:] = data.qpos
  random, standing = np.random.RandomState(0), data.ctrl.copy()
  for _ in range(_STEPS):
    action = standing + random.uniform(-0.6, 0.6, 10)
    data.ctrl[:] = physics.data.ctrl[:] = action
    mujoco.mj_step(model, data, nstep=substeps)
    physics.step(substeps)
    worlds.step(action[None], np.array([True]), substeps)
    # A frame of 1e-5 kg, by which Composer attaches the robot, is the rest.
    np.testing.assert_allclose(data.qpos, physics.data.qpos, atol=1e-4)
    np.testing.assert_allclose(data.qpos, worlds.qpos[0], atol=1e-4)
  assert data.qpos[2] < 1.0  # It fell upon the track, not beside it.


@pytest.mark.parametrize(
  ('arguments', 'message'),
  [
    ({'arena': 'moat'}, 'Unknown arena'),
    ({'arena': 'gap', 'sizes': {'depth': 1.0}}, 'no size'),
    ({'timestep': 0.0}, 'timestep must be positive'),
    ({'timestep': float('nan')}, 'timestep must be positive'),
  ],
)
def test_rejects(
  arguments: dict[str, Any], message: str, tmp_path: pathlib.Path
) -> None:
  with pytest.raises(ValueError, match=message):
    deployment.write_mjcf(tmp_path / 'new', **arguments)
  assert not (tmp_path / 'new').exists()


def test_another_robot(tmp_path: pathlib.Path) -> None:
  folder = pathlib.Path(__file__).parents[1] / 'robots'
  path = deployment.write_mjcf(tmp_path, robot=folder / 'four_legs.yaml')
  assert path.name == 'four_legs_flat.xml'
  model, data = _load(path)
  height = data.qpos[2]
  mujoco.mj_step(model, data, nstep=400)
  assert data.body('base').xmat[8] > 0.99
  assert data.qpos[2] == pytest.approx(height, abs=0.003)


def test_mujoco_warp_takes_it(tmp_path: pathlib.Path) -> None:
  warp = pytest.importorskip('mujoco_warp')
  model, _ = _load(deployment.write_mjcf(tmp_path, arena='gap_block'))
  assert warp.put_model(model).nq == model.nq
