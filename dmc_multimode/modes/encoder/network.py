"""Network of the mode encoder, and reference motions as its input."""

from typing import Sequence

import numpy as np
import torch
from torch import nn

from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import reference
from dmc_multimode.utils import constants

POSITION = slice(0, 3)  # Columns of the features.
_NUM_POSE_FEATURES = 7


def num_features(
  use_contacts: bool, num_feet: int = motion_lib.NUM_FEET
) -> int:
  """Returns F, the number of features of one step."""
  return _NUM_POSE_FEATURES + (num_feet if use_contacts else 0)


def features(
  motion: motion_lib.ReferenceMotion,
  use_contacts: bool,
  num_feet: int = motion_lib.NUM_FEET,
) -> np.ndarray:
  """Samples one clip of a motion about every 0.03 s, both ends included.

  Returns:
    [T, F]: trunk position (metres), unit quaternion (w >= 0 at first, then
    continuous) and, with `use_contacts`, the feet's contacts (zero where a mode
    has none).
  """
  steps = max(2, round(motion.duration / constants.CONTROL_TIMESTEP) + 1)
  sampled = reference.sample(motion, np.linspace(0.0, 1.0, steps))
  orientation = sampled.orientation
  flips = np.sum(orientation[1:] * orientation[:-1], axis=-1) < 0
  signs = np.cumprod(np.where(flips, -1.0, 1.0))
  first = -1.0 if orientation[0, 0] < 0 else 1.0
  orientation = orientation * first * np.append(1.0, signs)[:, None]
  columns = [sampled.position, orientation]
  if use_contacts:
    none = np.zeros((steps, num_feet))
    columns.append(none if motion.contacts is None else sampled.contact)
  return np.concatenate(columns, axis=1)


class Autoencoder(nn.Module):
  """Two LSTMs, with statistics of features and latents, in float32."""

  feature_mean: torch.Tensor
  feature_scale: torch.Tensor
  latent_mean: torch.Tensor
  latent_scale: torch.Tensor

  def __init__(
    self, num_features: int, latent_dim: int, hidden: int, seed: int = 0
  ):
    """Draws the weights; does not change torch's global generator."""
    super().__init__()
    with torch.random.fork_rng(devices=[]):
      torch.default_generator.manual_seed(seed)
      self.encoder = nn.LSTM(num_features, hidden, batch_first=True)
      self.to_latent = nn.Linear(hidden, latent_dim)
      self.decoder = nn.LSTM(latent_dim, hidden, batch_first=True)
      self.to_features = nn.Linear(hidden, num_features)
    self.register_buffer('feature_mean', torch.zeros(num_features))
    self.register_buffer('feature_scale', torch.ones(num_features))
    self.register_buffer('latent_mean', torch.zeros(latent_dim))
    self.register_buffer('latent_scale', torch.ones(latent_dim))

  def encode(self, features: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
    """Returns raw latents [N, n_m] of standardised features [N, T, F].

    Args:
      features: padded behind each motion's end; the LSTM is causal, so that
        the padding cannot reach the latent.
      last: index of each motion's last step, [N].
    """
    states, _ = self.encoder(features)
    return self.to_latent(states[torch.arange(len(last)), last])

  def decode(self, latents: torch.Tensor, steps: int) -> torch.Tensor:
    """Returns standardised features [N, steps, F] of latents [N, n_m]."""
    states, _ = self.decoder(latents[:, None].expand(-1, steps, -1))
    return self.to_features(states)


class Batch:
  """Padded features of several motions.

  Attributes:
    features: in physical units, zero behind a motion's end, [N, T, F].
    mask: 1 for the steps of a motion, 0 behind its end, [N, T].
    last: index of each motion's last step, [N].
  """

  def __init__(
    self,
    motions: Sequence[motion_lib.ReferenceMotion],
    use_contacts: bool,
    num_feet: int = motion_lib.NUM_FEET,
  ):
    if not motions:
      raise ValueError('The encoder needs at least one motion.')
    rows = [
      torch.tensor(
        features(motion, use_contacts, num_feet), dtype=torch.float32
      )
      for motion in motions
    ]
    self.features = nn.utils.rnn.pad_sequence(rows, batch_first=True)
    self.last = torch.tensor([len(row) - 1 for row in rows])
    steps = torch.arange(self.features.shape[1])
    self.mask = (steps <= self.last[:, None]).float()

  def standardised(self, network: Autoencoder) -> torch.Tensor:
    """Returns the features in the network's units, [N, T, F]."""
    return (self.features - network.feature_mean) / network.feature_scale

  def mean(self, values: torch.Tensor) -> torch.Tensor:
    """Returns each motion's mean over its own steps, [N, T] to [N]."""
    return (values * self.mask).sum(dim=1) / self.mask.sum(dim=1)
