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

from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import solver
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.viewer import recording
from dmc_multimode.viewer import robot
from dmc_multimode.viewer import rollout
from dmc_multimode.viewer import video
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


def test_pushes_as_in_the_plan() -> None:
  """The video's engine goes where the planner's does, bit for bit."""
  policy = pretrained.load('quickstart')
  pushes = (
    pushes_lib.Push(0.3, (-0.6, 0.2, 0.0)),
    pushes_lib.Push(0.0, (0.2, 0.0, 0.0)),
  )
  plan = plan_lib.ModePlan(('walk_forward', 'walk_forward', 'idle'), 0.3)
  planned = solver.replay(
    policy,
    track.make('flat'),
    reaching.ReachingConfig((0.5, 0.0, 0.5), 3, 0.3, seed=4),
    plan,
    pushes,
  )
  names, durations = plan.segments()
  for pushed in (pushes, ()):
    roll = rollout.Rollout(
      policy,
      rollout.RolloutConfig(
        tuple(names), tuple(durations), seed=4, pushes=pushed
      ),
    )
    roll.start()
    path = np.array([step.position for step in roll.steps()])
    same = np.array_equal(path, planned.paths[0])
    assert same == bool(pushed)


def test_pushes_are_written_into_the_frames() -> None:
  policy = pretrained.load('quickstart')
  roll = rollout.Rollout(
    policy,
    rollout.RolloutConfig(
      ('idle',), (1.2,), pushes=(pushes_lib.Push(0.3, (0.5, 0.0, 0.0)),)
    ),
  )
  captions, frame = recording.Captions(roll), np.zeros((240, 320, 3), np.uint8)
  step = robot.Step(0, 0.0, 'idle', np.zeros(3), 0.5, 0.5, 0.0, 1.0, 'none')
  texts = {
    time: captions.draw(frame, step._replace(time=time))[:220]
    for time in (0.29, 0.33, 0.89, 0.95)
  }
  heights = [(text > 0).any(axis=(1, 2)).sum() for text in texts.values()]
  assert heights[1] == heights[2] > heights[0] == heights[3]


# What is wrong with it, and what the message must name.
_BAD = (
  (('--policy=nobody',), 'nobody'),
  (('--policy=',), '--policy'),
  (('--schedule=fly:1',), 'fly'),
  (('--schedule=idle:1',), 'idle'),  # A mode, yet none of this policy's.
  (('--schedule=walk_forward',), 'walk_forward'),
  (('--schedule=walk_forward:-1',), 'walk_forward:-1'),
  (('--schedule=walk_forward:0.001',), 'control step'),
  (('--arena=moon',), 'moon'),
  (('--camera=nowhere',), 'nowhere'),
  (('--width=161',), 'width'),
  (('--height=0',), 'height'),
  (('--clock_rate=0',), 'Clock rates'),
  (('--seed=-1',), 'seed'),
  (('--slow_motion=0',), 'slow_motion'),
  (('--physics_timestep=0.02',), 'physics_timestep'),
  (('--out=video.avi',), '.mp4'),
  (('--out=',), '--out'),
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


def test_a_failure_leaves_no_file(tmp_path: pathlib.Path) -> None:
  out = tmp_path / 'v.mp4'
  out.write_text('as before')
  with pytest.raises(KeyboardInterrupt):
    with video.VideoWriter(out, 32, 16, 30.0) as writer:
      for _ in range(99):  # More than the encoder holds back.
        writer.write(np.zeros((16, 32, 3), np.uint8))
      assert len(list(tmp_path.iterdir())) == 2
      raise KeyboardInterrupt
  assert list(tmp_path.iterdir()) == [out]
  assert out.read_text() == 'as before'
