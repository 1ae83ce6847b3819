"""Fixtures of the tests of commands."""

from typing import Iterator

import pytest

from tests.bin import processes
from tests.bin import short_run


@pytest.fixture(scope='module')
def train(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  folder = tmp_path_factory.mktemp('output')
  binary = processes.Binary('train', folder, short_run.WARM_UP)
  yield binary
  binary.close()
