"""Chooses the OpenGL backend of MuJoCo, best before importing dm_control.

dm_control reads MUJOCO_GL when it is imported; unset, it takes GLFW even on a
machine without a display and fails at the first frame. A failed attempt also
leaves PyOpenGL unusable in that process, so backends are tried in another. As
long as nothing has been drawn, dm_control can be made to read it again.

`python -m dmc_multimode.viewer.gl` prints a backend that works.
"""

import importlib
import os
import subprocess
import sys
from typing import Callable

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
  chosen, taken = os.environ.get(VARIABLE), sys.modules.get(_TAKER)
  if chosen:
    reason = None if taken else probe(chosen)
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


if __name__ == '__main__':
  try:
    print(choose_backend())
  except OSError as problem:
    print(f'error: {problem}', file=sys.stderr)
    sys.exit(2)  # As the commands do.
