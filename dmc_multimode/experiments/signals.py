"""Signals that end a training after its iteration, with a checkpoint."""

import signal
import threading
from typing import Any


class Stop:
  """Context in which the first SIGINT or SIGTERM ends the loop."""

  _SIGNALS = (signal.SIGINT, signal.SIGTERM)

  def __init__(self) -> None:
    self.asked = False
    self._before: dict[int, Any] = {}

  def __enter__(self) -> 'Stop':
    # Python delivers signals to the main thread only.
    if threading.current_thread() is threading.main_thread():
      for number in self._SIGNALS:
        self._before[number] = signal.signal(number, self._handle)
    return self

  def __exit__(self, *error: object) -> None:
    for number, handler in self._before.items():
      signal.signal(number, handler)

  def _handle(self, number: int, frame: Any) -> None:
    del frame
    self.asked = True
    # A second signal ends the process at once.
    signal.signal(number, signal.SIG_DFL)

  def __call__(self) -> bool:
    """Returns True once a signal has come."""
    return self.asked
