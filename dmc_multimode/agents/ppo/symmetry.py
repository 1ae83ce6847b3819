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

  def __init__(self, latents: np.ndarray, start: int = 2):
    """Knows the modes' `latents`, [M, n_m], at `start` of observations."""
    self._latents = torch.tensor(latents)
    self.part = slice(start, start + latents.shape[1])

  def modes(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns indices of modes for raw observations [N, D], [N]."""
    command = observations[:, self.part]
    return torch.cdist(command, self._latents).argmin(dim=1)


class Mirror:
  """Mirrors batches of raw observations and of actions."""

  def __init__(self, image: MirrorImage, latents: np.ndarray):
    """Mirrors as `image` says, with the modes' `latents`, [M, n_m]."""
    self._order = torch.from_numpy(image.observation_order)
    self._signs = torch.from_numpy(image.observation_signs)
    self._action_order = torch.from_numpy(image.action_order)
    self._action_signs = torch.from_numpy(image.action_signs)
    self._mirrored = torch.tensor(latents)[
      torch.from_numpy(image.mirrored_modes)
    ]
    self._clock_signs = torch.from_numpy(image.clock_signs)
    self._commands = [Commands(latents, start) for start in image.commands]

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
