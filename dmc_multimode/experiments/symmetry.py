"""Mirror images and modes of the imitation task, as an agent is told them."""

import numpy as np
import torch

from dmc_multimode.suite.imitation import symmetry as task_symmetry

_COMMAND = 2  # Where the running mode's latent begins, after the clock.


class ModeOf:
  """Tells which mode an observation commands, by its latent.

  Attributes:
    part: where the latent is in an observation.
  """

  def __init__(
    self,
    latents: np.ndarray,
    start: int = _COMMAND,
    device: torch.device | str = 'cpu',
  ):
    """Knows the modes' `latents`, [M, n_m], at `start` of observations."""
    self._latents = torch.tensor(latents, device=device)
    self.part = slice(start, start + latents.shape[1])

  def __call__(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns indices of modes for raw observations [N, D], [N]."""
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
    """Mirrors as `image` says, with the modes' `latents`, [M, n_m]."""
    on_device = lambda values: torch.from_numpy(values).to(device)
    self._order = on_device(image.observation_order)
    self._signs = on_device(image.observation_signs)
    self._action_order = on_device(image.action_order)
    self._action_signs = on_device(image.action_signs)
    self._mirrored = torch.tensor(latents, device=device)[
      on_device(image.mirrored_modes)
    ]
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
    mirrored[:, :2] = observations[:, :2] * self._clock_signs[modes[0], None]
    return mirrored

  def actions(self, actions: torch.Tensor) -> torch.Tensor:
    """Mirrors actions, [..., A]."""
    return actions[..., self._action_order] * self._action_signs
