"""Mirror images and modes of observations, as torch functions for agents."""

import numpy as np
import torch

from dmc_multimode.suite.imitation import observations as task_observations
from dmc_multimode.suite.imitation import symmetry as task_symmetry


class ModeOf:
  """Maps observations to mode indices, by the nearest latent.

  Attributes:
    part: place of the latent in an observation.
  """

  def __init__(
    self,
    latents: np.ndarray,
    start: int | None = None,
    device: torch.device | str = 'cpu',
  ):
    """Compares with `latents`, [M, n_m].

    Args:
      latents: of all modes, [M, n_m].
      start: of the latent in observations; by default that of the running mode.
      device: of observations.
    """
    self._latents = torch.tensor(latents, device=device)
    latent_dim = latents.shape[1]
    if start is None:
      start = task_observations.part('command', latent_dim).start
    self.part = slice(start, start + latent_dim)

  def __call__(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns mode indices for raw observations [N, D], [N]."""
    command = observations[:, self.part]
    return torch.cdist(command, self._latents).argmin(dim=1)


class Mirror:
  """Mirrors batches of raw observations and of actions: `core.Symmetry`."""

  def __init__(
    self,
    image: task_symmetry.MirrorImage,
    latents: np.ndarray,
    device: torch.device | str = 'cpu',
  ):
    """Moves `image` and the modes' `latents`, [M, n_m], to `device`."""
    on_device = lambda values: torch.from_numpy(values).to(device)
    self._order = on_device(image.observation_order)
    self._signs = on_device(image.observation_signs)
    self._action_order = on_device(image.action_order)
    self._action_signs = on_device(image.action_signs)
    self._mirrored = torch.tensor(latents, device=device)[
      on_device(image.mirrored_modes)
    ]
    self._clock = task_observations.part('clock', latents.shape[1])
    self._clock_signs = on_device(image.clock_signs)
    self._commands = [
      ModeOf(latents, start, device) for start in image.commands
    ]

  def __call__(
    self, observations: torch.Tensor, actions: torch.Tensor
  ) -> tuple[torch.Tensor, torch.Tensor]:
    """Mirrors observations [N, D] and actions [N, ..., A]."""
    return self.observations(observations), self.actions(actions)

  def observations(self, observations: torch.Tensor) -> torch.Tensor:
    """Mirrors raw observations, [N, D]."""
    mirrored = observations[:, self._order] * self._signs
    modes = [mode_of(observations) for mode_of in self._commands]
    for mode_of, mode in zip(self._commands, modes, strict=True):
      mirrored[:, mode_of.part] = self._mirrored[mode]
    signs = self._clock_signs[modes[0], None]
    mirrored[:, self._clock] = observations[:, self._clock] * signs
    return mirrored

  def actions(self, actions: torch.Tensor) -> torch.Tensor:
    """Mirrors actions, [..., A]."""
    return actions[..., self._action_order] * self._action_signs
