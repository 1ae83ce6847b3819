"""Browser page that shows and commands a live session.

viser calls back from its own threads; the page queues the requests, and the
thread that drives the session handles them.
"""

import collections
import functools
import queue
from typing import Any, Callable

import numpy as np
import viser
from viser import uplot

from dmc_multimode.viewer import camera as camera_lib
from dmc_multimode.viewer import session as session_lib
from dmc_multimode.viewer import web_client
from dmc_multimode.viewer import web_controls
from dmc_multimode.viewer import web_recorder
from dmc_multimode.viewer import web_scene
from dmc_multimode.viewer import web_status

_SHOWN = 8.0  # Seconds shown by the plots.
_EVERY = 4  # Control steps between updates of texts and plots.
_HIGHEST = 1.5  # Metres, and the top of the plots.
_CURVES = ('#1971c2', '#e8590c')
_LEGEND, _PADDING = uplot.Legend(live=False), (10, 24, 0, 0)


class Page:
  """The page of one session."""

  def __init__(
    self,
    server: viser.ViserServer,
    session: session_lib.LiveSession,
    name: str = 'policy',
  ):
    """Builds the page.

    Args:
      server: of the page.
      session: to show and command.
      name: of the policy, for title and videos.
    """
    self._server, self._session = server, session
    self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
    self._scene = web_scene.LiveScene(server, session.robot)
    self._recorder = web_recorder.Recorder(server, session, self._scene, name)
    self._plan: object = None
    self._steps = 0
    self._length = round(_SHOWN / session.robot.task.control_timestep)
    self._history: collections.deque[tuple[float, float, int]] = (
      collections.deque(maxlen=self._length)
    )
    server.gui.configure_theme(
      control_width='large', show_logo=False, show_share_button=False
    )
    server.gui.set_panel_label(web_client.LABEL)
    server.gui.main_panel.dock_right()
    self._status = server.gui.add_html('')
    self._notice = server.gui.add_html(web_status.notice(''))
    self._controls = web_controls.Controls(server.gui, session, self._ask)
    self._controls.add_modes()
    self._controls.add_speeds()
    self._add_track()
    self._controls.add_disturbances()
    self._add_plots()
    self._controls.bind('escape', 'dismiss the notice', session.dismiss)
    marks = web_client.legend(camera_lib.GHOST, camera_lib.EDGE, web_scene.PATH)
    web_client.install(
      server,
      web_client.source(f'{name} - dmc_multimode', self._controls.keys, marks),
    )

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
    self._recorder.add(state)
    if not self._server.get_clients():
      return
    self._steps += 1
    now_and_then = not self._steps % _EVERY
    # Leaves the interpreter to a search meanwhile.
    if now_and_then or not (late or state.searching):
      self._scene.show(self._session.robot)
    step = state.step
    mode = self._session.modes.index(step.mode)
    self._history.append((float(step.position[2]), step.reward, mode))
    if state.plan is not self._plan:
      self._plan = state.plan
      self._scene.show_path(state.plan.path if state.plan else None)
    if now_and_then:
      self._status.content = web_status.status(
        state, self._session, self._recorder.progress
      )
      # Only when it changes, so that a click does not miss what it hits.
      for handle, prop, value in (
        (self._notice, 'content', web_status.notice(state.notice)),
        (self._record, 'label', self._recorder.label),
      ):
        if getattr(handle, prop) != value:
          setattr(handle, prop, value)
      if self._requests.empty():
        self._controls.update(step.mode)
      self._show_plots()

  def close(self) -> None:
    """Ends what the page runs besides."""
    self._recorder.close()

  def _ask(self, request: Callable[..., None], *args: Any) -> None:
    """Queues a request for the session's thread."""
    self._requests.put(functools.partial(request, *args))

  def _add_track(self) -> None:
    """Adds the choice of track, plans, autopilot and recordings."""
    session = self._session
    self._controls.add_track()
    with self._server.gui.add_folder('run'):
      *_, pilot = self._controls.add_actions(
        [
          ('reset', 'R', 'back to the start of the track', session.reset),
          ('plan', 'P', 'search for a plan across the track', session.plan),
          ('replay', 'X', 'carry the plan out, from the start', session.replay),
          ('autopilot', 'T', 'the selector commands, or not', self._pilot),
        ]
      )
      if not session.has_selector:
        pilot.disabled = True
        pilot.hint = 'There is no selector: start with --selector=FOLDER.'
      (self._record,) = self._controls.add_actions(
        [
          ('record', 'V', 'start, stop and save a video', self._recorder.toggle)
        ],
        with_client=True,
      )

  def _pilot(self) -> None:
    self._session.set_autopilot(not self._session.autopilot)

  def _add_plots(self) -> None:
    """Adds plots of height, reward and mode over time."""
    nothing = np.zeros(1)
    curve = lambda label, colour: uplot.Series(
      label=label, stroke=colour, width=2
    )
    with self._server.gui.add_folder(f'the last {_SHOWN:g} s'):
      self._values = self._server.gui.add_uplot(
        (nothing, nothing, nothing),
        (
          uplot.Series(label='s'),
          curve('trunk z, m', _CURVES[0]),
          curve('reward', _CURVES[1]),
        ),
        scales={
          'x': uplot.Scale(time=False),
          'y': uplot.Scale(range=(0.0, _HIGHEST)),
        },
        legend=_LEGEND,
        padding=_PADDING,
        height=140,
      )
      self._ran = self._server.gui.add_html('')

  def _show_plots(self) -> None:
    values = np.array(self._history).T
    ages = np.arange(1 - len(self._history), 1)
    times = ages * self._session.robot.task.control_timestep
    self._values.data = (times, values[0], values[1])
    self._ran.content = web_status.timeline(
      [mode for _, _, mode in self._history],
      self._session.modes,
      self._length,
    )
