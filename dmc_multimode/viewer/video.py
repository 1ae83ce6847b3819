"""Videos: H.264 by PyAV, which brings its own codecs, and GIFs by Pillow."""

import base64
import contextlib
import fractions
import math
import os
import pathlib
from typing import Any, Callable, Iterator, Sequence, TYPE_CHECKING

import numpy as np

from dmc_multimode.utils import files

if TYPE_CHECKING:
  import PIL.Image

SUFFIX, GIF_SUFFIX = '.mp4', '.gif'
MAX_SIDE = 4096  # Pixels; the limit of most players.
FRAME_RATES = (0.01, 10_000.0)  # Frames a second.
# Visually lossless, and five times faster than libx264's defaults.
_CODEC, _OPTIONS = 'libx264', {'crf': '18', 'preset': 'veryfast'}
# Playback can start before the download ends.
_CONTAINER_OPTIONS = {'movflags': '+faststart'}
_GIF_RATE = 12.5  # Largest frame rate of a GIF, frames per second.
_GIF_COLOURS = 64  # Of all frames: palettes of their own would flicker.
_GIF_SAMPLES = 1_000_000  # Pixels that the palette is chosen from, about.
_GIF_TICK = 0.01  # Seconds: unit of durations in a GIF.

# Appends a frame, uint8 [height, width, 3] in RGB.
Append = Callable[[np.ndarray], None]


def check_path(path: str | os.PathLike[str] | None) -> pathlib.Path:
  """Returns the path of a video after checking that it can be written.

  Raises:
    ValueError: no path, or another suffix than .mp4 and .gif.
    OSError: a folder, or nothing can be written there.
  """
  out = files.output_file('out', path)
  if out is None:
    raise ValueError(f'Say where to write to: --out=FILE{SUFFIX}.')
  if out.suffix.lower() not in (SUFFIX, GIF_SUFFIX):
    raise ValueError(f'{out} must end in {SUFFIX} or {GIF_SUFFIX}.')
  return out


def check_size(width: int, height: int) -> None:
  """Raises ValueError unless H.264 in yuv420p can have this size in pixels."""
  for name, value in (('width', width), ('height', height)):
    if value < 2 or value > MAX_SIDE or value % 2:
      raise ValueError(
        f'{name} must be even and within 2 and {MAX_SIDE}, got {value}.'
      )


def check_rate(frame_rate: float) -> None:
  """Raises ValueError unless videos can have this many frames a second."""
  slowest, fastest = FRAME_RATES
  if not slowest <= frame_rate <= fastest:
    raise ValueError(
      f'a video has {slowest:g} to {fastest:g} frames a second, got '
      f'{frame_rate:g}: choose another slow motion'
    )


def read_frames(path: pathlib.Path) -> Iterator[np.ndarray]:
  """Yields the frames of a video, uint8 [height, width, 3] in RGB.

  Raises:
    OSError, ValueError: there is no such file, or it is no video.
  """
  # Late: codecs take a while to load.
  import av

  with av.open(str(path)) as container:
    for frame in container.decode(container.streams.video[0]):
      yield frame.to_ndarray(format='rgb24')


def to_html(path: pathlib.Path) -> str:
  """Returns a film as an HTML element that holds all of it.

  Raises:
    OSError: it cannot be read.
  """
  content = base64.b64encode(path.read_bytes()).decode()
  if path.suffix.lower() == GIF_SUFFIX:
    return f'<img src="data:image/gif;base64,{content}">'
  return f'<video controls loop src="data:video/mp4;base64,{content}"></video>'


@contextlib.contextmanager
def open_writer(path: pathlib.Path, frame_rate: float) -> Iterator[Append]:
  """Opens a video for writing; it replaces `path` when complete.

  After an exception in the context, `path` is unchanged.

  Args:
    path: of the video, checked by `check_path`; its suffix determines the
      format. Missing folders are made.
    frame_rate: frames per second.

  Yields:
    Function that appends a frame; all have one even size.
  """
  path.parent.mkdir(parents=True, exist_ok=True)
  temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
  kind = _write_gif if path.suffix.lower() == GIF_SUFFIX else _write_mp4
  try:
    with kind(temporary, frame_rate) as append:
      yield append
    os.replace(temporary, path)
  finally:
    temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _write_mp4(path: pathlib.Path, frame_rate: float) -> Iterator[Append]:
  # Late: codecs take a while to load.
  import av

  rate = fractions.Fraction(frame_rate).limit_denominator(1000)
  with av.open(str(path), 'w', 'mp4', options=_CONTAINER_OPTIONS) as container:
    stream: Any = container.add_stream(
      _CODEC, rate=rate, options=dict(_OPTIONS)
    )
    stream.pix_fmt = 'yuv420p'

    def append(frame: np.ndarray) -> None:
      if not stream.codec_context.is_open:
        stream.height, stream.width = frame.shape[:2]
      picture = av.VideoFrame.from_ndarray(frame, format='rgb24')
      container.mux(stream.encode(picture))

    yield append
    if not stream.codec_context.is_open:
      raise ValueError('There is no frame to write.')
    container.mux(stream.encode())  # Frames still in the encoder.


@contextlib.contextmanager
def _write_gif(path: pathlib.Path, frame_rate: float) -> Iterator[Append]:
  """Opens a GIF that repeats for ever, for pages without videos.

  At higher frame rates only every second, third, ... frame is kept.
  """
  import PIL.Image

  stride, shown = math.ceil(frame_rate / _GIF_RATE), 0
  plain = PIL.Image.Dither.NONE
  kept: list[PIL.Image.Image] = []

  def append(frame: np.ndarray) -> None:
    nonlocal shown
    if shown % stride == 0:
      # RGB would take three times the memory.
      kept.append(
        PIL.Image.fromarray(frame).quantize(_GIF_COLOURS, dither=plain)
      )
    shown += 1

  yield append
  if not kept:
    raise ValueError('There is no frame to write.')
  kept = in_one_palette(kept, _GIF_COLOURS)
  starts = np.minimum(stride * np.arange(len(kept) + 1), shown) / frame_rate
  kept[0].save(
    path,
    'gif',
    save_all=True,
    append_images=kept[1:],
    duration=_durations(starts),
    loop=0,
  )


def in_one_palette(
  frames: 'Sequence[PIL.Image.Image]', colours: int
) -> 'list[PIL.Image.Image]':
  """Returns frames in the colours that serve all of them best.

  Args:
    frames: of one size; at least one.
    colours: number of colours, at most 256.
  """
  import PIL.Image

  pixels = len(frames) * frames[0].width * frames[0].height
  apart = max(round(math.sqrt(pixels / _GIF_SAMPLES)), 1)
  samples = [
    np.asarray(frame.convert('RGB'))[::apart, ::apart] for frame in frames
  ]
  # Median cut would give up the hues of what is small: legs, names of modes.
  octree = PIL.Image.Quantize.FASTOCTREE
  palette = PIL.Image.fromarray(np.concatenate(samples)).quantize(
    colours, method=octree
  )
  plain = PIL.Image.Dither.NONE  # Dithering noise compresses badly.
  return [
    frame.convert('RGB').quantize(palette=palette, dither=plain)
    for frame in frames
  ]


def _durations(times: np.ndarray) -> Sequence[int]:
  """Returns ms from each of times, s, to the next, rounded without drift."""
  ticks = np.diff(np.round(times / _GIF_TICK).astype(int))
  return (round(1000 * _GIF_TICK) * np.maximum(ticks, 1)).tolist()
