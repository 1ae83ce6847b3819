"""Training of the mode encoder, an LSTM autoencoder of reference motions.

After Krishna and Nguyen, Sec. II-B: the encoder reads a motion step by step and
returns one latent z; z, repeated for each step, is the input of the decoder,
which reconstructs the motion. Encoder and decoder are one LSTM layer of 32 each
with a linear read-out, without further activations. Each step has the trunk's
position and orientation and, optionally, the contacts of the feet.

Three things differ from the paper, which trains on the reconstruction loss
alone and names no end:
- Training ends when every mode is reconstructed to 2 cm and no two latents are
  close to each other. Reconstruction alone let modes share a corner of the
  latent space (pi1, one seed: after 2,500 epochs the smallest distance was 0.18
  of the mean), and a policy cannot tell such modes apart.
- A hinge on the distances between latents is added to the loss. It is zero as
  soon as they are apart, and so leaves their arrangement to the data.
- The decoder already gets the latents that the policy gets: standardised over
  the set, so that the distances trained are those between the latents in use.
"""

import dataclasses
from typing import Callable, Sequence

import torch
from torch import nn

from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import network as autoencoder

_MIN_SCALE = 1e-6  # A feature with less than twice this counts as constant.
# A latent likewise: standardised, its deviation would be the rounding's.
_MIN_LATENT_SCALE = 1e-3
_CONSTANT_FEATURE_SCALE = 0.1  # Metres: scale of a constant feature.
SAFETY = 0.98  # Margin of tolerances, for rounding on other machines.
HINGE = 1.6  # Modes repel up to this multiple of the minimum separation.
MAX_GRADIENT_NORM = 1.0
# Of the mean distance: that of latents with unit variance is larger.
_LEAST_MEAN = 1.0


class ConvergenceError(ValueError):
  """Training ended without meeting its tolerances."""


@dataclasses.dataclass(frozen=True)
class Progress:
  """Progress of a training.

  Attributes:
    epoch: number of passes over the set so far.
    worst_rmse: largest RMSE of the trunk position over the modes, metres.
    separation: smallest over mean distance between two modes' latents; see
      `relative`.
  """

  epoch: int
  worst_rmse: float
  separation: float


def needs_contacts(motions: Sequence[motion_lib.ReferenceMotion]) -> bool:
  """Returns True if some modes differ in contacts only."""
  return _twins(motions, (False, motion_lib.NUM_FEET)) is not None


def train(
  motions: Sequence[motion_lib.ReferenceMotion],
  config: mode_encoder.EncoderConfig,
  progress: Callable[[Progress], None] | None = None,
) -> mode_encoder.ModeEncoder:
  """Trains until every tolerance of `config` is met.

  All modes make one batch. The result depends on the motions and `config`
  alone; torch's global generator and thread settings are left as they are.

  Args:
    motions: the mode set.
    config: sizes, tolerances and seed.
    progress: called after every pass, before its gradient step.

  Raises:
    ValueError: two modes have the same features, or a motion cannot be written
      to a file.
    ConvergenceError: `max_epochs` passed without meeting the tolerances.
  """
  check_set(motions, config)
  batch = autoencoder.Batch(motions, *config.contacts)
  network = mode_encoder.make_network(config)
  _set_feature_statistics(network, batch)
  optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
  for epoch in range(1, config.max_epochs + 1):
    loss, rmse, separation = _evaluate(network, batch, config)
    report = Progress(epoch, rmse, separation)
    if progress is not None:
      progress(report)
    if _converged(report, config):
      return mode_encoder.ModeEncoder(
        config, tuple(motions), network.requires_grad_(False)
      )
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


def train_for(
  motions: Sequence[motion_lib.ReferenceMotion],
  seed: int = 0,
  progress: Callable[[Progress], None] | None = None,
) -> mode_encoder.ModeEncoder:
  """Trains with the settings that fit the motions; see `train`.

  Contacts are encoded where modes differ in nothing else.

  Args:
    motions: the mode set.
    seed: of the initial weights.
    progress: called after every pass, before its gradient step.

  Raises:
    ValueError, ConvergenceError: as `train`.
  """
  config = mode_encoder.EncoderConfig(
    use_contacts=needs_contacts(motions),
    seed=seed,
    num_feet=motion_lib.num_feet(motions),
  )
  return train(motions, config, progress)


def check_set(
  motions: Sequence[motion_lib.ReferenceMotion],
  config: mode_encoder.EncoderConfig,
) -> None:
  """Raises ValueError for a set that cannot be encoded or saved."""
  motion_lib.check_names(motions)  # At least one mode, and unique names.
  for motion in motions:
    try:
      mode_files.motion_from_dict(mode_files.motion_to_dict(motion))
    except ValueError as error:
      raise ValueError(f'{motion.name}: {error}') from None
  twins = _twins(motions, config.contacts)
  if twins:
    hint = '' if config.use_contacts else ' without use_contacts'
    raise ValueError(
      f'Modes {twins[0]!r} and {twins[1]!r} have the same base motion and '
      f'cannot be told apart{hint}.'
    )


def _twins(
  motions: Sequence[motion_lib.ReferenceMotion], contacts: tuple[bool, int]
) -> tuple[str, str] | None:
  """Returns the names of two modes with equal features, if there are any."""
  seen: dict[bytes, str] = {}
  for motion in motions:
    # Rounded to microns; adding 0 turns -0 into 0.
    key = (autoencoder.features(motion, *contacts).round(6) + 0.0).tobytes()
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


def _scale(
  values: torch.Tensor, constant: float, least: float = 2 * _MIN_SCALE
) -> torch.Tensor:
  """Returns each column's deviation, or `constant` if it is at most `least`."""
  centred = values - values.mean(dim=0)
  # Inside the root, for a finite gradient of constant columns.
  deviation = (centred.square().mean(dim=0) + _MIN_SCALE**2).sqrt()
  return torch.where(deviation > least, deviation, constant)


def _evaluate(
  network: autoencoder.Autoencoder,
  batch: autoencoder.Batch,
  config: mode_encoder.EncoderConfig,
) -> tuple[torch.Tensor, float, float]:
  """Returns the loss, the worst RMSE in metres and the separation.

  Stores the latents' statistics over the set in the network.
  """
  target = batch.standardised(network)
  raw = network.encode(target, batch.last)
  mean, scale = raw.mean(dim=0), _scale(raw, 1.0, _MIN_LATENT_SCALE)
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
  apart = relative(distances)
  hinge = torch.relu(HINGE * config.min_separation - apart)
  return loss + hinge.square().sum(), rmse, apart.min().item()


def relative(distances: torch.Tensor) -> torch.Tensor:
  """Returns the distances between latents over their mean, or 1 if it is less.

  Two latents that are as good as equal would else be apart by their mean
  distance.

  Args:
    distances: of all pairs of modes.
  """
  return distances / distances.mean().clamp(min=_LEAST_MEAN)


def _converged(report: Progress, config: mode_encoder.EncoderConfig) -> bool:
  precise = report.worst_rmse < SAFETY * config.max_rmse
  return precise and report.separation * SAFETY > config.min_separation
