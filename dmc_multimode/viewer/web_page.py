"""Browser page that shows and commands a live session.

viser calls back from its own threads; the page queues the requests, and the
thread that drives the session handles them.
"""

import collections
import functools
import html
import queue
from typing import Any, Callable, Mapping

import numpy as np
import viser
from viser import uplot

from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.viewer import session as session_lib
from dmc_multimode.viewer import web_scene

_PUSHES = {  # Label: key, direction in the world.
  'forward': ('I', (1.0, 0.0)),
  'back': ('K', (-1.0, 0.0)),
  'left': ('J', (0.0, 1.0)),
  'right': ('L', (0.0, -1.0)),
}
_PUSH_SPEED = 0.8  # Initial value, m/s.
_SHOWN = 8.0  # Seconds shown by the plots.
_EVERY = 4  # Control steps between updates of texts and plots.
_HIGHEST = 1.5  # Metres, and the top of the plots.
_DIGITS = 9  # Keys for modes.
_RUNNING, _OTHER = 'blue', 'gray'  # Colours of the modes' buttons.
_CURVES = ('#1971c2', '#e8590c')
_LEGEND, _PADDING = uplot.Legend(live=False), (10, 24, 0, 0)


class Page:
  """The page of one session."""

  def __init__(
    self, server: viser.ViserServer, session: session_lib.LiveSession
  ):
    """Builds the page."""
    self._server, self._session = server, session
    self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
    self._scene = web_scene.LiveScene(server, session.robot)
    self._plan: object = None
    self._steps = 0
    length = round(_SHOWN / session.robot.task.control_timestep)
    self._history: collections.deque[tuple[float, ...]] = collections.deque(
      maxlen=length
    )
    server.gui.configure_theme(
      control_width='large', show_logo=False, show_share_button=False
    )
    server.gui.set_panel_label('dmc_multimode')
    server.gui.main_panel.dock_right()
    self._status = server.gui.add_html('')
    self._add_modes()
    self._add_pushes()
    self._add_track()
    self._add_plots()

  def handle(self) -> None:
    """Handles the queued requests.

    Errors become the session's notice.
    """
    while not self._requests.empty():
      try:
        self._requests.get()()
      except ValueError as error:
        self._session.notice = str(error)

  def show(self, state: session_lib.LiveState, late: bool = False) -> None:
    """Updates the robot and, at intervals, texts and plots.

    Args:
      state: after the last step.
      late: skips frames to catch up.
    """
    if not self._server.get_clients():
      return
    self._steps += 1
    now_and_then = not self._steps % _EVERY
    # Leaves the interpreter to a search meanwhile.
    if now_and_then or not (late or state.searching):
      self._scene.show(self._session.robot)
    step = state.step
    mode = self._session.modes.index(step.mode) + 1
    self._history.append((float(step.position[2]), step.reward, float(mode)))
    if state.plan is not self._plan:
      self._plan = state.plan
      self._scene.show_path(state.plan.path if state.plan else None)
    if now_and_then:
      self._show_status(state)
      self._show_plots()

  def _ask(self, request: Callable[..., None], *args: Any) -> None:
    """Queues a request for the session's thread."""
    self._requests.put(functools.partial(request, *args))

  def _by_hand(
    self, request: Callable[[], None]
  ) -> Callable[[viser.GuiEvent], None]:
    """Returns a callback that ignores changes by the page itself."""

    def ask(event: viser.GuiEvent) -> None:
      if event.client is not None:
        self._ask(request)

    return ask

  def _bind(self, label: str, key: Any, request: Callable[[], None]) -> None:
    """Binds a key to a request."""
    command = self._server.gui.add_command(label, hotkey=key)
    command.on_trigger(lambda _: self._ask(request))

  def _add_modes(self) -> None:
    """Adds a button and a digit for every mode, clock rate and speed."""
    gui, session = self._server.gui, self._session
    self._modes = {}
    for i, mode in enumerate(session.modes):
      command = functools.partial(session.command, mode)
      button = gui.add_button(f'{i + 1}  {mode}', color=_OTHER)
      button.on_click(lambda _, command=command: self._ask(command))
      self._bind(mode, str(i + 1) if i < _DIGITS else None, command)
      self._modes[mode] = button
    slowest, fastest = session_lib.CLOCK_RATES
    self._rate = gui.add_slider(
      'clock rate',
      min=slowest,
      max=fastest,
      step=0.05,
      initial_value=session.clock_rate,
    )
    self._rate.on_update(
      self._by_hand(lambda: session.set_clock_rate(self._rate.value))
    )

    self._share = gui.add_slider(
      'speed of gaits',
      min=session_lib.SPEED_STEP,
      max=1.0,
      step=session_lib.SPEED_STEP,
      initial_value=session.speed,
    )
    self._share.on_update(
      self._by_hand(lambda: session.set_speed(self._share.value))
    )

  def _add_group(
    self, name: str, actions: Mapping[str, tuple[str, Callable[[], None]]]
  ) -> None:
    """Adds a row of buttons with keys: label, key, request of each."""
    keys = ' '.join(key for key, _ in actions.values())
    group = self._server.gui.add_button_group(f'{name} ({keys})', [*actions])
    group.on_click(lambda event: self._ask(actions[event.target.value][1]))
    for label, (key, request) in actions.items():
      self._bind(f'{name} {label}', key, request)

  def _add_pushes(self) -> None:
    """Adds buttons and keys for pushes, and their speed."""
    slowest, fastest = session_lib.PUSH_SPEEDS
    self._speed = self._server.gui.add_number(
      'push, m/s',
      initial_value=_PUSH_SPEED,
      min=slowest,
      max=fastest,
      step=0.1,
    )
    push = lambda direction: functools.partial(self._push, direction)
    self._add_group(
      'push', {name: (key, push(way)) for name, (key, way) in _PUSHES.items()}
    )

  def _push(self, direction: tuple[float, float]) -> None:
    self._session.push(self._speed.value * np.array(direction))

  def _add_track(self) -> None:
    """Adds the choice of track, and plans."""
    gui, session = self._server.gui, self._session
    self._arena = gui.add_dropdown(
      'track', session_lib.ARENAS, initial_value=session.arena
    )
    self._seed = gui.add_number(
      'seed', initial_value=session.seed, min=0, step=1
    )
    for handle in (self._arena, self._seed):
      handle.on_update(self._by_hand(self._set_arena))
    self._add_group(
      'do',
      {
        'reset': ('R', session.reset),
        'plan': ('P', session.plan),
        'replay': ('X', session.replay),
        'autopilot': ('A', self._toggle_pilot),
      },
    )

  def _toggle_pilot(self) -> None:
    self._session.set_autopilot(not self._session.autopilot)

  def _set_arena(self) -> None:
    self._session.set_arena(self._arena.value, int(self._seed.value))

  def _add_plots(self) -> None:
    """Adds plots of height, reward and mode over time."""
    nothing = np.zeros(1)
    curve = lambda label, colour: uplot.Series(
      label=label, stroke=colour, width=2
    )
    time = uplot.Series(label='s')
    self._values = self._server.gui.add_uplot(
      (nothing, nothing, nothing),
      (time, curve('trunk z, m', _CURVES[0]), curve('reward', _CURVES[1])),
      scales={
        'x': uplot.Scale(time=False),
        'y': uplot.Scale(range=(0.0, _HIGHEST)),
      },
      legend=_LEGEND,
      padding=_PADDING,
      height=140,
    )
    self._ran = self._server.gui.add_uplot(
      (nothing, nothing),
      (time, curve('mode, by its key', _CURVES[0])),
      scales={
        'x': uplot.Scale(time=False),
        'y': uplot.Scale(range=(0.5, len(self._session.modes) + 0.5)),
      },
      axes=({}, {'incrs': (1.0,), 'space': 12}),
      legend=_LEGEND,
      padding=_PADDING,
      height=110,
    )

  def _show_plots(self) -> None:
    values = np.array(self._history).T
    ages = np.arange(1 - len(self._history), 1)
    times = ages * self._session.robot.task.control_timestep
    self._values.data = (times, values[0], values[1])
    self._ran.data = (times, values[2])

  def _show_status(self, state: session_lib.LiveState) -> None:
    step, session = state.step, self._session
    lines = [
      f'<b>{step.mode}</b>{_source(state, session)}',
      f'trunk z {step.position[2]:.2f} m, reward {step.reward:.2f}, '
      f'{step.speed:.2f} m/s',
      html.escape(state.notice),
    ]
    if state.searching:
      done = state.searching
      lines[2] = f'planning: {done.search}, knot {done.done} of {done.total}'
    elif state.plan:
      lines += [_describe(state.plan.plan)]
    self._status.content = (
      '<div style="padding: 0 1em 0.5em; font-size: 0.9em; min-height: 5.5em">'
      + '<br>'.join(lines)
      + '</div>'
    )
    for mode, button in self._modes.items():
      colour = _RUNNING if mode == step.mode else _OTHER
      if button.color != colour:
        button.color = colour
    if self._rate.value != session.clock_rate:
      self._rate.value = session.clock_rate
    if self._arena.value != session.arena:
      self._arena.value = session.arena


def _source(
  state: session_lib.LiveState, session: session_lib.LiveSession
) -> str:
  """Returns who commands, unless it is a person."""
  if session.autopilot:
    return ' (autopilot)'
  return ' (plan)' if state.replaying else ''


def _describe(plan: plan_lib.ModePlan) -> str:
  """Returns a plan in one line."""
  parts = zip(*plan.segments(), strict=True)
  return ', '.join(f'{name} {seconds:g} s' for name, seconds in parts)
