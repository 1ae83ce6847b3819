"""Tests of dmc_multimode.viewer.take: videos of live sessions."""

import pathlib

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.viewer import captions
from dmc_multimode.viewer import session as session_lib
from dmc_multimode.viewer import take as take_lib
from dmc_multimode.viewer import video

_EYE = take_lib.Eye(np.array([0.0, -3.0, 1.2]), np.array([0.0, 0.0, 0.45]))


@pytest.fixture(scope='module')
def session() -> session_lib.LiveSession:
  return session_lib.LiveSession(pretrained.load('quickstart'))


def _take(session: session_lib.LiveSession, steps: int) -> take_lib.Take:
  take = take_lib.Take(session.robot)
  for i in range(steps):
    step = session.step().step
    if i == steps // 2:
      session.set_arena('gap_block')  # With other ground, of the same robot.
    take.add(
      session.robot, captions.Caption(i % 2, step.mode, ['a line']), _EYE
    )
  return take


@pytest.mark.gl
def test_a_take_becomes_a_video(
  session: session_lib.LiveSession, tmp_path: pathlib.Path
) -> None:
  session.set_arena('flat')
  take = _take(session, 8)
  assert take.seconds == pytest.approx(0.24)
  out = tmp_path / 'take.mp4'
  out.write_bytes(take.draw().result())
  frames = list(video.read_frames(out))
  assert [frame.shape for frame in frames] == [(540, 960, 3)] * 8
  seen = np.stack(frames).astype(int)
  assert seen.std(axis=(1, 2, 3)).min() > 10  # No frame is of one colour.
  # The block of the other track comes into view, and the robot stays in it.
  assert np.abs(seen[4] - seen[3]).mean() > 2
  assert np.abs(seen[1] - seen[0]).mean() < 2


def test_what_cannot_be_drawn_is_told(
  session: session_lib.LiveSession, monkeypatch: pytest.MonkeyPatch
) -> None:
  with pytest.raises(ValueError, match='no step'):
    take_lib.Take(session.robot).draw()
  monkeypatch.setenv('MUJOCO_GL', 'no_such')
  take = _take(session, 1)
  with pytest.raises(OSError, match='could not be drawn: MUJOCO_GL=no_such'):
    take.draw().result()
  drawing = take.draw()
  drawing.close()
  assert drawing.done
