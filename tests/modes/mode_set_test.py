"""Tests of dmc_multimode.modes.mode_set."""

import numpy as np
import pytest

from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set


def test_one_hot() -> None:
  modes = mode_set.one_hot(library.resolve('pi2'))
  assert modes.names == library.SETS['pi2']
  assert modes.latent_dim == len(modes) == 4
  assert modes.latents.dtype == np.float32
  np.testing.assert_array_equal(modes.latents, np.eye(4))
  assert modes.codebook.separation() == pytest.approx(1.0)


def test_subset_keeps_motions_and_latents_together() -> None:
  pi2 = library.mode_set('pi2')
  some = pi2.subset(['launch', 'idle'])
  assert some.names == ('launch', 'idle')
  assert some.index('idle') == 1
  assert some.motions == (pi2.motions[3], pi2.motions[0])
  np.testing.assert_array_equal(some.latents, pi2.latents[[3, 0]])
  np.testing.assert_array_equal(some.bank.durations, pi2.bank.durations[[3, 0]])
  with pytest.raises(ValueError, match="'fly'.*launch, idle"):
    some.subset(['fly'])


def test_codebook_of_other_modes() -> None:
  motions = library.resolve('idle,launch')
  with pytest.raises(ValueError, match='codebook encodes'):
    mode_set.ModeSet(motions, codebook.Codebook(('launch', 'idle'), np.eye(2)))
  with pytest.raises(ValueError, match='at least one'):
    mode_set.one_hot([])
  with pytest.raises(ValueError, match='must be unique'):
    mode_set.one_hot(motions[:1] * 2)
