"""Left-right mirror images of observations and actions."""

from typing import Protocol

import numpy as np
import torch


class MirrorImage(Protocol):
  """What an environment says about its symmetry: x'[i] = signs[i] x[order[i]].

  The observation begins with a clock (2) and the latent of a mode (n_m), which
  are mirrored by the mode: `mirrored_modes` [M] gives each mode's image,
  `clock_signs` [M] is -1 where that image runs half a cycle out of phase. All
  latents in the observation, which start at `commands`, are mirrored so.
  """

  @property
  def observation_order(self) -> np.ndarray:
    """Of flat observations, [D]."""

  @property
  def observation_signs(self) -> np.ndarray:
    """Of flat observations, [D]."""

  @property
  def action_order(self) -> np.ndarray:
    """Of actions, [A]."""

  @property
  def action_signs(self) -> np.ndarray:
    """Of actions, [A]."""

  @property
  def mirrored_modes(self) -> np.ndarray:
    """Index of each mode's image, [M]."""

  @property
  def clock_signs(self) -> np.ndarray:
    """Signs of the clock by mode, [M]."""

  @property
  def commands(self) -> tuple[int, ...]:
    """Where latents of modes begin; the first is that of the running mode."""


class Commands:
  """Tells which mode an observation commands, by its latent."""

  def __init__(
    self,
    latents: np.ndarray,
    start: int = 2,
    device: torch.device | str = 'cpu',
  ):
    """Knows the modes' `latents`, [M, n_m], at `start` of observations."""
    self._latents = torch.tensor(latents, device=device)
    self.part = slice(start, start + latents.shape[1])

  def modes(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns indices of modes for raw observations [N, D], [N]."""
    command = observations[:, self.part]
    return torch.cdist(command, self._latents).argmin(dim=1)


class Mirror:
  """Mirrors batches of raw observations and of actions."""

  def __init__(
    self,
    image: MirrorImage,
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
      Commands(latents, start, device) for start in image.commands
    ]

  def observations(self, observations: torch.Tensor) -> torch.Tensor:
    """Mirrors raw observations, [N, D]."""
    mirrored = observations[:, self._order] * self._signs
    modes = [commands.modes(observations) for commands in self._commands]
    for commands, mode in zip(self._commands, modes, strict=True):
      mirrored[:, commands.part] = self._mirrored[mode]
    mirrored[:, :2] = observations[:, :2] * self._clock_signs[modes[0], None]
    return mirrored

  def actions(self, actions: torch.Tensor) -> torch.Tensor:
    """Mirrors actions, [N, A]."""
    return actions[:, self._action_order] * self._action_signs
