"""Controls of the page: buttons, sliders and keys.

viser calls back from its own threads. A control takes its value there, and asks
for what is to be done with it; the session's thread does it.
"""

import functools
from typing import Any, Callable, Sequence

import numpy as np
import viser

from dmc_multimode.modes import motion
from dmc_multimode.viewer import captions
from dmc_multimode.viewer import disturbing
from dmc_multimode.viewer import session as session_lib

_KINDS = {  # In the order of the page.
  motion.STEADY: 'steady modes: one pose',
  motion.PERIODIC: 'periodic modes: repeat',
  motion.TRANSIENT: 'transient modes: run once',
}
_PUSHES = {  # Label: key, direction in the world.
  'forward': ('I', (1.0, 0.0)),
  'back': ('K', (-1.0, 0.0)),
  'left': ('J', (0.0, 1.0)),
  'right': ('L', (0.0, -1.0)),
}
_PUSH_SPEED = 0.8  # Initial value, m/s.
_DIGITS = 9  # Keys for modes.
_OTHER = 'gray'  # Colour of the buttons of modes that do not run.
_RATE_STEP = 0.1  # Of the clock rate, by a key.
_SHARE = 0.5  # Of a blend, at first.

# Queues a request, with its arguments, for the session's thread.
Ask = Callable[..., None]


class Controls:
  """Controls of one session.

  Attributes:
    keys: the keys, and what they do.
  """

  def __init__(
    self, gui: viser.GuiApi, session: session_lib.LiveSession, ask: Ask
  ):
    """Takes the place where controls are added; the caller adds them."""
    self._gui, self._session, self._ask = gui, session, ask
    self.keys: list[tuple[str, str]] = []
    # Handles, and what the session has in their place.
    self._shown: list[tuple[Any, Callable[[], Any]]] = []
    self._modes: dict[str, Any] = {}
    self._running = ''

  def update(self, mode: str) -> None:
    """Shows what the session has, and the mode that runs."""
    for handle, read in self._shown:
      if handle.value != (value := read()):
        handle.value = value
    if mode != self._running:
      for name, button in self._modes.items():
        button.color = self._colour(name) if name == mode else _OTHER
      self._running = mode

  def _colour(self, mode: str) -> tuple[int, int, int]:
    return captions.colour(self._session.modes.index(mode))

  def bind(
    self,
    key: str | None,
    meaning: str,
    request: Callable[..., None],
    with_client: bool = False,
    shown: str | None = None,
  ) -> None:
    """Binds a key, and the command palette, to a request.

    Args:
      key: of viser; None for the palette alone.
      meaning: in words.
      request: of the session's thread.
      with_client: whether it takes the browser that asks.
      shown: key in the help; '' for none, itself if None.
    """
    hotkey: Any = key  # One of viser's literals.
    command = self._gui.add_command(meaning, hotkey=hotkey)
    command.on_trigger(
      lambda event: self._ask(request, *[event.client] * with_client)
    )
    shown = key if shown is None else shown
    if shown:
      self.keys.append((shown.capitalize(), meaning))

  def add_modes(self) -> None:
    """Adds a button and a digit for every mode, by kinds."""
    modes = self._session.modes
    motions = self._session.blends.mode_set.motions
    for kind, label in _KINDS.items():
      mine = [i for i in range(len(modes)) if motions[i].kind == kind]
      if mine:
        with self._gui.add_folder(label):
          for i in mine:
            self._add_mode(i, modes[i])
    last = min(_DIGITS, len(modes))
    self.keys.append((f'1 to {last}', 'modes, by the digits on their buttons'))
    self.bind('B', 'previous mode', lambda: self._session.command_next(-1))
    self.bind('N', 'next mode', lambda: self._session.command_next(1))

  def _add_mode(self, index: int, name: str) -> None:
    command = functools.partial(self._session.command, name)
    key = str(index + 1) if index < _DIGITS else None
    label = f'{key}  {name}' if key else name
    button = self._gui.add_button(label, color=_OTHER)
    button.on_click(lambda _: self._ask(command))
    self.bind(key, name, command, shown='')
    self._modes[name] = button

  def add_speeds(self) -> None:
    """Adds sliders of clock rate, speed of gaits, and of a blend."""
    session = self._session
    with self._gui.add_folder('speed'):
      self.add_slider(
        'clock rate',
        (*session_lib.CLOCK_RATES, 0.05),
        lambda: session.clock_rate,
        session.set_clock_rate,
      )
      self.add_slider(
        'speed of gaits',
        (session_lib.SPEED_STEP, 1.0, session_lib.SPEED_STEP),
        lambda: session.speed,
        session.set_speed,
      )
      if session.blends.pairs:
        self._add_blend()
    self.bind('Z', 'slower clock', lambda: self._change_rate(-_RATE_STEP))
    self.bind('C', 'faster clock', lambda: self._change_rate(_RATE_STEP))

  def _change_rate(self, change: float) -> None:
    rate = round(self._session.clock_rate + change, 2)
    self._session.set_clock_rate(float(np.clip(rate, *session_lib.CLOCK_RATES)))

  def _add_blend(self) -> None:
    """Adds the choice of two modes, and the share of the second."""
    pairs = {
      f'{first} + {second}': (first, second)
      for second, first in self._session.blends.pairs
    }
    pair = self._gui.add_dropdown('blend', [*pairs])
    share = self._gui.add_slider(
      'of the second',
      min=0.0,
      max=1.0,
      step=session_lib.SPEED_STEP,
      initial_value=_SHARE,
    )
    # No value of the session is theirs: what runs may be another mode.
    for handle in (pair, share):
      handle.on_update(
        self._by_hand(
          lambda _: self._session.blend(*pairs[pair.value], share.value)
        )
      )

  def add_slider(
    self,
    label: str,
    values: tuple[float, float, float],
    read: Callable[[], float],
    write: Callable[[float], None],
  ) -> Any:
    """Adds a slider of a value of the session.

    Args:
      label: for people.
      values: least, greatest and step.
      read, write: of the session.
    """
    low, high, step = values
    now = read()
    slider = self._gui.add_slider(
      label,
      min=min(low, now),
      max=max(high, now),
      step=step,
      initial_value=now,
    )
    slider.on_update(self._by_hand(write))
    self._shown.append((slider, read))
    return slider

  def _by_hand(
    self, request: Callable[[Any], None]
  ) -> Callable[[viser.GuiEvent[Any]], None]:
    """Returns a callback that ignores changes by the page itself."""

    def ask(event: viser.GuiEvent[Any]) -> None:
      if event.client is not None:
        self._ask(request, event.target.value)

    return ask

  def add_track(self) -> None:
    """Adds the choice of track."""
    session = self._session
    arena = self._gui.add_dropdown(
      'track', session_lib.ARENAS, initial_value=session.arena
    )
    seed = self._gui.add_number(
      'seed',
      initial_value=session.seed,
      min=0,
      max=session_lib.MOST_SEEDS,
      step=1,
    )
    arena.on_update(
      self._by_hand(lambda name: session.set_arena(name, session.seed))
    )
    seed.on_update(
      self._by_hand(lambda value: session.set_arena(session.arena, int(value)))
    )
    self._shown += [
      (arena, lambda: session.arena),
      (seed, lambda: session.seed),
    ]

  def add_actions(
    self,
    actions: Sequence[tuple[str, str, str, Callable[..., None]]],
    with_client: bool = False,
  ) -> list[Any]:
    """Adds buttons with keys.

    Args:
      actions: label, key, meaning and request of each.
      with_client: whether requests take the browser that asks.

    Returns:
      The buttons.
    """
    buttons = []
    for label, key, meaning, request in actions:
      button = self._gui.add_button(f'{key}  {label}', hint=meaning)
      button.on_click(
        lambda event, request=request: self._ask(
          request, *[event.client] * with_client
        )
      )
      self.bind(key, meaning, request, with_client)
      buttons.append(button)
    return buttons

  def add_disturbances(self) -> None:
    """Adds sliders of what is wrong with the robot, and pushes."""
    session = self._session
    with self._gui.add_folder('disturbances'):
      for name, (low, high, step, label) in disturbing.RANGES.items():
        self.add_slider(
          label,
          (low, high, step),
          functools.partial(session.disturbance, name),
          lambda value, name=name: session.disturb(**{name: value}),  # type: ignore[misc]
        )
      slowest, fastest = session_lib.PUSH_SPEEDS
      push = self._gui.add_slider(
        'push, m/s',
        min=slowest,
        max=fastest,
        step=0.1,
        initial_value=_PUSH_SPEED,
      )
      group = self._gui.add_button_group('push (I K J L)', [*_PUSHES])
      requests = {}
      for label, (key, way) in _PUSHES.items():
        requests[label] = lambda way=way: session.push(
          push.value * np.array(way)
        )
        self.bind(key, f'push {label}', requests[label])
      group.on_click(lambda event: self._ask(requests[event.target.value]))
      nominal = self._gui.add_button('nominal robot')
      nominal.on_click(
        lambda _: self._ask(lambda: session.disturb(**disturbing.NOMINAL))
      )
