"""Chooses the OpenGL backend of MuJoCo; see `utils.gl`, whose names these are.

`python -m dmc_multimode.viewer.gl` prints a backend that works.
"""

import sys

from dmc_multimode.utils import gl

BACKENDS, HELP, VARIABLE = gl.BACKENDS, gl.HELP, gl.VARIABLE
Probe = gl.Probe
choose_backend, why_not = gl.choose_backend, gl.why_not

if __name__ == '__main__':
  try:
    print(choose_backend())
  except OSError as problem:
    print(f'error: {problem}', file=sys.stderr)
    sys.exit(2)  # As the commands do.
