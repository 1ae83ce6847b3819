"""Tests of dmc_multimode.agents.pair."""

import threading

import pytest
import torch

from dmc_multimode.agents import pair


@pytest.mark.parametrize('parallel', [False, True])
def test_both_are_called_each_by_its_thread(parallel: bool) -> None:
  mine, other = pair.Pair(parallel).both(
    threading.get_ident, threading.get_ident
  )
  assert mine == threading.get_ident()
  assert (other != mine) == parallel


def test_they_run_at_once() -> None:
  barrier = threading.Barrier(2, timeout=10)
  ranks = pair.Pair(parallel=True).both(barrier.wait, barrier.wait)
  assert sorted(ranks) == [0, 1]


@pytest.mark.parametrize('parallel', [False, True])
def test_an_exception_of_either_is_raised(parallel: bool) -> None:
  threads, ended = pair.Pair(parallel), threading.Event()

  def fail() -> None:
    raise ValueError('failed')

  with pytest.raises(ValueError, match='failed'):
    threads.both(lambda: None, fail)
  with pytest.raises(ValueError, match='failed'):
    threads.both(fail, ended.set)
  # The other one has ended, too, or was never begun.
  assert ended.is_set() == parallel


@pytest.mark.parametrize('parallel', [False, True])
@pytest.mark.parametrize('rows', [1, 2, 7, 1024])
def test_rows_are_mapped_to_the_same_bits(parallel: bool, rows: int) -> None:
  generator = torch.Generator().manual_seed(0)
  weight = torch.randn(5, 3, generator=generator, requires_grad=True)
  values = torch.randn(rows, 5, generator=generator)
  found = pair.Pair(parallel).map_rows(lambda part: part @ weight, values)
  assert torch.equal(found, pair.Pair().map_rows(lambda p: p @ weight, values))
  torch.testing.assert_close(found, (values @ weight).detach())
  assert not found.requires_grad
