"""The mode encoder: an LSTM autoencoder of whole reference motions.

After Sec. II-B of the paper: the encoder reads a motion step by step and gives
one latent z; z, repeated once a step, drives the decoder, which gives the
motion back. Encoder and decoder are one LSTM layer of 32 each with a linear
read-out, without further activations. Each step is the base's position and
orientation and, if asked for, the feet's contacts.

Three things differ from the paper, which trains on the reconstruction loss
alone and names no end:
- Training ends by what the latents are for: every mode is reconstructed to 2 cm
  and no two modes lie close to each other. Reconstruction alone let modes share
  a corner of the latent space (pi1, one seed: after 2,500 epochs the smallest
  distance was 0.18 of the mean), and a policy cannot tell such modes apart.
- A hinge on the distances between modes is added to the loss, which is zero as
  soon as the modes are apart, and so leaves their arrangement to the data.
- The decoder already gets the latents as the policy will: standardised over the
  set, so that the distances trained are those between the commands.
"""

import dataclasses
import hashlib
import json
import os
import pathlib
from typing import Callable, Sequence

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import nn

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import network as autoencoder
from dmc_multimode.utils import files
from dmc_multimode.utils import typed

WEIGHTS_FILE = 'encoder.safetensors'
CONFIG_FILE = 'encoder.json'

_FORMAT = 'dmc_multimode.mode_encoder.v1'
_ADVICE = 'train one with `python -m dmc_multimode.bin.train_encoder`.'
_MIN_SCALE = 1e-6  # A feature or latent that varies less is constant.
_CONSTANT_FEATURE_SCALE = 0.1  # Metres: a constant one has to be met, too.
SAFETY = 0.98  # Share of a tolerance to reach, for other machines' rounding.
HINGE = 1.6  # Modes repel up to this multiple of the minimum separation.
MAX_GRADIENT_NORM = 1.0
_MAX_UNITS = 1024  # So that a foreign file cannot ask for all memory.


class ConvergenceError(ValueError):
  """Training ended without meeting its tolerances."""


@dataclasses.dataclass(frozen=True)
class EncoderConfig:
  """How a mode encoder is built and trained.

  Attributes:
    latent_dim: n_m, the length of a latent.
    hidden: units of the encoder's and of the decoder's LSTM.
    use_contacts: whether the feet's contacts belong to the features; without
      them modes that differ in nothing else (walk and hop of pi3) are alike.
    learning_rate: of Adam.
    max_epochs: passes over the set after which training has failed.
    max_rmse: every mode's base position is reconstructed to this, in metres.
    min_separation: the smallest distance between two modes' latents over the
      mean distance, to be exceeded; in [0, 0.6).
    seed: of the initial weights, the only random thing.
  """

  latent_dim: int = 4
  hidden: int = 32
  use_contacts: bool = False
  learning_rate: float = 1e-2
  max_epochs: int = 10_000
  max_rmse: float = 0.02
  min_separation: float = 0.3
  seed: int = 0

  def __post_init__(self) -> None:
    for name in ('latent_dim', 'hidden'):
      if not 1 <= getattr(self, name) <= _MAX_UNITS:
        raise ValueError(f'{name} must be from 1 to {_MAX_UNITS}.')
    if not self.max_epochs >= 1:
      raise ValueError('max_epochs must be at least 1.')
    for name in ('learning_rate', 'max_rmse'):
      if not 0 < getattr(self, name) < float('inf'):
        raise ValueError(f'{name} must be positive.')
    if not 0 <= self.seed < 2**63:
      raise ValueError('seed must be from 0 to 2**63 - 1.')
    if not 0 <= self.min_separation < 0.6:
      raise ValueError('min_separation must be in [0, 0.6).')


@dataclasses.dataclass(frozen=True)
class Progress:
  """Where training stands.

  Attributes:
    epoch: passes over the set so far.
    worst_rmse: of the base position, over the modes, in metres.
    separation: smallest over mean distance between two modes' latents.
  """

  epoch: int
  worst_rmse: float
  separation: float


@dataclasses.dataclass(frozen=True, eq=False)
class ModeEncoder:
  """A trained autoencoder with the modes that it was trained on.

  Attributes:
    config: how it was trained.
    motions: the mode set, whose order gives the mode indices.
    network: the autoencoder with its statistics.
  """

  config: EncoderConfig
  motions: tuple[motion_lib.ReferenceMotion, ...]
  network: autoencoder.Autoencoder

  def encode(self, motions: Sequence[motion_lib.ReferenceMotion]) -> np.ndarray:
    """Returns the command vectors of any motions, float32, [N, n_m].

    They are standardised by the statistics of the set trained on.
    """
    return self._latents(
      autoencoder.Batch(motions, self.config.use_contacts)
    ).numpy()

  def reconstruct(
    self, motions: Sequence[motion_lib.ReferenceMotion]
  ) -> list[np.ndarray]:
    """Returns what the decoder makes of each motion's latent.

    Returns:
      For each motion the features of its T steps, [T, F], in the columns and
      units of `autoencoder.features`.
    """
    network = self.network
    batch = autoencoder.Batch(motions, self.config.use_contacts)
    with torch.no_grad():
      decoded = network.decode(self._latents(batch), batch.features.shape[1])
      decoded = decoded * network.feature_scale + network.feature_mean
    lengths = (batch.last + 1).tolist()
    return [x[:n].numpy() for x, n in zip(decoded, lengths, strict=True)]

  def rmse(self) -> dict[str, float]:
    """Returns each mode's error of reconstruction of the base, in metres."""
    errors = {}
    reconstructed = self.reconstruct(self.motions)
    for motion, found in zip(self.motions, reconstructed, strict=True):
      error = found - autoencoder.features(motion, self.config.use_contacts)
      squares = np.square(error[:, autoencoder.POSITION]).sum(axis=-1)
      errors[motion.name] = float(np.sqrt(squares.mean()))
    return errors

  def codebook(self) -> codebook_lib.Codebook:
    """Returns the command vectors of the mode set."""
    names = tuple(motion.name for motion in self.motions)
    return codebook_lib.Codebook(names, self.encode(self.motions))

  def distances(self) -> np.ndarray:
    """Returns the distances between the modes' command vectors, [M, M]."""
    return self.codebook().distances()

  def save(self, directory: str | os.PathLike[str]) -> None:
    """Writes encoder.safetensors and encoder.json, each atomically.

    The JSON file holds the config and the modes' full definitions, and the
    digest of the weights, so that files of two encoders are never mixed.

    Raises:
      OSError: the directory cannot be made or written.
    """
    directory = pathlib.Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    weights = safetensors.torch.save(self.network.state_dict())
    description = {
      'format': _FORMAT,
      'config': dataclasses.asdict(self.config),
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
  """Reads what `ModeEncoder.save` wrote; runs no code from the files.

  Raises:
    ValueError: a file is missing, truncated or foreign, or the two do not
      belong together; one line that names the file and says what to do.
  """
  path = pathlib.Path(directory) / CONFIG_FILE
  try:
    description = json.loads(_read(path))
    if description['format'] != _FORMAT:
      raise ValueError(f'format {description["format"]!r}')
    config = typed.build(EncoderConfig, description['config'])
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
  """Returns what encoder.json remembers the weights file by."""
  return hashlib.sha256(weights).hexdigest()


def _read(path: pathlib.Path) -> bytes:
  """Returns a file's content; raises ValueError where there is none."""
  try:
    return files.read_bounded(path)
  except OSError as error:
    raise ValueError(
      f'{path}: cannot be read ({error.strerror}); {_ADVICE}'
    ) from None


def _reason(error: Exception) -> str:
  missing = f'{error} is missing' if isinstance(error, KeyError) else str(error)
  return missing.rstrip('.')


def _build(config: EncoderConfig) -> autoencoder.Autoencoder:
  """Returns an untrained network."""
  size = autoencoder.num_features(config.use_contacts)
  return autoencoder.Autoencoder(
    size, config.latent_dim, config.hidden, config.seed
  )


def _network(
  path: pathlib.Path, weights: bytes, config: EncoderConfig
) -> autoencoder.Autoencoder:
  """Returns the network that `weights` hold; raises ValueError."""
  network = _build(config)
  kind = lambda value: (value.dtype, tuple(value.shape))
  expected = {k: kind(v) for k, v in network.state_dict().items()}
  try:
    state = safetensors.torch.load(weights)
  except (
    safetensors.SafetensorError,
    AttributeError,  # A type of numbers that this torch does not know.
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


def needs_contacts(motions: Sequence[motion_lib.ReferenceMotion]) -> bool:
  """Returns whether only their contacts tell some of the modes apart."""
  return _twins(motions, False) is not None


def train(
  motions: Sequence[motion_lib.ReferenceMotion],
  config: EncoderConfig,
  progress: Callable[[Progress], None] | None = None,
) -> ModeEncoder:
  """Trains until every tolerance of `config` is met.

  All modes make one batch. The result depends on the motions and `config`
  alone; torch's global generator and thread settings are left as they are.

  Args:
    motions: the mode set.
    config: tolerances and everything else.
    progress: called after every pass, before its gradient step.

  Raises:
    ValueError: two modes are the same to the encoder, or a motion cannot be
      written to a file.
    ConvergenceError: `max_epochs` passed without meeting the tolerances.
  """
  check_set(motions, config)
  batch = autoencoder.Batch(motions, config.use_contacts)
  network = _build(config)
  _set_feature_statistics(network, batch)
  optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
  for epoch in range(1, config.max_epochs + 1):
    loss, rmse, separation = _evaluate(network, batch, config)
    report = Progress(epoch, rmse, separation)
    if progress is not None:
      progress(report)
    if _converged(report, config):
      return ModeEncoder(config, tuple(motions), network.requires_grad_(False))
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
    optimizer.step()
  raise ConvergenceError(
    f'The encoder did not converge in {config.max_epochs} epochs: worst RMSE '
    f'{report.worst_rmse:.3f} m (wanted below {config.max_rmse:g}), separation '
    f'{report.separation:.2f} (wanted above {config.min_separation:g}). Try '
    'another seed, more epochs, or use_contacts.'
  )


def check_set(
  motions: Sequence[motion_lib.ReferenceMotion], config: EncoderConfig
) -> None:
  """Raises ValueError for a set that cannot be encoded, or not be saved."""
  motion_lib.check_names(motions)  # At least one mode, and unique names.
  for motion in motions:
    try:
      mode_files.motion_from_dict(mode_files.motion_to_dict(motion))
    except ValueError as error:
      raise ValueError(f'{motion.name}: {error}') from None
  twins = _twins(motions, config.use_contacts)
  if twins:
    hint = '' if config.use_contacts else ' without use_contacts'
    raise ValueError(
      f'Modes {twins[0]!r} and {twins[1]!r} have the same base motion and '
      f'cannot be told apart{hint}.'
    )


def _twins(
  motions: Sequence[motion_lib.ReferenceMotion], use_contacts: bool
) -> tuple[str, str] | None:
  """Returns the names of two modes with equal features, if there are any."""
  seen: dict[bytes, str] = {}
  for motion in motions:
    # Rounded: microns apart is the same motion, and +0 makes -0 a 0.
    key = (autoencoder.features(motion, use_contacts).round(6) + 0.0).tobytes()
    if key in seen:
      return seen[key], motion.name
    seen[key] = motion.name
  return None


def _set_feature_statistics(
  network: autoencoder.Autoencoder, batch: autoencoder.Batch
) -> None:
  """Standardises the features over all steps of the set."""
  steps = batch.features[batch.mask.bool()]
  network.feature_mean.copy_(steps.mean(dim=0))
  network.feature_scale.copy_(_scale(steps, _CONSTANT_FEATURE_SCALE))


def _scale(values: torch.Tensor, constant: float) -> torch.Tensor:
  """Returns the deviation of each column, or `constant` for a constant one."""
  centred = values - values.mean(dim=0)
  # Inside the root, for a gradient where a column does not vary.
  deviation = (centred.square().mean(dim=0) + _MIN_SCALE**2).sqrt()
  return torch.where(deviation > 2 * _MIN_SCALE, deviation, constant)


def _evaluate(
  network: autoencoder.Autoencoder,
  batch: autoencoder.Batch,
  config: EncoderConfig,
) -> tuple[torch.Tensor, float, float]:
  """Returns the loss, the worst RMSE in metres and the separation.

  Stores the latents' statistics over the set in the network.
  """
  target = batch.standardised(network)
  raw = network.encode(target, batch.last)
  mean, scale = raw.mean(dim=0), _scale(raw, 1.0)
  network.latent_mean.copy_(mean.detach())
  network.latent_scale.copy_(scale.detach())
  latents = (raw - mean) / scale
  error = network.decode(latents, target.shape[1]) - target
  loss = batch.mean(error.square().sum(dim=-1)).mean()
  metres = (error.detach() * network.feature_scale)[..., autoencoder.POSITION]
  rmse = batch.mean(metres.square().sum(dim=-1)).sqrt().max().item()
  if len(latents) == 1:  # No distances.
    return loss, rmse, 1.0
  distances = torch.pdist(latents)
  relative = distances / distances.mean()
  hinge = torch.relu(HINGE * config.min_separation - relative)
  return loss + hinge.square().sum(), rmse, relative.min().item()


def _converged(report: Progress, config: EncoderConfig) -> bool:
  precise = report.worst_rmse < SAFETY * config.max_rmse
  return precise and report.separation * SAFETY > config.min_separation
