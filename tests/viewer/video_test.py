"""Tests of dmc_multimode.viewer.video: GIFs, and which writer a path gets."""

import pathlib

import numpy as np
import PIL.Image
import PIL.ImageSequence
import pytest

from dmc_multimode.viewer import video


def _frame(value: int) -> np.ndarray:
  frame = np.full((16, 32, 3), 40, np.uint8)
  frame[4:12, 4:12] = value, 255 - value, 0
  return frame


def _write(path: pathlib.Path, rate: float, count: int) -> None:
  with video.make_writer(path, 32, 16, rate) as writer:
    for i in range(count):
      writer.write(_frame(2 * i))


@pytest.mark.parametrize(
  ('rate', 'count', 'kept', 'seconds'),
  [
    (1 / 0.03, 31, range(0, 31, 3), 0.93),  # The rate of the control steps.
    (0.25 / 0.03, 10, range(10), 1.2),
    (30.0, 30, range(0, 30, 3), 1.0),
    (7.0, 14, range(14), 2.0),  # Periods that are no whole ticks.
  ],
)
def test_gif(
  tmp_path: pathlib.Path, rate: float, count: int, kept: range, seconds: float
) -> None:
  path = tmp_path / 'new' / 'video.gif'
  _write(path, rate, count)
  assert list(path.parent.iterdir()) == [path]
  with PIL.Image.open(path) as image:
    assert (image.format, image.size) == ('GIF', (32, 16))
    assert image.info['loop'] == 0  # For ever.
    shown, duration = [], 0
    for frame in PIL.ImageSequence.Iterator(image):
      shown.append(np.asarray(frame.convert('RGB'))[8, 8, 0])
      duration += frame.info['duration']
  assert len(shown) == len(kept)
  np.testing.assert_allclose(shown, 2 * np.array(kept), atol=2)
  assert duration / 1000 == pytest.approx(seconds, abs=0.005)


def test_an_interrupted_gif_leaves_what_was_there(
  tmp_path: pathlib.Path,
) -> None:
  path = tmp_path / 'video.gif'
  path.write_text('as before')
  with pytest.raises(KeyboardInterrupt):
    with video.make_writer(path, 32, 16, 10.0) as writer:
      writer.write(_frame(0))
      raise KeyboardInterrupt
  assert list(tmp_path.iterdir()) == [path]
  assert path.read_text() == 'as before'


@pytest.mark.parametrize('name', ['a.mp4', 'a.GIF', 'a.gif'])
def test_the_suffix_chooses(tmp_path: pathlib.Path, name: str) -> None:
  path = video.check_path(str(tmp_path / name))
  _write(path, 10.0, 3)
  is_gif = path.read_bytes().startswith(b'GIF8')
  assert is_gif == (name != 'a.mp4')
