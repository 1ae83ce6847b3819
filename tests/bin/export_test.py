"""Tests of dmc_multimode.bin.export."""

import json
import pathlib
from typing import Iterator

import numpy as np
import pytest

from dmc_multimode import pretrained
from tests.bin import processes


@pytest.fixture(scope='module')
def binary(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  binary = processes.Binary('export', tmp_path_factory.mktemp('output'))
  yield binary
  binary.close()


def test_the_model_acts_as_the_policy_does(
  binary: processes.Binary, tmp_path: pathlib.Path
) -> None:
  for extra in ('onnx', 'onnxscript'):
    pytest.importorskip(extra, reason='exporting takes the extra `export`')
  onnxruntime = pytest.importorskip(
    'onnxruntime', reason='the check takes the extra `export`'
  )
  out = tmp_path / 'new' / 'policy.onnx'
  done = binary('--policy=quickstart', f'--out={out}')
  assert done.code == 0, done.stderr
  assert not done.stderr
  assert f'wrote {out} ({out.stat().st_size} bytes)' in done.stdout
  assert list(out.parent.iterdir()) == [out]

  policy, session = (
    pretrained.load('quickstart'),
    onnxruntime.InferenceSession(out),
  )
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
  assert len(values) == 4
  assert values['modes'] == [motion.name for motion in policy.mode_set.motions]
  assert values['control_timestep'] == policy.config.control_timestep
  np.testing.assert_array_equal(values['latents'], policy.mode_set.latents)
  sizes = {part['name']: part['size'] for part in values['observation']}
  assert sum(sizes.values()) == size
  assert list(sizes)[:2] == ['clock', 'command']


def test_a_wrong_model_is_not_written(
  binary: processes.Binary, tmp_path: pathlib.Path
) -> None:
  out = tmp_path / 'policy.onnx'
  out.write_bytes(b'as before')
  wrong = 'binary.to_onnx = lambda policy: b""; '
  wrong += 'binary.difference = lambda policy, model: 1e-3'
  binary.start('--policy=quickstart', f'--out={out}', before=wrong)
  done = binary.wait()
  assert done.code == 2
  assert 'by 1.00e-03 rad' in done.error
  assert out.read_bytes() == b'as before'


def test_bad_input(binary: processes.Binary, tmp_path: pathlib.Path) -> None:
  for flags, message in (
    ([], 'Say what to write'),
    ([f'--out={tmp_path}'], 'is a folder'),
  ):
    done = binary(*flags)
    assert done.code == 2, done.stderr
    assert message in done.error
  binary.start(f'--out={tmp_path}/x.onnx', before="sys.modules['onnx'] = None")
  done = binary.wait()
  assert done.code == 2
  assert 'dmc_multimode[export]' in done.error
  assert not list(tmp_path.iterdir())
