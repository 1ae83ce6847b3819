"""What the tests of agents share."""

from typing import Iterator

import pytest
import threadpoolctl
import torch

from dmc_multimode.agents import blas


@pytest.fixture
def one_thread() -> Iterator[None]:
  """Lets torch and numpy compute in one thread, so that they round one way."""
  before = torch.get_num_threads()
  torch.set_num_threads(1)
  with threadpoolctl.threadpool_limits(1, user_api='blas'):
    yield
  torch.set_num_threads(before)


@pytest.fixture(params=['torch', 'numpy'])
def library(
  request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Lets `agents.blas` multiply by a library, whatever the processor."""
  monkeypatch.setattr(blas, '_is_amd', lambda: request.param == 'numpy')
