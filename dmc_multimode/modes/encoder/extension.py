"""New modes for a mode encoder whose latents are in use.

A policy depends on the latents of its modes, so these must not change. An
encoder may map a new motion anywhere, also onto a known mode: that of pi2 maps
a squat to 1 % of the mean distance from idle. So the encoder is trained on,
with the latents of old modes held, until new modes are separated as well as old
ones.
"""

import copy
import dataclasses
from typing import Sequence

import numpy as np
import torch
from torch import nn

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import network as autoencoder
from dmc_multimode.modes.encoder import training as encoder_training

# Largest error of an encoder in an entry of an old mode's latent; latents have
# unit variance.
_TOLERANCE = 0.01
_ANCHOR_WEIGHT = 10.0  # Weight of the distance of old modes from their latents.


def extend(
  base: mode_encoder.ModeEncoder,
  old: mode_set_lib.ModeSet,
  new: Sequence[motion_lib.ReferenceMotion],
) -> tuple[mode_encoder.ModeEncoder, mode_set_lib.ModeSet]:
  """Returns an encoder of old and new modes, and the mode set of all.

  The latents of the old modes stay the same to the bit. Tolerances are those of
  `base`; the result depends on the arguments alone.

  Args:
    base: encoder of the old modes; it is not changed.
    old: modes whose latents are in use.
    new: modes to encode; without any, nothing is trained.

  Raises:
    ValueError: the old latents are not those of `base`, or two modes have the
      same features.
    ConvergenceError: the tolerances are not met within the epochs of `base`.
  """
  _check_base(base, old)
  motions = (*old.motions, *new)
  try:
    encoder_training.check_set(motions, base.config)
  except ValueError as error:
    raise ValueError(
      f'{error} The encoder is that of the old modes: change the new ones, or '
      'train a policy of all modes from scratch.'
    ) from None
  network = base.network
  if new:
    network = _Extension(base, motions, old.latents).train()
  trained = mode_encoder.ModeEncoder(base.config, motions, network)
  if not new:
    return trained, old
  latents = np.concatenate([old.latents, trained.encode(new)])
  names = tuple(motion.name for motion in motions)
  codebook = codebook_lib.Codebook(names, latents)
  return trained, mode_set_lib.ModeSet(motions, codebook)


def _check_base(
  base: mode_encoder.ModeEncoder, old: mode_set_lib.ModeSet
) -> None:
  """Raises ValueError unless `base` gives the old modes their latents."""
  found = base.encode(old.motions)
  if found.shape != old.latents.shape or not np.allclose(
    found, old.latents, rtol=0.0, atol=2 * _TOLERANCE
  ):
    raise ValueError(
      'The encoder is not the one that the latents of the old modes are from: '
      'name the folder of that one.'
    )


@dataclasses.dataclass
class _Standing:
  """Loss of a pass, and the measures that have tolerances."""

  loss: torch.Tensor
  rmse: float
  separation: float
  shift: float

  def suffices(self, config: mode_encoder.EncoderConfig) -> bool:
    """Returns True if the tolerances are met, with a margin for rounding."""
    return (
      self.rmse < encoder_training.SAFETY * config.max_rmse
      and self.separation * encoder_training.SAFETY > config.min_separation
      and self.shift < encoder_training.SAFETY * _TOLERANCE
    )


class _Extension:
  """Continues the training of a copy of an autoencoder, some latents held."""

  def __init__(
    self,
    base: mode_encoder.ModeEncoder,
    motions: Sequence[motion_lib.ReferenceMotion],
    held: np.ndarray,
  ):
    """Holds the latents of the first motions, [N, n_m]."""
    self._config = base.config
    self._network = copy.deepcopy(base.network).requires_grad_(True)
    self._batch = autoencoder.Batch(motions, *base.config.contacts)
    self._held = torch.tensor(held)
    # Every pair of modes of which one is new.
    first, second = torch.triu_indices(len(motions), len(motions), 1)
    self._pairs = first, second
    self._new_pairs = second >= len(self._held)

  def train(self) -> autoencoder.Autoencoder:
    """Returns the trained network; raises ConvergenceError without one."""
    config = self._config
    parameters = list(self._network.parameters())
    optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)
    for _ in range(config.max_epochs):
      standing = self._evaluate()
      if standing.suffices(config):
        return self._network.requires_grad_(False)
      optimizer.zero_grad()
      standing.loss.backward()
      nn.utils.clip_grad_norm_(parameters, encoder_training.MAX_GRADIENT_NORM)
      optimizer.step()
    raise encoder_training.ConvergenceError(
      f'The encoder did not learn the new modes in {config.max_epochs} epochs: '
      f'worst RMSE {standing.rmse:.3f} m (wanted below {config.max_rmse:g}), '
      f'separation {standing.separation:.2f} (wanted above '
      f'{config.min_separation:g}), old latents off by {standing.shift:.3f} '
      f'(wanted below {_TOLERANCE:g}). Make the new modes differ more from the '
      'old ones, or train a policy of all modes from scratch.'
    )

  def _evaluate(self) -> _Standing:
    network, batch, count = self._network, self._batch, len(self._held)
    target = batch.standardised(network)
    raw = network.encode(target, batch.last)
    encoded = (raw - network.latent_mean) / network.latent_scale
    shift = encoded[:count] - self._held
    # The decoder gets the latents that the policy gets.
    latents = torch.cat([self._held, encoded[count:]])
    error = network.decode(latents, target.shape[1]) - target
    metres = (error.detach() * network.feature_scale)[..., autoencoder.POSITION]
    first, second = self._pairs
    distances = (latents[first] - latents[second]).norm(dim=1)
    relative = encoder_training.relative(distances)[self._new_pairs]
    least = encoder_training.HINGE * self._config.min_separation
    loss = (
      batch.mean(error.square().sum(dim=-1)).mean()
      + torch.relu(least - relative).square().sum()
      + _ANCHOR_WEIGHT * shift.square().mean()
    )
    return _Standing(
      loss,
      batch.mean(metres.square().sum(dim=-1)).sqrt().max().item(),
      relative.min().item(),
      shift.abs().max().item(),
    )
