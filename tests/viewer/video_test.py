"""Tests of dmc_multimode.viewer.video."""

import pathlib

import av
import numpy as np
import PIL.Image
import PIL.ImageSequence
import pytest

from dmc_multimode.viewer import video


def _frame(value: int) -> np.ndarray:
  frame = np.full((16, 32, 3), 40, np.uint8)
  frame[4:12, 4:12] = value, 255 - value, 0
  return frame


def _write(path: pathlib.Path, rate: float, count: int, step: int = 2) -> None:
  with video.open_writer(path, rate) as append:
    for i in range(count):
      append(_frame(step * i))


@pytest.mark.parametrize('rate', [0.009, 10_001.0, np.inf, np.nan])
def test_rates_refused(rate: float) -> None:
  with pytest.raises(ValueError, match='0.01 to 10000 frames a second'):
    video.check_rate(rate)


@pytest.mark.parametrize('rate', [1 / 0.03, 0.25 / 0.03])
def test_mp4(tmp_path: pathlib.Path, rate: float) -> None:
  path = tmp_path / 'new' / 'video.mp4'
  _write(path, rate, 30)
  assert list(path.parent.iterdir()) == [path]
  assert path.read_bytes().find(b'moov') < path.read_bytes().find(b'mdat')
  with av.open(str(path)) as container:
    stream = container.streams.video[0]
    assert stream.codec_context.name == 'h264'
    assert stream.codec_context.pix_fmt == 'yuv420p'
    assert float(stream.average_rate or 0) == pytest.approx(rate, rel=1e-3)
    frames = [f.to_ndarray(format='rgb24') for f in container.decode(stream)]
  assert len(frames) == 30
  for i, frame in enumerate(frames):
    np.testing.assert_allclose(frame[8, 8, 0], 2 * i, atol=9)


@pytest.mark.parametrize(
  ('rate', 'count', 'step', 'kept', 'seconds'),
  [
    # The rate of the control steps.
    (1 / 0.03, 31, 8, range(0, 31, 3), 0.93),
    (7.0, 14, 18, range(14), 2.0),  # Periods that are no whole ticks.
  ],
)
def test_gif(
  tmp_path: pathlib.Path,
  rate: float,
  count: int,
  step: int,
  kept: range,
  seconds: float,
) -> None:
  """Frames differ by so much that one palette tells them apart."""
  path = video.check_path(tmp_path / 'new' / 'video.GIF')
  _write(path, rate, count, step)
  assert list(path.parent.iterdir()) == [path]
  with PIL.Image.open(path) as image:
    assert (image.format, image.size) == ('GIF', (32, 16))
    assert image.info['loop'] == 0  # For ever.
    shown, duration = [], 0
    for frame in PIL.ImageSequence.Iterator(image):
      shown.append(np.asarray(frame.convert('RGB'))[8, 8, 0])
      duration += frame.info['duration']
  assert len(shown) == len(kept)
  np.testing.assert_allclose(shown, step * np.array(kept), atol=8)
  assert duration / 1000 == pytest.approx(seconds, abs=0.005)


@pytest.mark.parametrize('name', ['video.mp4', 'video.gif'])
@pytest.mark.parametrize('count', [0, 99])  # More than an encoder holds back.
def test_a_failure_leaves_what_was_there(
  tmp_path: pathlib.Path, name: str, count: int
) -> None:
  path = tmp_path / name
  path.write_text('as before')
  with pytest.raises(KeyboardInterrupt):
    with video.open_writer(path, 30.0) as append:
      for i in range(count):
        append(_frame(i))
      raise KeyboardInterrupt
  with pytest.raises(ValueError, match='no frame'):
    _write(path, 30.0, 0)
  assert list(tmp_path.iterdir()) == [path]
  assert path.read_text() == 'as before'
