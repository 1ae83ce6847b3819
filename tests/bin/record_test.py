"""Tests of dmc_multimode.bin.record.

Flags are global and binaries share names of theirs, so `record` runs in another
process: one for all its command lines, because importing takes longest.
"""

import json
import os
import pathlib
import subprocess
import sys
from typing import Callable, Iterator, NamedTuple

import av
import numpy as np
import pytest

from dmc_multimode.suite.imitation import config as task_config
from tests.bin import untrained

_ROOT = pathlib.Path(__file__).parents[2]
_MODES = ('walk_forward', 'leap_forward')
_SCHEDULE = '--schedule=walk_forward:0.3,leap_forward:0.21'
_FRAMES, _WIDTH, _HEIGHT = 17, 160, 120
_SMALL = (f'--width={_WIDTH}', f'--height={_HEIGHT}')

# Answers command lines on stdin, JSON lists, with [code, stdout, stderr].
_SERVER = """
import contextlib, io, json, sys
from absl import flags
from dmc_multimode.bin import app, record
from dmc_multimode.viewer import gl
gl.choose_backend = lambda: None  # The caller has done it.
OWN = flags.FLAGS.flags_by_module_dict()[record.__name__]
for line in sys.stdin:
  for flag in OWN:
    flag.unparse()
  out, err = io.StringIO(), io.StringIO()
  with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
    try:
      app.run(record.main, ['record', *json.loads(line)])
    except SystemExit as exit:
      code = exit.code or 0
  print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""


class _Done(NamedTuple):
  code: int
  stdout: str
  stderr: str


_Record = Callable[..., _Done]


@pytest.fixture(scope='module')
def record() -> Iterator[_Record]:
  """Runs the binary with the arguments that it is given."""
  server = subprocess.Popen(
    [sys.executable, '-c', _SERVER],
    stdin=subprocess.PIPE,
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
    cwd=_ROOT,
  )
  assert server.stdin and server.stdout and server.stderr
  requests, answers = server.stdin, server.stdout

  def run(*args: str) -> _Done:
    print(json.dumps(args), file=requests, flush=True)
    answer = answers.readline()
    assert answer, 'the process has died'
    return _Done(*json.loads(answer))

  yield run
  requests.close()
  noise = server.stderr.read()
  server.wait()
  assert not noise  # Of logs, above all.


def _decode(path: pathlib.Path) -> tuple[np.ndarray, float]:
  """Frames [T, H, W, 3] and their rate."""
  with av.open(str(path)) as container:
    stream = container.streams.video[0]
    assert stream.codec_context.name == 'h264'
    assert stream.codec_context.pix_fmt == 'yuv420p'
    frames = [f.to_ndarray(format='rgb24') for f in container.decode(stream)]
    assert stream.average_rate is not None
    return np.stack(frames).astype(int), float(stream.average_rate)


@pytest.fixture(scope='module')
def policy(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The folder of an untrained policy."""
  folder = tmp_path_factory.mktemp('policy')
  untrained.save(folder, _MODES, task_config.ImitationConfig(), {})
  return folder


@pytest.mark.gl
def test_video(
  record: _Record, policy: pathlib.Path, tmp_path: pathlib.Path
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
  assert wrote == f'wrote {out} ({_FRAMES} frames)'

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
def test_goes_on_after_a_fall(
  record: _Record, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  # An untrained robot soon stays behind its reference.
  arguments = (
    f'--policy={policy}',
    '--schedule=walk_forward:0.75,leap_forward:0.15',
    '--arena=gap',
    '--camera=egocentric',
    '--physics_timestep=0.01',
    '--width=64',
    '--height=48',
  )
  done = record(*arguments, f'--out={tmp_path / "on.mp4"}')
  assert done.code == 0, done.stderr
  assert 'walk_forward: failed (' in done.stdout
  assert '(30 frames)' in done.stdout
  done = record(*arguments, f'--out={tmp_path / "end.mp4"}', '--terminate')
  assert done.code == 0, done.stderr
  assert 'leap_forward: not reached' in done.stdout
  assert len(_decode(tmp_path / 'end.mp4')[0]) < 30


# What is wrong with it, and what the message must name.
_BAD = (
  (('--policy=nobody',), 'nobody'),
  (('--policy=',), '--policy'),
  (('--schedule=fly:1',), 'fly'),
  (('--schedule=idle:1',), 'idle'),  # A mode, yet none of this policy's.
  (('--schedule=walk_forward:0.001',), 'control step'),
  (('--arena=moon',), 'moon'),
  (('--camera=nowhere',), 'nowhere'),
  (('--width=161',), 'width'),
  (('--slow_motion=0',), 'slow_motion'),
  (('--out=video.avi',), '.mp4'),
  ((f'--out={__file__}/below/video.mp4',), 'record_test.py'),
)


@pytest.mark.gl
def test_bad_input(
  record: _Record, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  good = (f'--policy={policy}', f'--out={tmp_path / "new" / "v.mp4"}')
  for wrong, message in _BAD:
    done = record(*good, _SCHEDULE, *wrong)
    assert done.code == 2, (wrong, done.stderr)
    [line] = done.stderr.splitlines()
    assert line.startswith('error: ') and message in line, (wrong, line)
  assert not list(tmp_path.iterdir())


def test_no_gl(tmp_path: pathlib.Path) -> None:
  done = subprocess.run(
    [
      *(sys.executable, '-m', 'dmc_multimode.bin.record', '--policy=any'),
      f'--out={tmp_path / "new" / "v.mp4"}',
    ],
    capture_output=True,
    text=True,
    cwd=_ROOT,
    env={
      **os.environ,
      '__EGL_VENDOR_LIBRARY_DIRS': '/nonexistent',
      'MUJOCO_GL': 'egl',
    },
  )
  assert done.returncode == 2
  [line] = done.stderr.splitlines()
  assert line.startswith('error: ') and 'libegl1' in line
  assert not list(tmp_path.iterdir())
