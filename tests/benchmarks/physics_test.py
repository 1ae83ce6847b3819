"""Tests of benchmarks.physics and of the variants that it compares."""

import functools
import json
import pathlib
from typing import Any

import mujoco
import numpy as np
import pytest

from benchmarks import physics_variants as variants_lib
from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.suite import batched
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes
from dmc_multimode.suite import imitation
from dmc_multimode.suite import mini_biped
from dmc_multimode.suite import multimode_biped
from tests.bin import processes
from tests.bin import untrained

_CONFIG = config_lib.ImitationConfig()
_FEET = [name for name in variants_lib.VARIANTS if name.startswith('feet_')]
_MOTIONS = library.resolve('idle')


@functools.cache
def _compile(name: str) -> tuple[imitation.Imitation, mujoco.MjModel]:
  """The task and the model of a variant."""
  variant = variants_lib.VARIANTS[name]
  task = multimode_biped.make_task(
    _MOTIONS,
    codebook.one_hot(_MOTIONS),
    episodes.ScheduledEpisodes(schedule.single(np.zeros(1, dtype=np.int64))),
    config=variant.configure(_CONFIG),
  )
  for edit in variant.edits:
    edit(task)
  return task, variant.remodel(task, batched._compile(task))


def _stand(name: str, seconds: float = 0.12) -> mujoco.MjData:
  """Lets the robot of a variant stand on the ground for a moment."""
  task, model = _compile(name)
  data = mujoco.MjData(model)
  (ground, *_) = (model.geom(g.full_identifier) for g in _grounds(task))
  data.mocap_pos[model.body_mocapid[ground.bodyid[0]], 2] = -ground.size[2]
  data.qpos[2] = library.STAND_HEIGHT
  data.ctrl[:] = mini_biped.standing_action(model)
  for _ in range(round(seconds / model.opt.timestep)):
    mujoco.mj_step(model, data)
  return data


def _grounds(task: imitation.Imitation) -> tuple[Any, ...]:
  return task.root_entity.ground_geoms


@pytest.mark.parametrize('name', variants_lib.VARIANTS)
def test_robot_stands(name: str) -> None:
  data = _stand(name)
  np.testing.assert_allclose(data.qpos[2], library.STAND_HEIGHT, atol=0.03)
  np.testing.assert_allclose(data.sensordata.sum(), 14.05 * 9.81, rtol=0.6)


def test_default_is_the_default() -> None:
  task, model = _compile(variants_lib.DEFAULT)
  plain = batched._compile(task)
  assert model.opt.timestep == plain.opt.timestep == _CONFIG.physics_timestep
  np.testing.assert_array_equal(model.geom_size, plain.geom_size)


def test_pairs_change_no_bit() -> None:
  data, other = _stand(variants_lib.DEFAULT), _stand('exact')
  np.testing.assert_array_equal(data.qpos, other.qpos)
  np.testing.assert_array_equal(data.qvel, other.qvel)
  assert data.ncon == other.ncon > 0


def test_every_geom_of_the_robot_has_a_pair_with_every_ground() -> None:
  task, model = _compile('pairs')
  _, default = _compile(variants_lib.DEFAULT)
  robot = np.flatnonzero(default.geom_contype)
  assert model.npair == len(robot) * len(_grounds(task))
  assert not (model.body_contype | model.body_conaffinity).any()


@pytest.mark.parametrize('name', _FEET)
def test_soles_are_as_low_as_the_box(name: str) -> None:
  heights = np.zeros(2)
  for i, variant in enumerate((variants_lib.DEFAULT, name)):
    _, model = _compile(variant)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    foot = model.body('walker/left_foot').id
    geoms = np.flatnonzero(model.geom_bodyid == foot)
    radii = model.geom_size[geoms, 2 if variant == variants_lib.DEFAULT else 0]
    lowest = data.geom_xpos[geoms, 2] - radii
    np.testing.assert_allclose(lowest, lowest[0], atol=1e-6)
    heights[i] = lowest[0]
  np.testing.assert_allclose(heights[0], heights[1], atol=1e-6)


def test_box_limbs_are_as_long_as_the_capsules() -> None:
  limb = 'walker/right_calf'
  default, boxes = _compile(variants_lib.DEFAULT)[1], _compile('box_limbs')[1]
  radius, half, _ = default.geom(limb).size
  np.testing.assert_allclose(
    boxes.geom(limb).size, [radius, radius, half + radius]
  )
  np.testing.assert_allclose(boxes.geom(limb).pos, default.geom(limb).pos)


def test_visuals_are_there() -> None:
  task, model = _compile('visuals')
  assert model.ngeom > batched._compile(task).ngeom
  assert model.ncam and model.nlight


def test_servo_inertia_is_that_of_the_physics_step() -> None:
  for name in ('inertia', 'inertia_7.5ms'):
    _, model = _compile(name)
    expected = 30 * model.opt.timestep**2
    np.testing.assert_allclose(model.dof_armature[6:], expected)
    np.testing.assert_array_equal(model.dof_armature[:6], 0)


def test_joint_damping_replaces_that_of_the_servos() -> None:
  _, default = _compile(variants_lib.DEFAULT)
  _, model = _compile('euler_joint_damping')
  assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
  np.testing.assert_array_equal(model.actuator_biasprm[:, 2], 0)
  np.testing.assert_allclose(
    model.dof_damping[6:], default.dof_damping[6:] + 0.5
  )


def test_combination_has_all_the_changes() -> None:
  variant = variants_lib.combine(
    variants_lib.Variant(timestep=0.006, profiler=False),
    variants_lib.VARIANTS['inertia'],
    variants_lib.Variant(timestep=0.01),
  )
  assert variant.edits == variants_lib.VARIANTS['inertia'].edits
  assert variant.configure(_CONFIG).physics_timestep == 0.01
  assert not variant.profiler


def test_profiler() -> None:
  _, model = _compile(variants_lib.DEFAULT)
  spent = []
  for on in (True, False, True):
    variants_lib.set_profiler(on)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    spent.append(data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration)
  assert spent[0] > 0 and spent[1] == 0 and spent[2] > 0


# The benchmark, in processes of its own: flags are global.

_TINY = (
  '--num_worlds=2',
  '--rounds=2',
  '--seconds=0.001',
  '--episodes=1',
)


@pytest.fixture(scope='module')
def policy(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The folder of an untrained policy, for episodes of 0.3 seconds."""
  folder = tmp_path_factory.mktemp('policy')
  task = config_lib.ImitationConfig(time_limit=0.3)
  untrained.save(folder, ('idle', 'walk_forward'), task, {})
  return folder


def test_report(
  benchmark: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  out, judged = tmp_path / 'physics.json', tmp_path / 'report.json'
  names = ['default', 'exact', 'feet_capsule']
  done = benchmark(
    *_TINY,
    f'--policy={policy}',
    '--variants=exact,feet_capsule',
    f'--out={out}',
  )
  assert done.code == 0, done.stderr
  report = json.loads(out.read_text())
  default, exact, capsule = report['table']
  assert [row['name'] for row in report['table']] == names
  for row, line in zip(
    report['table'], done.stdout.splitlines()[-3:], strict=True
  ):
    assert line.startswith(row['name'])
    assert row['steps_per_second'] > 0
    low, high = row['ratio_range']
    assert 0 < low <= high
  assert default['ratio'] == 1
  same = ['rows', 'contacts', 'iterations', 'mra_transitions']
  same += ['trunk_error', 'joint_error']
  assert {key: exact[key] for key in same} == {
    key: default[key] for key in same
  }
  assert capsule['rows'] < default['rows']
  assert 0 < default['joint_error'] != capsule['joint_error'] < 1

  evaluate = processes.Binary('evaluate', tmp_path)
  assert not evaluate(
    f'--policy={policy}', '--episodes=1', f'--out={judged}'
  ).code
  evaluate.close()
  scores = json.loads(judged.read_text())
  for kind in ('modes', 'transitions'):
    assert default[f'mra_{kind}'] == scores[f'mra_{kind}']['mean']
    assert default[f'survival_{kind}'] == scores[f'survival_{kind}']


@pytest.mark.parametrize(
  ('flag', 'message'),
  [
    ('--variants=exact,softer', "there is no 'softer'; there are default, "),
    ('--out={tmp}/none/physics.json', 'there is no folder'),
    ('--policy={tmp}/none', 'no pretrained named'),
    ('--physics_timestep=0.007', 'must divide'),
  ],
)
def test_bad_input(
  benchmark: processes.Binary,
  tmp_path: pathlib.Path,
  flag: str,
  message: str,
) -> None:
  done = benchmark(*_TINY, flag.format(tmp=tmp_path))
  assert done.code == 2, done.stderr
  assert message in done.error
