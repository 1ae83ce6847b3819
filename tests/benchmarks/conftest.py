"""Fixtures of the tests of benchmarks."""

from typing import Iterator

import pytest

from tests.bin import processes


@pytest.fixture(scope='module')
def benchmark(
  request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[processes.Binary]:
  """The benchmark NAME of a test module NAME_test, as a binary."""
  name = request.path.stem.removesuffix('_test')
  binary = processes.Binary(
    'app',  # A binary without flags, to be replaced.
    tmp_path_factory.mktemp('output'),
    f'from benchmarks.{request.path.parent.name} import {name} as binary',
  )
  yield binary
  binary.close()
