"""H.264 videos by PyAV, which brings its own codecs: no ffmpeg is needed."""

import fractions
import os
import pathlib
import tempfile
from types import TracebackType
from typing import Self

import av
import av.video.stream
import numpy as np

SUFFIX = '.mp4'
MAX_SIDE = 4096  # Pixels; beyond it few players go.
# Visually lossless, and five times faster than libx264's defaults.
_CODEC, _OPTIONS = 'libx264', {'crf': '18', 'preset': 'veryfast'}
# Lets a player begin before it has the whole file.
_CONTAINER_OPTIONS = {'movflags': '+faststart'}


def check_path(path: str | None) -> pathlib.Path:
  """Returns where a video goes, without creating anything that stays.

  Raises:
    ValueError: no path, a folder, or another suffix than .mp4.
    OSError: nothing can be written there.
  """
  if not path:
    raise ValueError(f'Say where to write to: --out=FILE{SUFFIX}.')
  out = pathlib.Path(path).expanduser()
  if out.suffix.lower() != SUFFIX:
    raise ValueError(f'{out} must end in {SUFFIX}.')
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
