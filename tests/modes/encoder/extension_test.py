"""Tests of dmc_multimode.modes.extension."""

import dataclasses

import numpy as np
import pytest
import torch

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import extension
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import network
from dmc_multimode.modes.encoder import training as encoder_training

pytestmark = pytest.mark.slow  # The first encoder takes seconds.

_OLD = library.resolve('idle,walk_forward')
# Reached within some passes.
_ROUGH = mode_encoder.EncoderConfig(max_rmse=0.1, hidden=8, learning_rate=0.03)


def _bob(name: str = 'bob', depth: float = 0.5) -> motion_lib.ReferenceMotion:
  """Up and down on the spot; an encoder of `_OLD` knows no such thing."""
  return motion_lib.ReferenceMotion(
    name=name,
    kind=motion_lib.PERIODIC,
    duration=0.6,
    phases=np.array([0.0, 0.5, 1.0]),
    positions=np.array([[0, 0, 0.5], [0, 0, 0.5 - depth], [0, 0, 0.5]]),
    orientations=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
  )


def _held(base: mode_encoder.ModeEncoder) -> mode_set_lib.ModeSet:
  return mode_set_lib.ModeSet(_OLD, base.codebook())


@pytest.fixture(scope='module')
def base() -> mode_encoder.ModeEncoder:
  return encoder_training.train(_OLD, _ROUGH)


@pytest.fixture(scope='module')
def extended(
  base: mode_encoder.ModeEncoder,
) -> tuple[mode_encoder.ModeEncoder, mode_set_lib.ModeSet]:
  return extension.extend(base, _held(base), [_bob()])


def test_old_latents_stay_to_the_bit_and_the_new_mode_is_told_apart(
  base: mode_encoder.ModeEncoder,
  extended: tuple[mode_encoder.ModeEncoder, mode_set_lib.ModeSet],
) -> None:
  trained, modes = extended
  assert modes.names == ('idle', 'walk_forward', 'bob')
  np.testing.assert_array_equal(modes.latents[:2], base.codebook().latents)
  # The encoder itself may be off a little, by what its docstring says.
  np.testing.assert_allclose(trained.encode(_OLD), modes.latents[:2], atol=0.01)
  np.testing.assert_array_equal(trained.encode([_bob()]), modes.latents[2:])
  assert [motion.name for motion in trained.motions] == list(modes.names)
  assert modes.codebook.separation() > _ROUGH.min_separation
  assert trained.rmse()['bob'] < _ROUGH.max_rmse
  # By itself the old encoder would not do.
  (found,) = base.reconstruct([_bob()])
  error = found - network.features(_bob(), use_contacts=False)
  squares = np.square(error[:, network.POSITION]).sum(axis=-1)
  assert np.sqrt(squares.mean()) > _ROUGH.max_rmse


def test_a_second_mode_that_is_as_the_only_one_is_refused() -> None:
  """Of one pair, the smallest distance is always the mean."""
  idle = library.modes()['idle']
  config = dataclasses.replace(_ROUGH, max_epochs=20)
  alone = encoder_training.train([idle], config)
  wait = dataclasses.replace(idle, name='wait', mirror='', duration=0.9)
  held = mode_set_lib.ModeSet((idle,), alone.codebook())
  with pytest.raises(encoder_training.ConvergenceError, match='separation 0'):
    extension.extend(alone, held, [wait])


def test_base_stays_as_it_is(base: mode_encoder.ModeEncoder) -> None:
  before = {k: v.clone() for k, v in base.network.state_dict().items()}
  state = torch.get_rng_state()
  extension.extend(base, _held(base), [_bob()])
  for key, value in base.network.state_dict().items():
    assert torch.equal(value, before[key]), key
  assert torch.equal(torch.get_rng_state(), state)
  assert not any(p.requires_grad for p in base.network.parameters())
  # Nothing new is nothing to train.
  trained, modes = extension.extend(base, _held(base).subset(['idle']), [])
  assert trained.network is base.network
  assert modes.names == ('idle',)
  np.testing.assert_array_equal(modes.latents, base.codebook().latents[:1])


def test_extended_again(
  extended: tuple[mode_encoder.ModeEncoder, mode_set_lib.ModeSet],
) -> None:
  """Of an encoder that is off a little, and in another order."""
  trained, modes = extended
  old = modes.subset(['bob', 'idle', 'walk_forward'])
  _, found = extension.extend(trained, old, library.resolve('leap_forward'))
  assert found.names == ('bob', 'idle', 'walk_forward', 'leap_forward')
  np.testing.assert_array_equal(found.latents[:3], modes.latents[[2, 0, 1]])
  distances = found.codebook.distances()
  assert distances[3, :3].min() > 0.3 * distances.mean()


def test_rejects(base: mode_encoder.ModeEncoder) -> None:
  book = base.codebook()
  other = codebook_lib.Codebook(book.names, book.latents + 0.05)
  longer = codebook_lib.Codebook(book.names, np.eye(2, 5))
  for wrong in (other, longer):
    with pytest.raises(ValueError, match='not the one that the latents'):
      extension.extend(base, mode_set_lib.ModeSet(_OLD, wrong), [_bob()])
  # A motion that is known by another name.
  twin = dataclasses.replace(_OLD[0], name='stay', mirror='stay')
  with pytest.raises(ValueError, match="'idle' and 'stay' .* from scratch"):
    extension.extend(base, _held(base), [twin])
  hasty = dataclasses.replace(
    base, config=dataclasses.replace(base.config, max_epochs=1)
  )
  with pytest.raises(
    encoder_training.ConvergenceError,
    match='new modes in 1 epochs.*from scratch',
  ):
    extension.extend(hasty, _held(base), [_bob()])
