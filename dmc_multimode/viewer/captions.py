"""Text and timeline in the frames of a recording."""

import functools
from typing import NamedTuple, Sequence, TYPE_CHECKING

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont

from dmc_multimode.modes import motion

if TYPE_CHECKING:
  from dmc_multimode.arenas import track
  from dmc_multimode.viewer import rollout as rollout_lib

_INK, _FAINT, _WARNING = (22, 28, 36), (92, 102, 114), (200, 30, 30)
_SHOWN = 0.6  # Seconds for which a push, or a ledge that appears, is shown.
_GHOST = 'translucent box: reference'
_TRUNK = 'box: reference of the trunk'
_LEAST_RISE = 0.02  # Metres: lower ones are no ledge.
_PAPER = 0.72  # Opacity of the panel behind the text.
_PALETTE = (  # One colour a mode, safe for colour-blind eyes (Okabe and Ito).
  (0, 114, 178),
  (230, 130, 0),
  (0, 158, 115),
  (204, 90, 150),
  (86, 160, 220),
  (190, 80, 0),
  (120, 120, 120),
)


class Caption(NamedTuple):
  """The text of one frame; heights are those of the trunk.

  Attributes:
    mode: index of the running mode, which gives the title's colour.
    title: in large letters.
    lines: below it.
    warning: in red below those; empty for none.
  """

  mode: int
  title: str
  lines: Sequence[str]
  warning: str = ''


class Timeline(NamedTuple):
  """The bar along the lower edge.

  Attributes:
    modes: indices of the commanded modes, in their order.
    ends: when each command ends, as shares of the whole, rising to 1.
  """

  modes: Sequence[int]
  ends: Sequence[float]


def colour(mode: int) -> tuple[int, int, int]:
  """Returns the RGB colour of a mode by its index."""
  return _PALETTE[mode % len(_PALETTE)]


class _Ledges:
  """Ledges that appear while the robot is on its way: what modes ask for."""

  def __init__(self, arena: 'track.Track'):
    """Watches a track; all that is there in the first step is known."""
    self._arena = arena
    self._known: set[tuple[float, float]] | None = None
    self._text, self._until = '', -np.inf

  def lines(self, step: 'rollout_lib.Step') -> tuple[str, ...]:
    """Returns the line that announces a ledge, if one has just appeared."""
    starts, _, tops = (field[0] for field in self._arena.terrain)
    there = np.isfinite(starts)
    edges = list(zip(starts[there].tolist(), tops[there].tolist(), strict=True))
    if self._known is None:
      self._known = set(edges)
    ground, x = step.position[2] - step.height, step.position[0]
    for start, top in sorted(set(edges) - self._known):
      rise = top - ground
      if start > x and abs(rise) > _LEAST_RISE:
        kind = 'block rises' if rise > 0 else 'edge opens'
        self._text = f'{kind} {start - x:.1f} m ahead: {rise:+.2f} m'
        self._until = step.time + _SHOWN
    self._known |= set(edges)
    return (self._text,) if step.time <= self._until else ()


class Captions:
  """Draws captions and timeline of a roll-out into its frames."""

  def __init__(
    self, rollout: 'rollout_lib.Rollout', name: str = '', ghost: bool = True
  ):
    """Captions the steps of `rollout`, in order.

    Args:
      rollout: of the steps.
      name: to show above, if there is one.
      ghost: whether the reference is drawn, which the caption then explains.
    """
    self._rollout = rollout
    self._name = (name,) if name else ()
    self._ghost = (_GHOST,) if ghost else ()
    self._ledges = _Ledges(rollout.task.root_entity)
    self._names = rollout.task.mode_set.names
    self._timeline = Timeline(
      rollout.schedule.modes[0].tolist(), rollout.ends.tolist()
    )
    self._warning = ''

  def _pose(self) -> tuple[str, str]:
    """Returns how the reference is turned, and which feet are on the ground."""
    tracker = self._rollout.task.core.tracker
    reference = tracker.reference()
    tilt = motion.tilt(reference.orientation[0])
    yaw = tracker.state.heading[0] + motion.yaw(reference.orientation[0])
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    roll, pitch, yaw = np.degrees([*tilt, yaw]).round().astype(int)
    feet = 'feet free'
    if reference.has_contact[0]:
      contacts = ' '.join(f'{foot:.0f}' for foot in reference.contact[0])
      feet = f'feet on the ground {contacts}'
    return f'roll {roll}, pitch {pitch}, yaw {yaw} deg', feet

  def lines(self, step: 'rollout_lib.Step') -> tuple[str, ...]:
    """Returns the lines below the title; call it for every step in order."""
    pushes = (
      f'pushed by ({push.velocity[0]:g}, {push.velocity[1]:g}) m/s'
      for push in self._rollout.pushes
      if 0 < step.time - push.time <= _SHOWN
    )
    is_reference = step.is_reference
    return (
      *self._name,
      f'{step.time:.2f} s, {step.speed:.2f} m/s',
      *(self._pose() if is_reference else [f'reward {step.reward:.2f}']),
      f'over ground {step.height:.2f} m',
      f'over world {step.position[2]:.2f} m',
      *([_TRUNK] if is_reference else self._ghost),
      *self._ledges.lines(step),
      *pushes,
    )

  def draw(self, frame: np.ndarray, step: 'rollout_lib.Step') -> np.ndarray:
    """Returns the frame of a step with its caption, uint8 [H, W, 3]."""
    failed = step.cause != 'none' and not step.is_reference
    if failed and not self._warning:
      self._warning = f'failed at {step.time:.2f} s: {step.cause}'
    index = self._names.index(step.mode)
    caption = Caption(index, step.mode, self.lines(step), self._warning)
    total = self._rollout.num_steps * self._rollout.task.control_timestep
    return draw(frame, caption, self._timeline, step.time / total)


def draw(
  frame: np.ndarray, caption: Caption, timeline: Timeline, progress: float
) -> np.ndarray:
  """Returns a copy of a frame with caption and timeline.

  Args:
    frame: uint8 [H, W, 3].
    caption: the text.
    timeline: the schedule.
    progress: elapsed share of the recording, in [0, 1].
  """
  image = PIL.Image.fromarray(label(frame, caption))
  _bar(image, timeline, progress)
  return np.asarray(image)


def label(frame: np.ndarray, caption: Caption) -> np.ndarray:
  """Returns a copy of a frame, uint8 [H, W, 3], with a caption."""
  image = PIL.Image.fromarray(frame)
  size = max(9, round(image.height / 28))
  texts = [(caption.title, round(1.5 * size), colour(caption.mode))]
  texts += [(line, size, _INK) for line in caption.lines]
  if caption.warning:
    texts.append((caption.warning, size, _WARNING))
  _panel(image, texts, size)
  return np.asarray(image)


def _panel(
  image: PIL.Image.Image,
  texts: Sequence[tuple[str, int, tuple[int, int, int]]],
  margin: int,
) -> None:
  """Draws lines of (text, size, colour) into the upper left corner."""
  steps = [round(1.35 * size) for _, size, _ in texts]
  width = max(_font(size).getlength(text) for text, size, _ in texts)
  box = (
    margin // 2,
    margin // 2,
    min(image.width, margin // 2 + round(width) + margin),
    min(image.height, margin // 2 + sum(steps) + margin // 2),
  )
  below = image.crop(box)
  paper = PIL.Image.new('RGB', below.size, (255, 255, 255))
  image.paste(PIL.Image.blend(below, paper, _PAPER), box)
  pen, y = PIL.ImageDraw.Draw(image), margin * 3 // 4
  for (text, size, ink), step in zip(texts, steps, strict=True):
    pen.text((margin, y), text, fill=ink, font=_font(size))
    y += step


def _bar(image: PIL.Image.Image, timeline: Timeline, progress: float) -> None:
  """Draws the schedule as coloured blocks: full up to now, pale beyond."""
  pen = PIL.ImageDraw.Draw(image)
  top, bottom = image.height - max(4, image.height // 60), image.height
  now, left = progress * image.width, 0.0
  for mode, end in zip(timeline.modes, timeline.ends, strict=True):
    full = colour(mode)
    pale = tuple(255 - (255 - value) * 2 // 5 for value in full)
    right = end * image.width
    pen.rectangle((left, top, right, bottom), fill=pale)
    if now > left:
      pen.rectangle((left, top, min(now, right), bottom), fill=full)
    left = right
  half = max(1, image.height // 240)
  pen.rectangle((now - half, top - 2 * half, now + half, bottom), fill=_INK)


@functools.cache
def _font(size: int) -> PIL.ImageFont.FreeTypeFont | PIL.ImageFont.ImageFont:
  return PIL.ImageFont.load_default(size)
