"""Chooses the OpenGL backend of MuJoCo, best before importing dm_control.

dm_control reads MUJOCO_GL when it is imported; unset, it takes GLFW even on a
machine without a display and fails at the first frame. A failed attempt also
leaves PyOpenGL unusable in that process, so backends are tried in another. As
long as nothing has been drawn, dm_control can be made to read it again: so the
suite, which must load fast, chooses at the first frame (`choose_late`).

torch's builds for CUDA bring triton, which torch imports when a training
begins. Triton and Mesa's software renderer have an LLVM each, and Python
crashes where triton is imported after Mesa has drawn. So it is imported first.

`python -m dmc_multimode.viewer.gl` prints a backend that works.
"""

import contextlib
import importlib
import os
import subprocess
import sys
from typing import Any, Callable
import warnings

VARIABLE = 'MUJOCO_GL'
BACKENDS = ('egl', 'osmesa')  # Both render without a display; egl is faster.
HELP = (
  'no OpenGL for drawing without a display; on Debian: '
  'apt-get install libegl1 libgl1-mesa-dri (or libosmesa6)'
)

# Returns the reason why a backend cannot render, or None.
Probe = Callable[[str], str | None]

_DRAW = (
  'from dm_control import mujoco; '
  "mujoco.Physics.from_xml_string('<mujoco/>').render(16, 16)"
)
_TAKER = 'dm_control._render'  # Reads the variable when it is imported.
_TIMEOUT = 60.0  # Seconds; a frame and its imports take about 0.7.


def why_not(backend: str) -> str | None:
  """Renders one frame with a backend in a new process.

  Args:
    backend: A value of MUJOCO_GL.

  Returns:
    None after success, else the reason in one line.
  """
  try:
    result = subprocess.run(
      [sys.executable, '-c', _DRAW],
      env={**os.environ, VARIABLE: backend},
      stdin=subprocess.DEVNULL,
      capture_output=True,
      text=True,
      timeout=_TIMEOUT,
    )
  except subprocess.TimeoutExpired:
    return f'no frame within {_TIMEOUT:.0f} s'
  if result.returncode == 0:
    return None
  lines = result.stderr.strip().splitlines()
  return lines[-1] if lines else f'exit code {result.returncode}'


def choose_backend(probe: Probe = why_not) -> str:
  """Sets MUJOCO_GL to a backend that works; call it before rendering.

  A value that is set already is kept, and checked unless dm_control has read
  it.

  Args:
    probe: Returns the reason why a backend cannot render, or None.

  Returns:
    The value of MUJOCO_GL.

  Raises:
    OSError: If no backend, or not the one that the user has set, works; one
      line that says what to install.
  """
  _import_triton()
  chosen, taken = os.environ.get(VARIABLE), sys.modules.get(_TAKER)
  late = getattr(taken, 'Renderer', None) is _make_context
  if chosen:
    reason = None if taken and not late else probe(chosen)
    if reason is not None:
      raise OSError(f'{VARIABLE}={chosen} cannot draw here ({reason}): {HELP}')
    return chosen
  for backend in BACKENDS:
    if probe(backend) is None:
      os.environ[VARIABLE] = backend
      if taken:
        importlib.reload(taken)
      return backend
  raise OSError(HELP)


def choose_late() -> None:
  """Makes dm_control `choose` at its first frame, if nobody has chosen.

  Call it before dm_control is imported: without a display, its search for one
  then does not happen, nor the warning that there is none.
  """
  if sys.platform != 'linux':
    return
  if os.environ.get(VARIABLE):  # Nobody calls `choose`.
    _import_triton()
    return
  if _TAKER not in sys.modules and not _has_display():
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = 'disable'
    try:
      importlib.import_module(_TAKER)
    finally:
      del os.environ[VARIABLE]
      if before is not None:
        os.environ[VARIABLE] = before
  taker: Any = importlib.import_module(_TAKER)
  taker.Renderer = _make_context


def choose_late_without_display() -> None:
  """Calls `choose_late` where there is no display, else does nothing.

  For packages that import dm_control and may be imported before the suite:
  planning and evaluating draw nothing, and should not warn either. With a
  display dm_control finds it by itself, unless a backend is chosen first.
  """
  if not _has_display():
    choose_late()


def choose() -> None:
  """Chooses now, if `choose_late` has left it for the first frame.

  What the user has set since then is taken, and a display if it works; else
  see `choose_backend`.

  Raises:
    OSError: No backend works; one line that says what to install.
  """
  taker: Any = sys.modules.get(_TAKER)
  if getattr(taker, 'Renderer', None) is not _make_context:
    return
  _import_triton()
  if os.environ.get(VARIABLE) or _display_works():
    importlib.reload(taker)
  else:
    choose_backend()


def _make_context(*args: Any, **kwargs: Any) -> Any:
  """Returns an OpenGL context; stands for dm_control's until the first frame.

  `choose` puts dm_control's own class back into its place.
  """
  choose()
  taker: Any = sys.modules[_TAKER]
  return taker.Renderer(*args, **kwargs)


def _import_triton() -> None:
  """Imports triton if it is installed; see the module's docstring."""
  with contextlib.suppress(ImportError):
    importlib.import_module('triton')


def _has_display() -> bool:
  return any(os.environ.get(name) for name in ('DISPLAY', 'WAYLAND_DISPLAY'))


def _display_works() -> bool:
  """Returns whether there is a display that windows can be opened on."""
  if not _has_display():
    return False
  try:
    import glfw
  except ImportError:
    return False
  with warnings.catch_warnings():
    warnings.simplefilter('ignore')  # Of what is returned.
    return bool(glfw.init())
