"""Tests of dmc_multimode.modes.encoder and autoencoder."""

import dataclasses
import functools
import json
import pathlib
from typing import Any, Callable

import numpy as np
import pytest
import safetensors.torch
import torch

from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import network
from dmc_multimode.modes.encoder import training as encoder_training

# Reached within a few passes: for what does not depend on the tolerances.
_ROUGH = mode_encoder.EncoderConfig(max_rmse=0.5, min_separation=0.1)


@functools.cache
def _rough() -> mode_encoder.ModeEncoder:
  return encoder_training.train(library.resolve('pi2'), _ROUGH)


@functools.cache
def _other() -> mode_encoder.ModeEncoder:
  config = dataclasses.replace(_ROUGH, seed=1)
  return encoder_training.train(library.resolve('pi2'), config)


@functools.cache
def _converged() -> mode_encoder.ModeEncoder:
  return encoder_training.train(
    library.resolve('pi2'), mode_encoder.EncoderConfig()
  )


def _turn(degrees: float) -> motion_lib.ReferenceMotion:
  """A turn in place in two halves, so that slerp knows its direction."""
  half = np.radians(degrees) / 2
  angles = np.array([0, half / 2, half])
  zeros = np.zeros(3)
  return motion_lib.ReferenceMotion(
    name='turn',
    kind=motion_lib.PERIODIC,
    duration=0.9,
    phases=np.array([0, 0.5, 1]),
    positions=np.tile([0, 0, 0.5], (3, 1)),
    orientations=np.stack(
      [np.cos(angles), zeros, zeros, np.sin(angles)], axis=1
    ),
  )


@pytest.mark.parametrize(
  ('name', 'steps'),
  [('idle', 21), ('walk_forward', 21), ('leap_forward', 41), ('launch', 38)],
)
def test_one_clip_at_the_control_timestep(name: str, steps: int) -> None:
  motion = library.modes()[name]
  found = network.features(motion, use_contacts=False)
  assert found.shape == (steps, network.num_features(False))
  np.testing.assert_allclose(found[[0, -1], :3], motion.positions[[0, -1]])


def test_contacts_are_zero_where_there_are_none() -> None:
  found = network.features(_turn(90), use_contacts=True)
  assert found.shape[1] == network.num_features(True)
  np.testing.assert_array_equal(found[:, 7:], 0)
  walk = network.features(library.modes()['walk_left'], True)
  np.testing.assert_array_equal(walk[[0, 9, 11, 18], 7], [1, 1, 0, 0])


def test_one_mode_is_at_the_origin() -> None:
  trained = encoder_training.train(library.resolve('launch'), _ROUGH)
  latents = trained.codebook().latents
  np.testing.assert_allclose(latents, np.zeros((1, 4)), atol=1e-5)


def test_quaternions_are_continuous() -> None:
  motion = _turn(350)
  flipped = dataclasses.replace(
    motion, orientations=motion.orientations * [[-1], [1], [-1]]
  )
  one = network.features(motion, False)[:, 3:]
  other = network.features(flipped, False)[:, 3:]
  np.testing.assert_allclose(one, other, atol=1e-12)
  assert np.abs(np.diff(one, axis=0)).max() < 0.2


@pytest.mark.slow
def test_pi2_meets_the_acceptance() -> None:
  trained = _converged()
  assert list(trained.rmse()) == list(library.SETS['pi2'])
  for motion in trained.motions:
    (found,) = trained.reconstruct([motion])
    error = (found - network.features(motion, False))[:, :3]
    rmse = np.sqrt(np.mean(np.sum(error**2, axis=-1)))
    assert trained.rmse()[motion.name] == pytest.approx(rmse, abs=1e-5)
    assert rmse < 0.02, motion.name
  distances = trained.distances()
  between = distances[np.triu_indices(4, 1)]
  assert between.min() > 0.3 * between.mean()


@pytest.mark.slow
def test_pi3_needs_contacts() -> None:
  motions = library.resolve('pi3')
  assert encoder_training.needs_contacts(motions)
  assert not encoder_training.needs_contacts(library.resolve('pi1'))
  with pytest.raises(
    ValueError, match="'walk_forward' and 'hop_forward'.*use_contacts"
  ):
    encoder_training.train(motions, mode_encoder.EncoderConfig())
  config = dataclasses.replace(_ROUGH, use_contacts=True)
  trained = encoder_training.train(motions, config)
  assert trained.codebook().separation() > 0.1


@pytest.mark.slow
def test_aliased_latents_do_not_pass() -> None:
  # Precise enough from the first pass on; only the separation is not.
  seen: list[encoder_training.Progress] = []
  config = mode_encoder.EncoderConfig(max_rmse=10.0, min_separation=0.55)
  trained = encoder_training.train(library.resolve('pi1'), config, seen.append)
  assert seen[0].separation <= 0.55
  assert trained.codebook().separation() > 0.55
  assert len(seen) > 1


@pytest.mark.parametrize('duration', [0.63, 3.0])
def test_two_modes_of_one_pose_get_latents_of_their_own(
  duration: float,
) -> None:
  """Not those that rounding tells apart: the encoder has to learn to."""
  idle = library.modes()['idle']
  twin = dataclasses.replace(
    idle, name='wait', mirror='', kind='transient', duration=duration
  )
  seen: list[encoder_training.Progress] = []
  config = mode_encoder.EncoderConfig()
  trained = encoder_training.train([idle, twin], config, seen.append)
  # An untrained encoder is precise enough, with latents 2e-6 apart.
  assert seen[0].worst_rmse < 0.03 and seen[0].separation < 1e-4
  one, other = trained.codebook().latents
  assert np.linalg.norm(one - other) > 1.0
  nudged = trained.network.state_dict()
  nudged['to_latent.bias'] += 2e-7  # About the rounding of another machine.
  trained.network.load_state_dict(nudged)
  np.testing.assert_allclose(
    trained.codebook().latents, [one, other], atol=0.01
  )


def test_distances_are_relative_to_a_mean_of_one_at_least() -> None:
  apart = encoder_training.relative(torch.tensor([2.0, 4.0, 6.0]))
  np.testing.assert_allclose(apart, [0.5, 1.0, 1.5])
  apart = encoder_training.relative(torch.tensor([0.1, 0.3]))
  np.testing.assert_allclose(apart, [0.1, 0.3])


def test_inaccurate_modes_do_not_pass() -> None:
  seen: list[encoder_training.Progress] = []
  config = mode_encoder.EncoderConfig(max_epochs=3, min_separation=0.0)
  with pytest.raises(
    encoder_training.ConvergenceError,
    match='3 epochs: worst RMSE 0.[0-9]+ m.*seed',
  ) as caught:
    encoder_training.train(library.resolve('pi2'), config, seen.append)
  assert '\n' not in str(caught.value)
  assert [p.epoch for p in seen] == [1, 2, 3]
  assert seen[-1].worst_rmse > 0.02


def test_seed_alone_decides() -> None:
  """And the state of torch stays as it is."""
  state, threads = torch.get_rng_state(), torch.get_num_threads()
  again = encoder_training.train(library.resolve('pi2'), _ROUGH)
  assert torch.equal(state, torch.get_rng_state())
  assert threads == torch.get_num_threads()
  latents = again.codebook().latents
  np.testing.assert_array_equal(latents, _rough().codebook().latents)
  assert not np.allclose(_other().codebook().latents, latents)
  # They are standardised over the set, whose padding reaches none of them.
  np.testing.assert_allclose(latents.mean(axis=0), 0, atol=1e-5)
  np.testing.assert_allclose(latents.std(axis=0), 1, atol=1e-4)
  alone = [again.encode([motion])[0] for motion in again.motions]
  np.testing.assert_allclose(latents, alone, atol=1e-5)


def test_rejects_sets_that_could_not_be_saved() -> None:
  idle = library.modes()['idle']
  for motion, message in (
    (dataclasses.replace(idle, name='a:b', mirror=''), 'letters'),
    (dataclasses.replace(idle, duration=1e9), 'duration .* 60'),
  ):
    with pytest.raises(ValueError, match=message):
      encoder_training.train([motion], _ROUGH)
  with pytest.raises(ValueError, match='at least one'):
    encoder_training.train([], _ROUGH)
  with pytest.raises(ValueError, match='unique'):
    encoder_training.train([idle, idle], _ROUGH)


def _edit(path: pathlib.Path, change: Callable[[dict[str, Any]], Any]) -> None:
  """Applies `change` to the description in a JSON file."""
  data = json.loads(path.read_text())
  change(data)
  path.write_text(json.dumps(data))


@pytest.fixture
def folder(tmp_path: pathlib.Path) -> pathlib.Path:
  """A saved encoder."""
  _rough().save(tmp_path)
  return tmp_path


def _fails(path: pathlib.Path, message: str) -> None:
  with pytest.raises(ValueError, match=message) as caught:
    mode_encoder.load(path.parent)
  text = str(caught.value)
  assert text.startswith(f'{path}: ')
  assert 'train_encoder' in text
  assert '\n' not in text


def test_round_trip(folder: pathlib.Path) -> None:
  state = torch.get_rng_state()
  loaded, wanted = mode_encoder.load(folder), _rough()
  assert torch.equal(state, torch.get_rng_state())
  assert loaded.config == wanted.config
  assert loaded.rmse() == wanted.rmse()
  np.testing.assert_array_equal(
    loaded.codebook().latents, wanted.codebook().latents
  )
  # The same bytes, which hold the motions, and nothing else.
  other = folder / 'deep' / 'er'
  loaded.save(other)
  names = sorted(path.name for path in other.iterdir())
  assert names == [mode_encoder.CONFIG_FILE, mode_encoder.WEIGHTS_FILE]
  for name in names:
    assert (other / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize(
  ('name', 'message'),
  [
    (mode_encoder.WEIGHTS_FILE, 'truncated'),
    (mode_encoder.CONFIG_FILE, 'not a mode encoder'),
  ],
)
def test_truncated_and_missing(
  folder: pathlib.Path, name: str, message: str
) -> None:
  path = folder / name
  content = path.read_bytes()
  for size in (0, 1, 100, len(content) // 2, len(content) - 3):
    path.write_bytes(content[:size])
    _fails(path, message)
  path.unlink()
  _fails(path, 'No such file')


def _with_weights(folder: pathlib.Path, content: bytes) -> None:
  """Puts other weights into a folder, and their digest."""
  (folder / mode_encoder.WEIGHTS_FILE).write_bytes(content)
  digest = mode_encoder.digest(content)
  _edit(
    folder / mode_encoder.CONFIG_FILE,
    lambda data: data.update(weights_sha256=digest),
  )


def test_foreign_weights(folder: pathlib.Path) -> None:
  path = folder / mode_encoder.WEIGHTS_FILE
  weights = path.read_bytes()
  _other().save(folder / 'other')
  path.write_bytes((folder / 'other' / path.name).read_bytes())
  _fails(path, 'another encoder')
  _with_weights(folder, b'junk')
  _fails(path, 'safetensors')
  state = safetensors.torch.load(weights)
  state['latent_mean'][0] = float('nan')
  _with_weights(folder, safetensors.torch.save(state))
  _fails(path, 'finite')
  _with_weights(folder, weights)
  _edit(
    folder / mode_encoder.CONFIG_FILE,
    lambda data: data['config'].update(hidden=16),
  )
  _fails(path, 'do not fit')


@pytest.mark.parametrize(
  ('change', 'message'),
  [
    (lambda data: data.update(format='x'), "format 'x'"),
    (lambda data: data.pop('modes'), "'modes' is missing"),
    (lambda data: data.update(modes=3), 'iterable'),
    (lambda data: data.update(modes=[]), 'at least one mode'),
    (lambda data: data['modes'].append(data['modes'][0]), 'unique'),
    (lambda data: data['modes'][1].pop('kind'), "'kind' is missing"),
    (lambda data: data.update(config=None), 'EncoderConfig'),
    (lambda data: data['config'].update(hidden=10**9), 'hidden'),
    (lambda data: data['config'].update(more=1), 'more'),
  ],
)
def test_foreign_description(
  folder: pathlib.Path, change: Callable[[dict[str, Any]], Any], message: str
) -> None:
  path = folder / mode_encoder.CONFIG_FILE
  _edit(path, change)
  _fails(path, message)
  path.write_text('[' * 100_000)
  _fails(path, 'not a mode encoder')
