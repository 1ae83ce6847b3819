"""Chooses how MuJoCo draws, and on how many threads torch computes.

A test that draws carries `@pytest.mark.gl` and is skipped where nothing can.
"""

import os
from typing import Iterator

import pytest

from dmc_multimode.utils import gl

# Before torch is imported, here and in the processes that tests start: threads
# that wait for each other take the cores from the tests beside them.
os.environ.setdefault('OMP_NUM_THREADS', '1')

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


@pytest.fixture
def one_thread() -> Iterator[None]:
  """Limits torch to one thread, for reproducible rounding."""
  import torch  # Late: its threads are set above, and most tests need none.

  before = torch.get_num_threads()
  torch.set_num_threads(1)
  yield
  torch.set_num_threads(before)
