"""Tests of dmc_multimode.modes.mode_set."""

import numpy as np
import pytest

from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes import motion


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


def test_blends_by_hand() -> None:
  pi1 = library.mode_set('pi1')
  names = [
    'walk_forward*0.5+idle*0.5',
    'walk_forward*0.7+walk_left*0.3',
  ]
  blended = mode_set.with_blends(pi1, [*names, 'idle'])
  assert blended.names == (*pi1.names, *names)
  # Of 0.36 m a cycle: half of the way, or 0.7 of it ahead and 0.3 of it aside.
  bank, rows = blended.bank, [-2, -1]
  np.testing.assert_allclose(
    bank.displacements[rows], [[0.18, 0, 0], [0.252, 0.054, 0]], atol=1e-12
  )
  np.testing.assert_array_equal(bank.durations[rows], [0.6, 0.6])
  assert bank.gaits[rows].all()
  for half in (0.25, 0.75):  # The same feet swing.
    walk = bank.sample(np.array([pi1.index('walk_forward')]), np.array([half]))
    both = bank.sample(np.array([len(pi1)]), np.array([half]))
    np.testing.assert_array_equal(both.contact, walk.contact)
  idle, walk = (
    pi1.latents[pi1.index(name)] for name in ('idle', 'walk_forward')
  )
  np.testing.assert_allclose(blended.latents[-2], (idle + walk) / 2, rtol=1e-6)
  assert mode_set.with_blends(pi1, ['idle']) is pi1


@pytest.mark.parametrize(
  ('name', 'message'),
  [
    ('walk_forward*0.5', 'positive weights of sum 1'),
    ('walk_forward*-0.5+idle*1.5', 'positive weights of sum 1'),
    ('walk_forward*half+idle*0.5', 'positive weights of sum 1'),
    ('fly*0.5+idle*0.5', "Unknown mode 'fly'"),
    ('walk_forward*0.5+leap_forward*0.5', 'cannot be blended'),
    ('launch*0.5+idle*0.5', 'launch has no cycle'),
  ],
)
def test_blends_that_are_none(name: str, message: str) -> None:
  with pytest.raises(ValueError, match=message):
    mode_set.with_blends(library.mode_set('pi_all'), [name])


def _level(name: str, contacts: np.ndarray | None) -> motion.ReferenceMotion:
  return motion.ReferenceMotion(
    name,
    motion.PERIODIC,
    0.4,
    np.array([0.0, 0.5, 1.0]),
    np.tile([0.0, 0.0, 0.3], (3, 1)),
    np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
    contacts,
  )


def test_modes_of_four_feet() -> None:
  trot = _level('trot', np.array([[1, 0, 0, 1], [0, 1, 1, 0], [1, 1, 1, 1]]))
  glide = _level('glide', None)
  known = mode_set.one_hot([trot, glide])
  assert known.for_feet(4) is known
  assert known.bank.gaits.tolist() == [True, False]
  swinging, time, length = known.bank.swing_timing(
    np.array([0, 0, 1]), np.array([0.25, 0.75, 0.25])
  )
  np.testing.assert_array_equal(
    swinging, [[0, 1, 1, 0], [1, 0, 0, 1], [0, 0, 0, 0]]
  )
  np.testing.assert_allclose(time[:2], 0.0, atol=1e-12)
  np.testing.assert_allclose(length[:2], 0.2)
  with pytest.raises(ValueError, match='trot has contacts of 4 feet, and the'):
    known.for_feet(2)


def test_modes_without_contacts_are_for_any_feet() -> None:
  two = mode_set.one_hot([_level('glide', None)])
  assert two.bank.num_feet == 2
  four = two.for_feet(4)
  phases = np.zeros(1)
  assert four.bank.sample(np.zeros(1, int), phases).contact.shape == (1, 4)
  assert four.names == two.names and two.bank.num_feet == 2


def test_modes_of_other_feet_make_no_set() -> None:
  walk = _level('walk', np.array([[1, 0], [0, 1], [1, 1]]))
  trot = _level('trot', np.ones((3, 4)))
  with pytest.raises(ValueError, match='walk has contacts of 2 feet, and trot'):
    mode_set.one_hot([walk, trot])
  with pytest.raises(ValueError, match='must be of two or four feet, got 3'):
    _level('tripod', np.ones((3, 3)))
