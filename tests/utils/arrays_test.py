"""Tests of dmc_multimode.utils.arrays: what is taken, and what is refused."""

from typing import Any

import numpy as np
import pytest
import torch

from dmc_multimode.utils import arrays

_GOOD = np.arange(6.0).reshape(2, 3)


@pytest.mark.parametrize(
  'values',
  [
    _GOOD.astype(np.float32),
    _GOOD.astype('>f8'),
    _GOOD.astype(np.int8),
    _GOOD.tolist(),
    np.asfortranarray(_GOOD),
    np.repeat(_GOOD, 2, axis=1)[:, ::2],
    _GOOD[::-1][::-1],
    torch.from_numpy(_GOOD),
    np.broadcast_to(_GOOD, (2, 3)),  # Read-only.
  ],
)
def test_numbers_of_any_kind(values: Any) -> None:
  found = arrays.numbers(values, 'x', (2, 3))
  np.testing.assert_array_equal(found, _GOOD)
  rows = arrays.rows(values, 'x')
  np.testing.assert_array_equal(rows, _GOOD)
  assert rows.dtype == np.float32 and rows.flags.carray


@pytest.mark.parametrize(
  ('values', 'message'),
  [
    (_GOOD[:1], r'x must have shape \(2, 3\), got \(1, 3\)'),
    (1.0, r'x must have shape \(2, 3\), got \(\)'),
    ([[1.0], [2.0, 3.0]], 'x must be an array of numbers'),
    (torch.ones(2, 3, requires_grad=True), 'x must be an array of numbers'),
    (_GOOD.astype(str), 'x must be real numbers, got <U'),
    (_GOOD + 1j, 'x must be real numbers, got complex128'),
    (None, 'x must be real numbers, got object'),
  ],
)
def test_refused(values: Any, message: str) -> None:
  with pytest.raises(ValueError, match=message) as error:
    arrays.numbers(values, 'x', (2, 3))
  assert '\n' not in str(error.value)


@pytest.mark.parametrize(
  ('values', 'message'),
  [([0, 3], 'within 0 and 2'), ([0, -1], 'within'), ([0.0, 1.0], 'integers')],
)
def test_indices_refused(values: Any, message: str) -> None:
  np.testing.assert_array_equal(arrays.indices([0, 2], 'x', (2,), 3), [0, 2])
  with pytest.raises(ValueError, match=message):
    arrays.indices(values, 'x', (2,), 3)


@pytest.mark.parametrize(
  ('row', 'expected'),
  [
    ((0.0, 1.0), True),
    ((0.0, np.nan), False),
    ((-np.inf, np.inf), False),
    ((1e308, 1e308), True),  # Their sum alone is not.
  ],
)
def test_finite_rows(row: tuple[float, float], expected: bool) -> None:
  finite = arrays.finite_rows(np.array([(2.0, 3.0), row]))
  np.testing.assert_array_equal(finite, [True, expected])
