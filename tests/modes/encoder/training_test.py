"""Tests of dmc_multimode.modes.encoder and autoencoder."""

import dataclasses
import functools
import json
import pathlib
import tempfile
from typing import Any, Callable

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np
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


class FeaturesTest(parameterized.TestCase):
  @parameterized.parameters(
    ('idle', 21), ('walk_forward', 21), ('leap_forward', 41), ('launch', 38)
  )
  def test_one_clip_at_the_control_timestep(
    self, name: str, steps: int
  ) -> None:
    motion = library.modes()[name]
    found = network.features(motion, use_contacts=False)
    self.assertEqual(found.shape, (steps, network.num_features(False)))
    np.testing.assert_allclose(found[0, :3], motion.positions[0])
    np.testing.assert_allclose(found[-1, :3], motion.positions[-1])

  def test_contacts_are_zero_where_there_are_none(self) -> None:
    found = network.features(_turn(90), use_contacts=True)
    self.assertEqual(found.shape[1], network.num_features(True))
    np.testing.assert_array_equal(found[:, 7:], 0)
    walk = network.features(library.modes()['walk_left'], True)
    np.testing.assert_array_equal(walk[[0, 9, 11, 20], 7], [1, 1, 0, 0])

  def test_quaternions_are_continuous(self) -> None:
    motion = _turn(350)
    flipped = dataclasses.replace(
      motion, orientations=motion.orientations * [[-1], [1], [-1]]
    )
    one = network.features(motion, False)[:, 3:]
    other = network.features(flipped, False)[:, 3:]
    np.testing.assert_allclose(one, other, atol=1e-12)
    self.assertLess(np.abs(np.diff(one, axis=0)).max(), 0.2)

  def test_padding_does_not_reach_a_latent(self) -> None:
    trained = _rough()
    together = trained.encode(trained.motions)
    alone = [trained.encode([motion])[0] for motion in trained.motions]
    np.testing.assert_allclose(together, alone, atol=1e-5)


class ConvergenceTest(parameterized.TestCase):
  def test_pi2_meets_the_acceptance(self) -> None:
    trained = _converged()
    for name, error in trained.rmse().items():
      self.assertLess(error, 0.02, name)
    self.assertEqual(list(trained.rmse()), list(library.SETS['pi2']))
    distances = trained.distances()
    between = distances[np.triu_indices(4, 1)]
    self.assertGreater(between.min(), 0.3 * between.mean())

  def test_rmse_is_that_of_the_reconstruction(self) -> None:
    trained = _converged()
    motion = trained.motions[3]
    (found,) = trained.reconstruct([motion])
    wanted = network.features(motion, False)
    self.assertEqual(found.shape, wanted.shape)
    error = np.linalg.norm((found - wanted)[:, :3], axis=-1)
    self.assertAlmostEqual(
      np.sqrt(np.mean(error**2)), trained.rmse()['launch'], places=5
    )

  def test_pi3_needs_contacts(self) -> None:
    motions = library.resolve('pi3')
    self.assertTrue(encoder_training.needs_contacts(motions))
    self.assertFalse(encoder_training.needs_contacts(library.resolve('pi1')))
    with self.assertRaisesRegex(
      ValueError, "'walk_forward' and 'hop_forward'.*use_contacts"
    ):
      encoder_training.train(motions, mode_encoder.EncoderConfig())
    config = dataclasses.replace(_ROUGH, use_contacts=True)
    trained = encoder_training.train(motions, config)
    self.assertGreater(trained.codebook().separation(), 0.1)

  def test_aliased_latents_do_not_pass(self) -> None:
    # Precise enough from the first pass on; only the separation is not.
    seen: list[encoder_training.Progress] = []
    config = mode_encoder.EncoderConfig(max_rmse=10.0, min_separation=0.55)
    trained = encoder_training.train(
      library.resolve('pi1'), config, seen.append
    )
    self.assertLessEqual(seen[0].separation, 0.55)
    self.assertGreater(trained.codebook().separation(), 0.55)
    self.assertGreater(len(seen), 1)

  def test_inaccurate_modes_do_not_pass(self) -> None:
    seen: list[encoder_training.Progress] = []
    config = mode_encoder.EncoderConfig(max_epochs=3, min_separation=0.0)
    with self.assertRaisesRegex(
      encoder_training.ConvergenceError, '3 epochs: worst RMSE 0.[0-9]+ m.*seed'
    ) as caught:
      encoder_training.train(library.resolve('pi2'), config, seen.append)
    self.assertNotIn('\n', str(caught.exception))
    self.assertEqual([p.epoch for p in seen], [1, 2, 3])
    self.assertGreater(seen[-1].worst_rmse, 0.02)

  @parameterized.parameters('idle', 'launch')
  def test_one_mode(self, name: str) -> None:
    trained = encoder_training.train(library.resolve(name), _ROUGH)
    np.testing.assert_array_equal(trained.distances(), [[0.0]])
    np.testing.assert_allclose(
      trained.codebook().latents, np.zeros((1, 4)), atol=1e-5
    )

  def test_all_modes_at_once(self) -> None:
    config = dataclasses.replace(_ROUGH, use_contacts=True)
    trained = encoder_training.train(tuple(library.modes().values()), config)
    self.assertLen(trained.codebook(), 14)

  def test_a_turn_in_place_is_no_idling(self) -> None:
    motions = (library.modes()['idle'], _turn(40))
    trained = encoder_training.train(motions, _ROUGH)
    self.assertGreater(trained.distances()[0, 1], 1.0)


class ModeEncoderTest(parameterized.TestCase):
  def test_latents_are_standardised_over_the_set(self) -> None:
    book = _rough().codebook()
    self.assertEqual(book.names, library.SETS['pi2'])
    self.assertEqual(book.latents.shape, (4, 4))
    np.testing.assert_allclose(book.latents.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(book.latents.std(axis=0), 1, atol=1e-4)

  def test_encodes_a_new_motion_between_its_neighbours(self) -> None:
    trained = _converged()
    idle, walk = trained.motions[:2]
    slow = dataclasses.replace(
      walk, name='slow', positions=(walk.positions + idle.positions[:1]) / 2
    )
    (latent,) = trained.encode([slow])
    gaps = np.linalg.norm(trained.codebook().latents - latent, axis=-1)
    self.assertTrue(np.isfinite(latent).all())
    self.assertLess(max(gaps[:2]), trained.distances()[0, 1])

  def test_same_seed_same_encoder(self) -> None:
    again = encoder_training.train(library.resolve('pi2'), _ROUGH)
    np.testing.assert_array_equal(
      again.codebook().latents, _rough().codebook().latents
    )
    config = dataclasses.replace(_ROUGH, seed=1)
    other = encoder_training.train(library.resolve('pi2'), config)
    self.assertFalse(
      np.allclose(other.codebook().latents, again.codebook().latents)
    )

  def test_leaves_global_state_alone(self) -> None:
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    encoder_training.train(library.resolve('pi2'), _ROUGH)
    self.assertTrue(torch.equal(state, torch.get_rng_state()))
    self.assertEqual(threads, torch.get_num_threads())

  def test_rejects_sets_that_could_not_be_saved(self) -> None:
    idle = library.modes()['idle']
    for motion, message in (
      (dataclasses.replace(idle, name='a:b', mirror=''), 'letters'),
      (dataclasses.replace(idle, duration=1e9), 'duration .* 60'),
    ):
      with self.assertRaisesRegex(ValueError, message):
        encoder_training.train([motion], _ROUGH)
    with self.assertRaisesRegex(ValueError, 'at least one'):
      encoder_training.train([], _ROUGH)
    with self.assertRaisesRegex(ValueError, 'unique'):
      encoder_training.train([idle, idle], _ROUGH)

  @parameterized.parameters(
    ({'latent_dim': 0}, 'latent_dim'),
    ({'hidden': 10**9}, 'hidden'),
    ({'max_epochs': 0}, 'max_epochs'),
    ({'learning_rate': float('nan')}, 'learning_rate'),
    ({'max_rmse': -1.0}, 'max_rmse'),
    ({'min_separation': 0.9}, 'min_separation'),
    ({'seed': -1}, 'seed'),
  )
  def test_config_rejects(self, changes: dict[str, Any], field: str) -> None:
    with self.assertRaisesRegex(ValueError, field):
      mode_encoder.EncoderConfig(**changes)


def _edit(path: pathlib.Path, change: Callable[[dict[str, Any]], Any]) -> None:
  """Applies `change` to the description in a JSON file."""
  data = json.loads(path.read_text())
  change(data)
  path.write_text(json.dumps(data))


class FilesTest(parameterized.TestCase):
  def setUp(self) -> None:
    super().setUp()
    temporary = tempfile.TemporaryDirectory()
    self.addCleanup(temporary.cleanup)
    self.folder = pathlib.Path(temporary.name)
    _rough().save(self.folder)
    self.config = self.folder / mode_encoder.CONFIG_FILE
    self.weights = self.folder / mode_encoder.WEIGHTS_FILE

  def fails(self, path: pathlib.Path, message: str) -> None:
    with self.assertRaisesRegex(ValueError, message) as caught:
      mode_encoder.load(self.folder)
    text = str(caught.exception)
    self.assertStartsWith(text, f'{path}: ')
    self.assertIn('train_encoder', text)
    self.assertNotIn('\n', text)

  def test_round_trip(self) -> None:
    loaded, wanted = mode_encoder.load(self.folder), _rough()
    self.assertEqual(loaded.config, wanted.config)
    np.testing.assert_array_equal(
      loaded.codebook().latents, wanted.codebook().latents
    )
    self.assertEqual(loaded.rmse(), wanted.rmse())
    for found, motion in zip(loaded.motions, wanted.motions, strict=True):
      for field in vars(motion):
        np.testing.assert_array_equal(
          getattr(found, field), getattr(motion, field)
        )

  def test_saves_the_same_bytes_and_nothing_else(self) -> None:
    other = self.folder / 'deep' / 'er'
    mode_encoder.load(self.folder).save(other)
    names = sorted(path.name for path in other.iterdir())
    self.assertEqual(
      names, [mode_encoder.CONFIG_FILE, mode_encoder.WEIGHTS_FILE]
    )
    for name in names:
      self.assertEqual(
        (other / name).read_bytes(), (self.folder / name).read_bytes()
      )

  def test_loading_leaves_the_generator_alone(self) -> None:
    state = torch.get_rng_state()
    mode_encoder.load(self.folder)
    self.assertTrue(torch.equal(state, torch.get_rng_state()))

  def test_missing(self) -> None:
    self.weights.unlink()
    self.fails(self.weights, 'No such file')
    self.config.unlink()
    self.fails(self.config, 'No such file')

  def test_every_truncation_of_the_weights(self) -> None:
    content = self.weights.read_bytes()
    for size in (0, 1, 8, 100, len(content) // 2, len(content) - 1):
      self.weights.write_bytes(content[:size])
      self.fails(self.weights, 'truncated')

  def test_every_truncation_of_the_description(self) -> None:
    content = self.config.read_bytes()
    for size in (0, 1, 100, len(content) // 2, len(content) - 3):
      self.config.write_bytes(content[:size])
      self.fails(self.config, 'not a mode encoder')

  def test_weights_of_another_encoder(self) -> None:
    config = dataclasses.replace(_ROUGH, seed=1)
    other = encoder_training.train(library.resolve('pi2'), config)
    other.save(self.folder / 'other')
    (self.folder / 'other' / mode_encoder.WEIGHTS_FILE).replace(self.weights)
    self.fails(self.weights, 'another encoder')

  @parameterized.parameters(
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
  )
  def test_foreign_description(
    self, change: Callable[[dict[str, Any]], Any], message: str
  ) -> None:
    _edit(self.config, change)
    self.fails(self.config, message)

  @parameterized.parameters('[1]', 'null', '"text"', '[' * 100_000, '\x00')
  def test_other_json(self, text: str) -> None:
    self.config.write_text(text)
    self.fails(self.config, 'not a mode encoder')

  def test_config_of_another_size(self) -> None:
    _edit(self.config, lambda data: data['config'].update(hidden=16))
    self.fails(self.weights, 'do not fit')

  @parameterized.parameters((b'junk', 'safetensors'), (None, 'finite'))
  def test_foreign_weights(self, content: bytes | None, message: str) -> None:
    if content is None:
      state = safetensors.torch.load_file(self.weights)
      state['latent_mean'][0] = float('nan')
      content = safetensors.torch.save(state)
    self.weights.write_bytes(content)
    digest = mode_encoder.digest(content)
    _edit(self.config, lambda data: data.update(weights_sha256=digest))
    self.fails(self.weights, message)


if __name__ == '__main__':
  absltest.main()
