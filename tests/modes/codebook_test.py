"""Tests of dmc_multimode.modes.codebook."""

import numpy as np
import pytest

from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set


def test_distances_and_separation() -> None:
  latents = np.array([[0, 0], [3, 4], [0, 1]])
  book = codebook.Codebook(('a', 'b', 'c'), latents)
  root = np.sqrt(18)
  expected = [[0, 5, 1], [5, 0, root], [1, root, 0]]
  np.testing.assert_allclose(book.distances(), expected, rtol=1e-6)
  assert book.separation() == pytest.approx(3 / (6 + root), abs=1e-6)
  same = codebook.Codebook(('a', 'b'), np.ones((2, 4)))
  assert same.separation() == 0.0
  assert mode_set.one_hot(library.resolve('idle')).codebook.separation() == 1
  assert book.index('c') == 2
  with pytest.raises(ValueError, match="'fly'.*a"):
    book.index('fly')


def test_is_a_frozen_copy() -> None:
  latents = np.zeros((1, 2), dtype=np.float32)
  book = codebook.Codebook(('a',), latents)
  latents[0, 0] = 1.0
  assert book.latents[0, 0] == 0.0
  with pytest.raises(ValueError):
    book.latents[0, 0] = 1.0


@pytest.mark.parametrize(
  ('names', 'latents', 'message'),
  [
    ((), np.zeros((0, 4)), 'at least one'),
    (('a', 'a'), np.zeros((2, 4)), 'unique'),
    (('a', 'b'), np.zeros((3, 4)), r'\[2, n_m\]'),
    (('a', 'b'), np.zeros(2), r'\[2, n_m\]'),
    (('a',), np.zeros((1, 0)), r'\[1, n_m\]'),
    (('a',), np.full((1, 2), np.nan), 'finite'),
    (('a',), np.full((1, 2), 1e300), 'finite'),
  ],
)
def test_rejects(
  names: tuple[str, ...], latents: np.ndarray, message: str
) -> None:
  with np.errstate(over='ignore'):
    with pytest.raises(ValueError, match=message):
      codebook.Codebook(names, latents)
