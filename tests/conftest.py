"""Chooses how MuJoCo draws before any test imports dm_control.

A test that draws carries `@pytest.mark.gl` and is skipped where nothing can.
"""

import os

import pytest

from dmc_multimode.utils import gl

try:
  gl.choose_backend()
except OSError as error:
  _NO_GL = str(error)
  os.environ[gl.VARIABLE] = 'disable'  # Else dm_control looks for a display.
else:
  _NO_GL = ''


def pytest_runtest_setup(item: pytest.Item) -> None:
  if _NO_GL and item.get_closest_marker('gl'):
    pytest.skip(_NO_GL)
