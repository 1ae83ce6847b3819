"""Tests of dmc_multimode.bin.record; what it draws: `viewer/recording_test`."""

import pathlib
from typing import Iterator

import av
import numpy as np
import pytest

from dmc_multimode.suite.imitation import config as task_config
from tests.bin import processes
from tests.bin import untrained

_MODES = ('walk_forward', 'leap_forward')
_SCHEDULE = '--schedule=walk_forward:0.3,leap_forward:0.21'
_FRAMES, _WIDTH, _HEIGHT = 17, 160, 120
_SMALL = (f'--width={_WIDTH}', f'--height={_HEIGHT}')
# The imports cost seconds.
_WARM_UP = """
from dmc_multimode import pretrained
from dmc_multimode.viewer import camera, rollout
"""


@pytest.fixture(scope='module')
def record(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  folder = tmp_path_factory.mktemp('output')
  binary = processes.Binary('record', folder, _WARM_UP)
  yield binary
  binary.close()


@pytest.fixture(scope='module')
def policy(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The folder of an untrained policy."""
  folder = tmp_path_factory.mktemp('policy')
  untrained.save(folder, _MODES, task_config.ImitationConfig(), {})
  return folder


def _decode(path: pathlib.Path) -> tuple[np.ndarray, float]:
  """Frames [T, H, W, 3] and their rate."""
  with av.open(str(path)) as container:
    stream = container.streams.video[0]
    frames = [f.to_ndarray(format='rgb24') for f in container.decode(stream)]
    assert stream.average_rate is not None
    return np.stack(frames).astype(int), float(stream.average_rate)


@pytest.mark.gl
@pytest.mark.slow
def test_video(
  record: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  out = tmp_path / 'new' / 'video.mp4'
  arguments = (f'--policy={policy}', _SCHEDULE, *_SMALL)
  done = record(*arguments, f'--out={out}')
  assert done.code == 0, done.stderr
  assert f'{_FRAMES}/{_FRAMES}' in done.stderr  # The progress bar.
  walk, leap, wrote = done.stdout.splitlines()
  for line, mode in ((walk, 'walk_forward'), (leap, 'leap_forward')):
    assert line.startswith(mode)
    assert 'mean speed' in line and 'peak height' in line
  assert wrote == f'wrote {out} ({_FRAMES} control steps)'

  frames, rate = _decode(out)
  assert frames.shape == (_FRAMES, _HEIGHT, _WIDTH, 3)
  assert rate == pytest.approx(1 / 0.03, rel=1e-3)
  assert all(frame.std() > 10 for frame in frames)
  centre = frames[:, 30:110, 40:120]
  assert all(np.abs(np.diff(centre, axis=0)).mean(axis=(1, 2, 3)) > 0.1)

  plain = tmp_path / 'plain.mp4'
  done = record(*arguments, f'--out={plain}', '--noghost', '--slow_motion=4')
  assert done.stdout.splitlines()[:2] == [walk, leap]  # Physics as before.
  others, rate = _decode(plain)
  assert rate == pytest.approx(0.25 / 0.03, rel=1e-3)
  ghost = np.abs(others - frames).max(axis=-1) > 20
  assert ghost.sum(axis=(1, 2))[-5:].min() > 20
  assert sorted(tmp_path.rglob('*')) == sorted([out.parent, out, plain])


@pytest.mark.gl
@pytest.mark.slow
def test_goes_on_after_a_fall(
  record: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  # An untrained robot soon stays behind its reference.
  arguments = (
    *(f'--policy={policy}', '--schedule=walk_forward:0.75,leap_forward:0.15'),
    *('--arena=gap', '--camera=egocentric', '--physics_timestep=0.01'),
    *('--width=64', '--height=48'),
  )
  done = record(*arguments, f'--out={tmp_path / "on.mp4"}')
  assert done.code == 0, done.stderr
  assert 'walk_forward: failed (' in done.stdout
  assert '(30 control steps)' in done.stdout
  done = record(*arguments, f'--out={tmp_path / "end.mp4"}', '--terminate')
  assert done.code == 0, done.stderr
  assert 'leap_forward: not reached' in done.stdout
  assert len(_decode(tmp_path / 'end.mp4')[0]) < 30


@pytest.mark.gl
@pytest.mark.parametrize(
  ('flag', 'message'),
  [
    ('--policy=nobody', 'nobody'),
    ('--schedule=idle:1', 'idle'),  # A mode, yet none of this policy's.
    ('--camera=nowhere', 'nowhere'),
    (f'--out={__file__}/below/video.mp4', 'record_test.py'),
  ],
)
def test_bad_input(
  record: processes.Binary,
  policy: pathlib.Path,
  tmp_path: pathlib.Path,
  flag: str,
  message: str,
) -> None:
  good = (f'--policy={policy}', f'--out={tmp_path / "new" / "v.mp4"}')
  done = record(*good, _SCHEDULE, flag)
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not list(tmp_path.iterdir())


def test_no_gl(tmp_path: pathlib.Path) -> None:
  record = processes.Binary('record', tmp_path)
  nothing = {'__EGL_VENDOR_LIBRARY_DIRS': '/nonexistent', 'MUJOCO_GL': 'egl'}
  out = tmp_path / 'new' / 'v.mp4'
  record.start(
    *('--policy=quickstart', f'--out={out}'),
    before=f'os.environ.update({nothing!r})',
  )
  done = record.wait()
  record.close()
  assert done.code == 2
  assert 'libegl1' in done.error
  assert not out.parent.exists()
