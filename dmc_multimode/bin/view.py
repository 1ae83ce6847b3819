r"""Shows a policy on a page in the browser, and lets people command it.

  python -m dmc_multimode.bin.view --policy=pi2 --arena=gap_block

Buttons and keys command modes, push the robot, choose the track, and search for
a plan across it. The page is for this machine alone unless --host says
otherwise: whoever reaches it can command the robot. Ctrl-C ends it.

With --viewer=native it is dm_control's own viewer, which takes a display.
"""

import contextlib
import io
import os
import socket
import time
from typing import Any, Sequence

from absl import flags

from dmc_multimode.arenas import layouts
from dmc_multimode.bin import app
from dmc_multimode.viewer import gl

_CATCH_UP = 0.1  # Seconds that are made up for; more is lost.

_POLICY = flags.DEFINE_string(
  'policy', 'pi2', 'Name of a shipped policy, or folder of a policy or a run.'
)
_ARENA = flags.DEFINE_string('arena', 'flat', f'{", ".join(layouts.NAMES)}.')
_SEED = flags.DEFINE_integer('seed', 0, 'Of the track and the initial state.')
_VIEWER = flags.DEFINE_enum(
  'viewer', 'web', ['web', 'native'], 'A page, or a window.'
)
_HOST = flags.DEFINE_string(
  'host', '127.0.0.1', 'Address of this machine at which the page is served.'
)
_PORT = flags.DEFINE_integer('port', 8080, 'Of the page; 0 for any free one.')
_THREADS = flags.DEFINE_integer(
  'threads', 1, 'Of the planner; the robot needs a core.', lower_bound=1
)


def main(argv: Sequence[str]) -> None:
  """Checks the input, then shows the policy until it is interrupted."""
  del argv
  if _VIEWER.value == 'native':
    _check_display()
  else:
    _check_address(_HOST.value, _PORT.value)
    os.environ.setdefault(gl.VARIABLE, 'disable')  # The browser draws.
  # These import dm_control, which reads the choice.
  import torch

  from dmc_multimode import pretrained
  from dmc_multimode.viewer import session as live

  torch.set_num_threads(1)  # Batches are small, and a search has a thread.
  session = live.LiveSession(
    pretrained.load(_POLICY.value),
    _ARENA.value,
    _SEED.value,
    threads=_THREADS.value,
  )
  with contextlib.closing(session), contextlib.suppress(KeyboardInterrupt):
    if _VIEWER.value == 'native':
      from dmc_multimode.viewer import native

      native.run(session)
    else:
      _serve(session)


def _check_display() -> None:
  """Raises OSError where no window can be opened."""
  if not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')):
    raise OSError(
      'no display for --viewer=native: use --viewer=web, which needs none.'
    )


def _check_address(host: str, port: int) -> None:
  """Raises where nothing can be served; viser would just take another port.

  Raises:
    ValueError: that is no port, or no address of this machine.
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


def _serve(session: Any) -> None:
  """Serves the page and runs the session in real time."""
  try:
    import viser

    from dmc_multimode.viewer import web_page
  except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
      f'{error}; the page takes the extra `view`: pip install '
      "'dmc_multimode[view]'"
    ) from error
  silence = contextlib.redirect_stdout(io.StringIO())  # Of viser's banner.
  with silence:
    server = viser.ViserServer(_HOST.value, _PORT.value, verbose=False)
  try:
    page = web_page.Page(server, session)
    print(f'http://{_HOST.value}:{server.get_port()}', flush=True)
    _run(session, page)
  finally:
    with silence:
      server.stop()


def _run(session: Any, page: Any) -> None:
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


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
