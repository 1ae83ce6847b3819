"""Videos: H.264 by PyAV, which brings its own codecs, and GIF by Pillow."""

import fractions
import io
import math
import os
import pathlib
import tempfile
from types import TracebackType
from typing import Protocol, Self

import av
import av.video.stream
import numpy as np
import PIL.Image

from dmc_multimode.utils import files

SUFFIX, GIF_SUFFIX = '.mp4', '.gif'
MAX_SIDE = 4096  # Pixels; beyond it few players go.
# Visually lossless, and five times faster than libx264's defaults.
_CODEC, _OPTIONS = 'libx264', {'crf': '18', 'preset': 'veryfast'}
# Lets a player begin before it has the whole file.
_CONTAINER_OPTIONS = {'movflags': '+faststart'}
_GIF_RATE = 12.5  # Frames per second at most: a GIF grows with each of them.
_GIF_COLOURS = 64  # Of each frame.
_GIF_TICK = 0.01  # Seconds: what durations in a GIF are multiples of.


def check_path(path: str | None) -> pathlib.Path:
  """Returns where a video goes, without creating anything that stays.

  Raises:
    ValueError: no path, a folder, or another suffix than .mp4 and .gif.
    OSError: nothing can be written there.
  """
  if not path:
    raise ValueError(f'Say where to write to: --out=FILE{SUFFIX}.')
  out = pathlib.Path(path).expanduser()
  if out.suffix.lower() not in (SUFFIX, GIF_SUFFIX):
    raise ValueError(f'{out} must end in {SUFFIX} or {GIF_SUFFIX}.')
  if out.is_dir():
    raise ValueError(f'{out} is a folder; name a file.')
  folder = out.absolute().parent
  while not folder.exists():  # It is made once there is something to write.
    folder = folder.parent
  if not folder.is_dir():
    raise NotADirectoryError(f'Not a directory: {folder}')
  with tempfile.TemporaryFile(dir=folder):
    return out


def check_size(width: int, height: int) -> None:
  """Raises ValueError unless H.264 in yuv420p can have this size in pixels."""
  for name, value in (('width', width), ('height', height)):
    if value < 2 or value > MAX_SIDE or value % 2:
      raise ValueError(
        f'{name} must be even and within 2 and {MAX_SIDE}, got {value}.'
      )


class Writer(Protocol):
  """Takes frames; see `make_writer`."""

  def __enter__(self) -> Self:
    """Begins the file."""

  def write(self, frame: np.ndarray) -> None:
    """Appends a frame, uint8 [height, width, 3] in RGB."""

  def __exit__(
    self,
    kind: type[BaseException] | None,
    error: BaseException | None,
    traceback: TracebackType | None,
  ) -> None:
    """Ends the file; after an exception, as if there had never been one."""


def make_writer(
  path: pathlib.Path, width: int, height: int, frame_rate: float
) -> Writer:
  """Returns what writes a video of the kind that the path's suffix names.

  Args:
    path: of the video, checked by `check_path`; missing folders are made.
    width, height: pixels, even.
    frame_rate: frames per second.
  """
  if path.suffix.lower() == GIF_SUFFIX:
    return GifWriter(path, frame_rate)
  return VideoWriter(path, width, height, frame_rate)


class VideoWriter:
  """Writes a video beside its place and moves it there at the end.

  A context manager: leaving it by an exception removes what was written, so
  that `path` holds what it held before.
  """

  def __init__(
    self, path: pathlib.Path, width: int, height: int, frame_rate: float
  ):
    """Prepares a video; nothing is written before it is entered.

    Args:
      path: of the video; missing folders are made.
      width, height: pixels, even.
      frame_rate: frames per second.
    """
    self._path = path
    self._temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
    self._width, self._height = width, height
    self._rate = fractions.Fraction(frame_rate).limit_denominator(1000)

  def __enter__(self) -> Self:
    self._path.parent.mkdir(parents=True, exist_ok=True)
    try:
      self._container = av.open(
        str(self._temporary), 'w', 'mp4', options=_CONTAINER_OPTIONS
      )
      stream = self._container.add_stream(
        _CODEC, rate=self._rate, options=dict(_OPTIONS)
      )
      assert isinstance(stream, av.video.stream.VideoStream)
      stream.width, stream.height = self._width, self._height
      stream.pix_fmt = 'yuv420p'
      self._stream = stream
    except BaseException:
      self._temporary.unlink(missing_ok=True)
      raise
    return self

  def write(self, frame: np.ndarray) -> None:
    """Appends a frame, uint8 [height, width, 3] in RGB."""
    picture = av.VideoFrame.from_ndarray(frame, format='rgb24')
    self._container.mux(self._stream.encode(picture))

  def __exit__(
    self,
    kind: type[BaseException] | None,
    error: BaseException | None,
    traceback: TracebackType | None,
  ) -> None:
    try:
      if kind is None:
        self._container.mux(self._stream.encode())  # What the encoder holds.
      self._container.close()
      if kind is None:
        os.replace(self._temporary, self._path)
    finally:
      self._temporary.unlink(missing_ok=True)


class GifWriter:
  """Writes a GIF that repeats for ever, for pages that play no videos.

  A context manager like `VideoWriter`. Of frames that come faster than a GIF
  bears, only every second, third, ... is kept.
  """

  def __init__(self, path: pathlib.Path, frame_rate: float):
    """Prepares a GIF; nothing is written before the end.

    Args:
      path: of the GIF; missing folders are made.
      frame_rate: frames per second that `write` gets.
    """
    self._path, self._period = path, 1 / frame_rate
    self._stride = math.ceil(frame_rate / _GIF_RATE)
    self._count = 0
    self._kept: list[PIL.Image.Image] = []

  def __enter__(self) -> Self:
    self._path.parent.mkdir(parents=True, exist_ok=True)
    return self

  def write(self, frame: np.ndarray) -> None:
    """Takes a frame, uint8 [height, width, 3] in RGB."""
    if self._count % self._stride == 0:
      picture = PIL.Image.fromarray(frame)
      plain = PIL.Image.Dither.NONE  # Noise is what a GIF compresses worst.
      self._kept.append(picture.quantize(_GIF_COLOURS, dither=plain))
    self._count += 1

  def __exit__(
    self,
    kind: type[BaseException] | None,
    error: BaseException | None,
    traceback: TracebackType | None,
  ) -> None:
    if kind is not None or not self._kept:
      return
    content = io.BytesIO()
    first, *others = self._kept
    first.save(
      content,
      'gif',
      save_all=True,
      append_images=others,
      duration=self._durations(),
      loop=0,
    )
    files.write(self._path, content.getvalue())

  def _durations(self) -> list[int]:
    """Returns how long each kept frame is shown, ms, rounded without drift."""
    shown = self._stride * np.arange(len(self._kept) + 1)
    times = self._period * np.minimum(shown, self._count)
    ticks = np.diff(np.round(times / _GIF_TICK).astype(int))
    return (round(1000 * _GIF_TICK) * np.maximum(ticks, 1)).tolist()
