"""Serves a live session: on a browser page, or in dm_control's viewer."""

import contextlib
import io
import os
import pathlib
import socket
import time
from typing import Mapping, TYPE_CHECKING

from dmc_multimode.viewer import gl

if TYPE_CHECKING:
  from dmc_multimode.viewer import session as session_lib
  from dmc_multimode.viewer import web_page
  from dmc_multimode.walkers import robot as robot_lib

_CATCH_UP = 0.1  # Seconds of delay that are caught up; more is dropped.


def view(
  policy: str | os.PathLike[str] = 'pi2',
  arena: str = 'flat',
  seed: int = 0,
  host: str = '127.0.0.1',
  port: int = 8080,
  threads: int = 1,
  native: bool = False,
  disturbed: Mapping[str, float] | None = None,
  selector: str | os.PathLike[str] | None = None,
  difficulty: float = 0.5,
  robot: 'str | os.PathLike[str] | robot_lib.Robot | None' = None,
) -> None:
  """Serves a policy that people can command, until it is interrupted.

  Args:
    policy: name of a shipped policy, or folder of a policy or a run.
    arena: name of the track.
    seed: of the track and the initial state.
    host: address of this machine for the page.
    port: of the page; 0 for any free one.
    threads: of the planner; the robot needs a core.
    native: opens dm_control's viewer instead of a page.
    disturbed: arguments of `events.fixed`, which fix the robot's disturbances.
    selector: folder of a selector, which then commands the robot; by default
      the one beside the policy, if any, which only stands by.
    difficulty: of the endless track, 0 to 1.
    robot: that the policy must have been trained for, or its file.

  Raises:
    FileNotFoundError: there is no such policy or selector.
    ModuleNotFoundError: the page's extra is not installed.
    OSError: there is no display for a window, or the port is in use.
    ValueError: an argument is out of bounds, or no address of this machine.
  """
  if native:
    _check_display()
  else:
    check_address(host, port)
    os.environ.setdefault(gl.VARIABLE, 'disable')  # The browser draws.
  # These import dm_control, which reads the choice.
  import torch

  from dmc_multimode import pretrained
  from dmc_multimode.planner import steering
  from dmc_multimode.suite.imitation import events
  from dmc_multimode.viewer import session as session_lib

  torch.set_num_threads(1)  # Batches are small.
  loaded = pretrained.load(policy, robot=robot)
  chosen = steering.SteeringConfig('' if selector is None else str(selector))
  pilot = None
  if selector is not None or steering.is_beside(policy):
    pilot = steering.load(chosen, policy)
  session = session_lib.LiveSession(
    loaded,
    arena,
    seed,
    threads=threads,
    disturbed=events.fixed(**(disturbed or {})),
    selector=pilot,
    difficulty=difficulty,
  )
  session.set_autopilot(selector is not None)
  with contextlib.closing(session), contextlib.suppress(KeyboardInterrupt):
    if native:
      from dmc_multimode.viewer import native as window

      window.run(session)
    else:
      _serve(session, pathlib.Path(policy).name, host, port)


def _check_display() -> None:
  """Raises OSError if no window can be opened."""
  if not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')):
    raise OSError(
      'no display for --viewer=native: use --viewer=web, which needs none.'
    )


def check_address(host: str, port: int) -> None:
  """Raises unless the port is free; viser would just take another one.

  Raises:
    ValueError: the port or the address is invalid.
    OSError: the port is in use.
  """
  if not 0 <= port < 1 << 16:
    raise ValueError(f'--port={port} is not within 0 and {(1 << 16) - 1}.')
  try:
    family, kind, *_, address = socket.getaddrinfo(
      host, None, type=socket.SOCK_STREAM
    )[0]
    with socket.socket(family, kind) as probe:
      probe.bind((address[0], 0))
  except OSError as error:
    raise ValueError(f'--host={host} is no address of this machine.') from error
  with socket.socket(family, kind) as probe:
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
      probe.bind((address[0], port))
    except OSError as error:
      raise OSError(f'--port={port}: {error.strerror}.') from error


def _serve(
  session: 'session_lib.LiveSession', name: str, host: str, port: int
) -> None:
  """Serves the page and runs the session in real time."""
  try:
    import viser

    from dmc_multimode.viewer import web_page
  except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
      f'{error}; the page takes the extra `view`: pip install '
      "'dmc_multimode[view]'"
    ) from error
  silence = contextlib.redirect_stdout(io.StringIO())  # Hides viser's banner.
  with silence:
    server = viser.ViserServer(host, port, verbose=False)
  try:
    page = web_page.Page(server, session, name)
    print(f'http://{host}:{server.get_port()}', flush=True)
    with contextlib.closing(page):
      _run(session, page)
  finally:
    with silence:
      server.stop()


def _run(session: 'session_lib.LiveSession', page: 'web_page.Page') -> None:
  """Steps the session in real time, for ever."""
  due = time.monotonic()
  while True:
    page.handle()
    state = session.step()
    due += session.robot.task.control_timestep
    page.show(state, late=time.monotonic() > due)
    now = time.monotonic()
    time.sleep(max(0.0, due - now))
    due = max(due, now - _CATCH_UP)
