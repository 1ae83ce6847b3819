"""Progress bars; in logs, lines."""

import sys
import time
from typing import Any

import tqdm

_EVERY = 30.0  # Seconds between two lines.
_COUNTS = '{n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]'
_LINE = '{desc}: {percentage:3.0f}% ' + _COUNTS  # tqdm's, without the bar.


class Bar(tqdm.tqdm):
  """tqdm's bar; where stderr is no terminal, plain lines.

  A file would keep every state of a bar, all in one line. It gets a line every
  half a minute and one at the end instead. Notebooks draw bars.
  """

  def __init__(self, *args: Any, **kwargs: Any):
    """Takes the arguments of tqdm; the bar is on stderr."""
    self._is_drawn = sys.stderr.isatty() or 'ipykernel' in sys.modules
    self._due = time.monotonic() + _EVERY
    if not self._is_drawn:
      kwargs['bar_format'] = kwargs.get('bar_format') or _LINE
    super().__init__(*args, **kwargs)

  def display(self, msg: str | None = None, pos: int | None = None) -> None:
    """Draws the bar, or writes a line if one is due."""
    if self._is_drawn:
      super().display(msg, pos)
      return
    if self.total:  # Beyond it tqdm would forget it.
      self.total = max(self.total, self.n)
    is_closing = self.disable  # And `close` ends the line.
    now = time.monotonic()
    if is_closing or now >= self._due:
      self.fp.write(str(self) + '\n' * (not is_closing))
      self.fp.flush()
      self._due = now + _EVERY

  def clear(self, nolock: bool = False) -> None:
    """Removes the bar for a message; lines stay."""
    if self._is_drawn:
      super().clear(nolock)
