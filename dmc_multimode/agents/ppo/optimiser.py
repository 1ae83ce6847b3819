"""Adam for parameters that several ranks train together."""

import math
from typing import Mapping

import torch
from torch import nn

from dmc_multimode.agents import distributed
from dmc_multimode.agents.ppo import config as ppo_config


class Optimiser:
  """Adam with clipped gradients averaged over ranks."""

  def __init__(
    self,
    parameters: list[nn.Parameter],
    config: ppo_config.PPOConfig,
    communicator: distributed.Communicator = distributed.LOCAL,
  ):
    """Prepares the optimiser of `parameters`.

    Args:
      parameters: to be optimised, on one device.
      config: hyperparameters.
      communicator: used by the thread that calls `step` only.
    """
    self._parameters = parameters
    self._max_norm = config.max_gradient_norm
    self._communicator = communicator
    self._adam = torch.optim.Adam(
      parameters, lr=config.learning_rate, eps=1e-5, fused=True
    )

  def step(self, loss: torch.Tensor) -> torch.Tensor:
    """Takes one step along the gradient of the mean loss of all ranks.

    Returns:
      Norm of the gradient before clipping.

    Raises:
      FloatingPointError: the gradient is not finite; raised at all ranks.
    """
    self._adam.zero_grad(set_to_none=True)
    loss.backward()
    self._communicator.average(
      [p.grad for p in self._parameters if p.grad is not None]
    )
    norm = nn.utils.clip_grad_norm_(self._parameters, self._max_norm)
    if not math.isfinite(norm):
      raise FloatingPointError(
        'A gradient is not finite; the last checkpoint is unharmed: resume '
        'from it, with a lower learning rate if it recurs.'
      )
    self._adam.step()
    return norm

  def set_learning_rate(self, value: float) -> None:
    """Sets the learning rate."""
    for group in self._adam.param_groups:
      group['lr'] = value

  def state(self) -> dict[str, torch.Tensor]:
    """Returns the moments as `NUMBER/NAME`; empty before the first step."""
    return {
      f'{i}/{key}': value
      for i, parameter in enumerate(self._parameters)
      for key, value in self._adam.state.get(parameter, {}).items()
    }

  def restore(self, state: Mapping[str, torch.Tensor]) -> None:
    """Restores a `state`; raises ValueError for one of other parameters."""
    self._adam.state.clear()
    for name, value in state.items():
      number, _, key = name.partition('/')
      parameter = self._parameters[int(number)]
      if value.ndim and value.shape != parameter.shape:
        raise ValueError(
          f'The checkpoint has a {key} of shape {list(value.shape)} for '
          f'parameters of shape {list(parameter.shape)}.'
        )
      moments = self._adam.state[parameter]
      moments[key] = value.to(parameter.device, copy=True)
