"""Trained mode encoders, and their two files."""

import dataclasses
import hashlib
import json
import os
import pathlib
from typing import Annotated, Sequence

import numpy as np
import pydantic
import safetensors
import safetensors.torch
import torch

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import network as autoencoder
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import files

WEIGHTS_FILE = 'encoder.safetensors'
CONFIG_FILE = 'encoder.json'

_FORMAT = 'dmc_multimode.mode_encoder.v1'
_ADVICE = 'train one with `python -m dmc_multimode.bin.train_encoder`.'
# Upper bounds: a foreign file cannot ask for all memory.
_Units = Annotated[int, pydantic.Field(ge=1, le=1024)]


@config_lib.dataclass
class EncoderConfig:
  """Sizes, tolerances and seed of a mode encoder and its training.

  Attributes:
    latent_dim: n_m, the length of a latent.
    hidden: units of the encoder's and of the decoder's LSTM.
    use_contacts: adds the contacts of the feet to the features; without them
      modes that differ in nothing else (walk and hop of pi3) are alike.
    learning_rate: of Adam.
    max_epochs: passes over the set after which training has failed.
    max_rmse: bound on the error of every mode's trunk position, metres.
    min_separation: lower bound of the smallest over the mean distance between
      latents, in [0, 0.6).
    seed: of the initial weights; nothing else is random.
    num_feet: of the contacts.
  """

  latent_dim: _Units = 4
  hidden: _Units = 32
  use_contacts: bool = False
  learning_rate: config_lib.Positive = 1e-2
  max_epochs: config_lib.PositiveInt = 10_000
  max_rmse: config_lib.Positive = 0.02
  min_separation: Annotated[float, pydantic.Field(ge=0, lt=0.6)] = 0.3
  seed: Annotated[int, pydantic.Field(ge=0, lt=2**63)] = 0
  num_feet: Annotated[int, pydantic.Field(ge=2, le=4)] = 2

  @property
  def contacts(self) -> tuple[bool, int]:
    """Contacts among the features: whether there are, and of how many feet."""
    return self.use_contacts, self.num_feet


@dataclasses.dataclass(frozen=True, eq=False)
class ModeEncoder:
  """A trained autoencoder and the modes of its training.

  Attributes:
    config: of the training.
    motions: the mode set, whose order gives the mode indices.
    network: the autoencoder with its statistics.
  """

  config: EncoderConfig
  motions: tuple[motion_lib.ReferenceMotion, ...]
  network: autoencoder.Autoencoder

  def __repr__(self) -> str:
    """Returns one line: the modes."""
    return f'ModeEncoder({", ".join(motion.name for motion in self.motions)})'

  def encode(self, motions: Sequence[motion_lib.ReferenceMotion]) -> np.ndarray:
    """Returns the latents of any motions, float32, [N, n_m].

    Latents are standardised by the statistics of the training set.
    """
    return self._latents(
      autoencoder.Batch(motions, *self.config.contacts)
    ).numpy()

  def reconstruct(
    self, motions: Sequence[motion_lib.ReferenceMotion]
  ) -> list[np.ndarray]:
    """Returns the reconstruction of each motion from its latent.

    Returns:
      For each motion the features of its T steps, [T, F], in the columns and
      units of `autoencoder.features`.
    """
    network = self.network
    batch = autoencoder.Batch(motions, *self.config.contacts)
    with torch.no_grad():
      decoded = network.decode(self._latents(batch), batch.features.shape[1])
      decoded = decoded * network.feature_scale + network.feature_mean
    lengths = (batch.last + 1).tolist()
    return [x[:n].numpy() for x, n in zip(decoded, lengths, strict=True)]

  def rmse(self) -> dict[str, float]:
    """Returns each mode's RMSE of the trunk position, metres."""
    errors = {}
    reconstructed = self.reconstruct(self.motions)
    for motion, found in zip(self.motions, reconstructed, strict=True):
      error = found - autoencoder.features(motion, *self.config.contacts)
      squares = np.square(error[:, autoencoder.POSITION]).sum(axis=-1)
      errors[motion.name] = float(np.sqrt(squares.mean()))
    return errors

  def codebook(self) -> codebook_lib.Codebook:
    """Returns the latents of the mode set."""
    names = tuple(motion.name for motion in self.motions)
    return codebook_lib.Codebook(names, self.encode(self.motions))

  def distances(self) -> np.ndarray:
    """Returns the distances between the modes' latents, [M, M]."""
    return self.codebook().distances()

  def save(self, directory: str | os.PathLike[str]) -> None:
    """Writes encoder.safetensors and encoder.json, each atomically.

    The JSON file holds the config and the modes' full definitions, and the
    digest of the weights, so that files of two encoders are never mixed.

    Raises:
      OSError: the directory cannot be made or written.
    """
    directory = pathlib.Path(files.expand(directory))
    directory.mkdir(parents=True, exist_ok=True)
    weights = safetensors.torch.save(self.network.state_dict())
    config = dataclasses.asdict(self.config)
    if self.config.num_feet == motion_lib.NUM_FEET:
      del config['num_feet']  # As before there were other robots.
    description = {
      'format': _FORMAT,
      'config': config,
      'modes': [mode_files.motion_to_dict(motion) for motion in self.motions],
      'weights_sha256': digest(weights),
    }
    text = json.dumps(description, indent=1, allow_nan=False) + '\n'
    files.write(directory / WEIGHTS_FILE, weights)
    files.write(directory / CONFIG_FILE, text.encode())

  def _latents(self, batch: autoencoder.Batch) -> torch.Tensor:
    network = self.network
    with torch.no_grad():
      raw = network.encode(batch.standardised(network), batch.last)
      return (raw - network.latent_mean) / network.latent_scale


def load(directory: str | os.PathLike[str]) -> ModeEncoder:
  """Reads an encoder of `ModeEncoder.save`; runs no code from the files.

  Raises:
    ValueError: a file is missing, truncated or foreign, or the two do not
      belong together; one line with the file and the remedy.
  """
  path = pathlib.Path(files.expand(directory)) / CONFIG_FILE
  try:
    description = json.loads(_read(path))
    if description['format'] != _FORMAT:
      raise ValueError(f'format {description["format"]!r}')
    config = config_lib.build(EncoderConfig, description['config'])
    modes = tuple(mode_files.motion_from_dict(m) for m in description['modes'])
    motion_lib.check_names(modes)
    expected = description['weights_sha256']
  except (KeyError, TypeError, ValueError, RecursionError) as error:
    raise ValueError(
      f'{path}: not a mode encoder of this version ({_reason(error)}); '
      f'{_ADVICE}'
    ) from None
  path = path.with_name(WEIGHTS_FILE)
  weights = _read(path)
  if digest(weights) != expected:
    raise ValueError(
      f'{path}: truncated, or of another encoder than {CONFIG_FILE} beside it; '
      f'copy both files again, or {_ADVICE}'
    )
  return ModeEncoder(config, modes, _network(path, weights, config))


def digest(weights: bytes) -> str:
  """Returns the digest of the weights file, for encoder.json."""
  return hashlib.sha256(weights).hexdigest()


def _read(path: pathlib.Path) -> bytes:
  """Returns a file's content; raises ValueError if it is missing."""
  try:
    return files.read_bounded(path)
  except OSError as error:
    raise ValueError(
      f'{path}: cannot be read ({error.strerror}); {_ADVICE}'
    ) from None


def _reason(error: Exception) -> str:
  missing = f'{error} is missing' if isinstance(error, KeyError) else str(error)
  return missing.rstrip('.')


def make_network(config: EncoderConfig) -> autoencoder.Autoencoder:
  """Returns an untrained network."""
  size = autoencoder.num_features(*config.contacts)
  return autoencoder.Autoencoder(
    size, config.latent_dim, config.hidden, config.seed
  )


def _network(
  path: pathlib.Path, weights: bytes, config: EncoderConfig
) -> autoencoder.Autoencoder:
  """Returns the network with `weights`; raises ValueError."""
  network = make_network(config)
  kind = lambda value: (value.dtype, tuple(value.shape))
  expected = {k: kind(v) for k, v in network.state_dict().items()}
  try:
    state = safetensors.torch.load(weights)
  except (
    safetensors.SafetensorError,
    AttributeError,  # A dtype that this torch does not know.
    KeyError,
    RuntimeError,
  ) as error:
    raise ValueError(f'{path}: not safetensors ({error}); {_ADVICE}') from None
  if {k: kind(v) for k, v in state.items()} != expected:
    raise ValueError(
      f'{path}: its tensors do not fit the config in {CONFIG_FILE}; {_ADVICE}'
    )
  if not all(bool(value.isfinite().all()) for value in state.values()):
    raise ValueError(f'{path}: has weights that are not finite; {_ADVICE}')
  network.load_state_dict(state)
  return network.requires_grad_(False)
