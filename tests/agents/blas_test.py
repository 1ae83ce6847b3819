"""Tests of dmc_multimode.agents.blas."""

import pathlib
import platform

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest
import torch

from dmc_multimode.agents import blas
from dmc_multimode.agents import pair

_by_either = pytest.mark.usefixtures('library', 'one_thread')

_SIZES = st.integers(0, 40)
_LAYOUTS = ('rows', 'columns', 'part of rows', 'part of columns', 'neither')


def _matrix(
  generator: torch.Generator, rows: int, columns: int, layout: str = 'rows'
) -> torch.Tensor:
  """Normal numbers that lie in memory as `layout` says."""
  draw = lambda *shape: torch.randn(*shape, generator=generator)
  match layout:
    case 'rows':
      return draw(rows, columns)
    case 'columns':
      return draw(columns, rows).T
    case 'part of rows':
      return draw(rows, columns + 3)[:, 1 : columns + 1]
    case 'part of columns':
      return draw(columns, rows + 3)[:, 1 : rows + 1].T
  return draw(2 * rows, 2 * columns)[::2, ::2]


@_by_either
@hypothesis.given(
  rows=_SIZES,
  columns=_SIZES,
  inner=_SIZES,
  layouts=st.tuples(*[st.sampled_from(_LAYOUTS)] * 3),
  seed=st.integers(0, 1000),
)
@hypothesis.settings(
  suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
  deadline=None,
)
def test_products(
  rows: int, columns: int, inner: int, layouts: tuple[str, str, str], seed: int
) -> None:
  generator = torch.Generator().manual_seed(seed)
  a = _matrix(generator, rows, inner, layouts[0])
  b = _matrix(generator, inner, columns, layouts[1])
  out = _matrix(generator, rows, columns, layouts[2])
  bias = _matrix(generator, 1, columns)[0]
  expected = a.double().numpy() @ b.double().numpy()
  found = blas.mm(a, b, out)
  assert found is out
  np.testing.assert_allclose(out, expected, atol=1e-4)
  assert blas.addmm(bias, a, b, out) is out
  np.testing.assert_allclose(out, expected + bias.numpy(), atol=1e-4)


@_by_either
def test_what_was_in_the_output_does_not_matter() -> None:
  out = torch.full((2, 2), torch.nan)
  blas.mm(torch.eye(2), torch.eye(2), out)
  assert torch.equal(out, torch.eye(2))


@_by_either
def test_other_memory_is_left_alone() -> None:
  memory = torch.zeros(4, 5)
  blas.mm(torch.ones(2, 3), torch.ones(3, 3), memory[1:3, 1:4])
  expected = torch.zeros(4, 5)
  expected[1:3, 1:4] = 3.0
  assert torch.equal(memory, expected)


@_by_either
def test_shapes_that_do_not_match_are_refused() -> None:
  with pytest.raises((RuntimeError, ValueError), match='cannot be|mismatch'):
    blas.mm(torch.ones(2, 3), torch.ones(2, 3), torch.ones(2, 3))


@_by_either
def test_double_precision() -> None:
  ones = torch.ones(2, 2, dtype=torch.float64)
  found = blas.mm(ones / 3, ones, torch.empty_like(ones))
  assert torch.equal(found, ones / 3 + ones / 3)


@_by_either
def test_two_threads_at_once_get_the_same_bits() -> None:
  generator = torch.Generator().manual_seed(0)
  a, b = _matrix(generator, 500, 130), _matrix(generator, 130, 250)
  alone = blas.mm(a, b, torch.empty(500, 250))

  def repeat() -> list[torch.Tensor]:
    return [blas.mm(a, b, torch.empty(500, 250)) for _ in range(50)]

  both = pair.Pair(parallel=True).both(repeat, repeat)
  assert all(torch.equal(found, alone) for half in both for found in half)


@pytest.mark.parametrize(
  ('info', 'processor', 'expected'),
  [
    ('vendor_id\t: AuthenticAMD\nmodel name\t: AMD EPYC', '', True),
    ('vendor_id\t: GenuineIntel\nmodel name\t: Xeon', '', False),
    (None, 'AMD64 Family 25 Model 33 Stepping 0, AuthenticAMD', True),
    (None, 'arm', False),
  ],
)
def test_processors(
  info: str | None,
  processor: str,
  expected: bool,
  tmp_path: pathlib.Path,
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  path = tmp_path / 'cpuinfo'
  if info is not None:
    path.write_text(info)
  monkeypatch.setattr(blas, '_CPUINFO', path)
  monkeypatch.setattr(platform, 'processor', lambda: processor)
  assert blas._is_amd.__wrapped__() == expected
