"""What the tests of agents share."""

from typing import Iterator

import pytest
import torch

from dmc_multimode.agents import blas


@pytest.fixture
def one_thread() -> Iterator[None]:
  """Lets torch compute in one thread, so that it rounds one way."""
  before = torch.get_num_threads()
  torch.set_num_threads(1)
  yield
  torch.set_num_threads(before)


@pytest.fixture(params=['torch', 'openblas'])
def library(
  request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
  """Lets `agents.blas` multiply by a library, whatever the processor."""
  name: str = request.param
  blas._sgemm.cache_clear()
  monkeypatch.setattr(blas, '_is_amd', lambda: name == 'openblas')
  if name == 'openblas' and blas._sgemm() is None:
    pytest.skip('scipy-openblas32 is not installed.')
  yield name
  blas._sgemm.cache_clear()
