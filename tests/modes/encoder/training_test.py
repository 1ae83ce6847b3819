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
  np.testing.assert_allclose(found[0, :3], motion.positions[0])
  np.testing.assert_allclose(found[-1, :3], motion.positions[-1])


def test_contacts_are_zero_where_there_are_none() -> None:
  found = network.features(_turn(90), use_contacts=True)
  assert found.shape[1] == network.num_features(True)
  np.testing.assert_array_equal(found[:, 7:], 0)
  walk = network.features(library.modes()['walk_left'], True)
  np.testing.assert_array_equal(walk[[0, 9, 11, 20], 7], [1, 1, 0, 0])


def test_quaternions_are_continuous() -> None:
  motion = _turn(350)
  flipped = dataclasses.replace(
    motion, orientations=motion.orientations * [[-1], [1], [-1]]
  )
  one = network.features(motion, False)[:, 3:]
  other = network.features(flipped, False)[:, 3:]
  np.testing.assert_allclose(one, other, atol=1e-12)
  assert np.abs(np.diff(one, axis=0)).max() < 0.2


def test_padding_does_not_reach_a_latent() -> None:
  trained = _rough()
  together = trained.encode(trained.motions)
  alone = [trained.encode([motion])[0] for motion in trained.motions]
  np.testing.assert_allclose(together, alone, atol=1e-5)


@pytest.mark.slow
def test_pi2_meets_the_acceptance() -> None:
  trained = _converged()
  for name, error in trained.rmse().items():
    assert error < 0.02, name
  assert list(trained.rmse()) == list(library.SETS['pi2'])
  distances = trained.distances()
  between = distances[np.triu_indices(4, 1)]
  assert between.min() > 0.3 * between.mean()


def test_rmse_is_that_of_the_reconstruction() -> None:
  trained = _converged()
  motion = trained.motions[3]
  (found,) = trained.reconstruct([motion])
  wanted = network.features(motion, False)
  assert found.shape == wanted.shape
  error = np.linalg.norm((found - wanted)[:, :3], axis=-1)
  assert np.sqrt(np.mean(error**2)) == pytest.approx(
    trained.rmse()['launch'], abs=1e-5
  )


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


@pytest.mark.parametrize('name', ['idle', 'launch'])
def test_one_mode(name: str) -> None:
  trained = encoder_training.train(library.resolve(name), _ROUGH)
  np.testing.assert_array_equal(trained.distances(), [[0.0]])
  np.testing.assert_allclose(
    trained.codebook().latents, np.zeros((1, 4)), atol=1e-5
  )


@pytest.mark.slow
def test_all_modes_at_once() -> None:
  config = dataclasses.replace(_ROUGH, use_contacts=True)
  trained = encoder_training.train(tuple(library.modes().values()), config)
  assert len(trained.codebook()) == 14


def test_a_turn_in_place_is_no_idling() -> None:
  motions = (library.modes()['idle'], _turn(40))
  trained = encoder_training.train(motions, _ROUGH)
  assert trained.distances()[0, 1] > 1.0


def test_latents_are_standardised_over_the_set() -> None:
  book = _rough().codebook()
  assert book.names == library.SETS['pi2']
  assert book.latents.shape == (4, 4)
  np.testing.assert_allclose(book.latents.mean(axis=0), 0, atol=1e-5)
  np.testing.assert_allclose(book.latents.std(axis=0), 1, atol=1e-4)


def test_encodes_a_new_motion_between_its_neighbours() -> None:
  trained = _converged()
  idle, walk = trained.motions[:2]
  slow = dataclasses.replace(
    walk, name='slow', positions=(walk.positions + idle.positions[:1]) / 2
  )
  (latent,) = trained.encode([slow])
  gaps = np.linalg.norm(trained.codebook().latents - latent, axis=-1)
  assert np.isfinite(latent).all()
  assert max(gaps[:2]) < trained.distances()[0, 1]


def test_same_seed_same_encoder() -> None:
  again = encoder_training.train(library.resolve('pi2'), _ROUGH)
  np.testing.assert_array_equal(
    again.codebook().latents, _rough().codebook().latents
  )
  config = dataclasses.replace(_ROUGH, seed=1)
  other = encoder_training.train(library.resolve('pi2'), config)
  assert not np.allclose(other.codebook().latents, again.codebook().latents)


def test_leaves_global_state_alone() -> None:
  state, threads = torch.get_rng_state(), torch.get_num_threads()
  encoder_training.train(library.resolve('pi2'), _ROUGH)
  assert torch.equal(state, torch.get_rng_state())
  assert threads == torch.get_num_threads()


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


@pytest.mark.parametrize(
  ('changes', 'field'),
  [
    ({'latent_dim': 0}, 'latent_dim'),
    ({'hidden': 10**9}, 'hidden'),
    ({'max_epochs': 0}, 'max_epochs'),
    ({'learning_rate': float('nan')}, 'learning_rate'),
    ({'max_rmse': -1.0}, 'max_rmse'),
    ({'min_separation': 0.9}, 'min_separation'),
    ({'seed': -1}, 'seed'),
  ],
)
def test_config_rejects(changes: dict[str, Any], field: str) -> None:
  with pytest.raises(ValueError, match=field):
    mode_encoder.EncoderConfig(**changes)


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
  loaded, wanted = mode_encoder.load(folder), _rough()
  assert loaded.config == wanted.config
  np.testing.assert_array_equal(
    loaded.codebook().latents, wanted.codebook().latents
  )
  assert loaded.rmse() == wanted.rmse()
  for found, motion in zip(loaded.motions, wanted.motions, strict=True):
    for field in vars(motion):
      np.testing.assert_array_equal(
        getattr(found, field), getattr(motion, field)
      )


def test_saves_the_same_bytes_and_nothing_else(folder: pathlib.Path) -> None:
  other = folder / 'deep' / 'er'
  mode_encoder.load(folder).save(other)
  names = sorted(path.name for path in other.iterdir())
  assert names == [mode_encoder.CONFIG_FILE, mode_encoder.WEIGHTS_FILE]
  for name in names:
    assert (other / name).read_bytes() == (folder / name).read_bytes()


def test_loading_leaves_the_generator_alone(folder: pathlib.Path) -> None:
  state = torch.get_rng_state()
  mode_encoder.load(folder)
  assert torch.equal(state, torch.get_rng_state())


def test_missing(folder: pathlib.Path) -> None:
  (folder / mode_encoder.WEIGHTS_FILE).unlink()
  _fails(folder / mode_encoder.WEIGHTS_FILE, 'No such file')
  (folder / mode_encoder.CONFIG_FILE).unlink()
  _fails(folder / mode_encoder.CONFIG_FILE, 'No such file')


def test_every_truncation_of_the_weights(folder: pathlib.Path) -> None:
  content = (folder / mode_encoder.WEIGHTS_FILE).read_bytes()
  for size in (0, 1, 8, 100, len(content) // 2, len(content) - 1):
    (folder / mode_encoder.WEIGHTS_FILE).write_bytes(content[:size])
    _fails(folder / mode_encoder.WEIGHTS_FILE, 'truncated')


def test_every_truncation_of_the_description(folder: pathlib.Path) -> None:
  content = (folder / mode_encoder.CONFIG_FILE).read_bytes()
  for size in (0, 1, 100, len(content) // 2, len(content) - 3):
    (folder / mode_encoder.CONFIG_FILE).write_bytes(content[:size])
    _fails(folder / mode_encoder.CONFIG_FILE, 'not a mode encoder')


def test_weights_of_another_encoder(folder: pathlib.Path) -> None:
  config = dataclasses.replace(_ROUGH, seed=1)
  other = encoder_training.train(library.resolve('pi2'), config)
  other.save(folder / 'other')
  (folder / 'other' / mode_encoder.WEIGHTS_FILE).replace(
    folder / mode_encoder.WEIGHTS_FILE
  )
  _fails(folder / mode_encoder.WEIGHTS_FILE, 'another encoder')


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
    (lambda data: data['config'].update(hidden=True), 'hidden'),
    (lambda data: data['config'].update(hidden=10**9), 'hidden'),
    (lambda data: data['config'].update(more=1), 'more'),
  ],
)
def test_foreign_description(
  folder: pathlib.Path, change: Callable[[dict[str, Any]], Any], message: str
) -> None:
  _edit(folder / mode_encoder.CONFIG_FILE, change)
  _fails(folder / mode_encoder.CONFIG_FILE, message)


@pytest.mark.parametrize(
  'text', ['[1]', 'null', '"text"', '[' * 100_000, '\x00']
)
def test_other_json(folder: pathlib.Path, text: str) -> None:
  (folder / mode_encoder.CONFIG_FILE).write_text(text)
  _fails(folder / mode_encoder.CONFIG_FILE, 'not a mode encoder')


def test_config_of_another_size(folder: pathlib.Path) -> None:
  _edit(
    folder / mode_encoder.CONFIG_FILE,
    lambda data: data['config'].update(hidden=16),
  )
  _fails(folder / mode_encoder.WEIGHTS_FILE, 'do not fit')


@pytest.mark.parametrize(
  ('content', 'message'), [(b'junk', 'safetensors'), (None, 'finite')]
)
def test_foreign_weights(
  folder: pathlib.Path, content: bytes | None, message: str
) -> None:
  if content is None:
    state = safetensors.torch.load_file(folder / mode_encoder.WEIGHTS_FILE)
    state['latent_mean'][0] = float('nan')
    content = safetensors.torch.save(state)
  (folder / mode_encoder.WEIGHTS_FILE).write_bytes(content)
  digest = mode_encoder.digest(content)
  _edit(
    folder / mode_encoder.CONFIG_FILE,
    lambda data: data.update(weights_sha256=digest),
  )
  _fails(folder / mode_encoder.WEIGHTS_FILE, message)
