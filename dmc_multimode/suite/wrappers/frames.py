"""Pictures of a task from one of its model's cameras."""

import math
import operator
from typing import Any, Sequence

import mujoco
import numpy as np

from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.utils import gl

_LARGEST = 4096  # Pixels a side: what every OpenGL can draw, software included.


class View:
  """Frames of one size from one camera, if a render mode asks for any.

  Attributes:
    mode: None, which draws nothing, or 'rgb_array'.
  """

  MODES = ('rgb_array',)

  def __init__(
    self,
    task: composer_task.Imitation,
    mode: str | None,
    width: int,
    height: int,
    camera: str,
  ):
    """Checks what can be drawn before anything is, and makes room for it.

    Args:
      task: its model gets an offscreen buffer of at least this size.
      mode: see the class.
      width, height: of a frame, pixels.
      camera: name of one of the model's.

    Raises:
      OSError: there is no OpenGL here; the message says what to install.
      ValueError: the mode or camera is unknown, or the size is none.
    """
    if mode not in (None, *self.MODES):
      raise ValueError(
        f'Unknown render mode {mode!r}: use None or "rgb_array".'
      )
    self.mode, self._camera = mode, camera
    self._size = {
      'width': _pixels('width', width),
      'height': _pixels('height', height),
    }
    root = task.root_entity.mjcf_model
    cameras = [found.full_identifier for found in root.find_all('camera')]
    if camera not in cameras:
      raise ValueError(
        f'Unknown camera {camera!r}; cameras are {", ".join(cameras)}.'
      )
    if mode is None:
      return
    gl.choose()
    self._enlarge(root.visual.get_children('global'))

  def _enlarge(self, buffer: Any) -> bool:
    """Makes an offscreen buffer, of MJCF or of a model, as large as a frame.

    Returns:
      Whether it was smaller.
    """
    small = [
      side
      for side, size in self._size.items()
      if (getattr(buffer, f'off{side}') or 0) < size
    ]
    for side in small:
      setattr(buffer, f'off{side}', self._size[side])
    return bool(small)

  def draw(self, physics: Any) -> np.ndarray:
    """Returns a frame of a Composer physics, uint8 [height, width, 3]."""
    # The model may have been compiled, and even drawn, before its buffer was
    # made larger.
    buffer = physics.model.vis.global_
    if self._enlarge(buffer):
      size = buffer.offwidth, buffer.offheight
      with physics.contexts.gl.make_current() as ctx:
        resize = mujoco.mjr_resizeOffscreen
        ctx.call(resize, *size, physics.contexts.mujoco.ptr)
    return physics.render(**self._size, camera_id=self._camera)


def _pixels(name: str, size: Any) -> int:
  """Returns a side of a frame; raises ValueError if it is none."""
  try:
    pixels = operator.index(size)
  except TypeError:
    pixels = 0
  if isinstance(size, bool) or not 0 < pixels <= _LARGEST:
    raise ValueError(
      f'{name} must be a whole number of pixels from 1 to {_LARGEST}, got '
      f'{size!r}.'
    )
  return pixels


def grid(pictures: Sequence[np.ndarray]) -> np.ndarray:
  """Returns pictures [height, width, 3] in rows, black where there is none."""
  columns = math.ceil(math.sqrt(len(pictures)))
  rows = math.ceil(len(pictures) / columns)
  missing = [np.zeros_like(pictures[0])] * (rows * columns - len(pictures))
  cells = np.stack([*pictures, *missing])
  height, width = pictures[0].shape[:2]
  cells = cells.reshape(rows, columns, height, width, 3).swapaxes(1, 2)
  return cells.reshape(rows * height, columns * width, 3)
