"""Keeps a policy near an earlier one in the modes that this one knows.

What is learned for a new mode moves a network's output for the others as well,
and what these lack in practice they lose. The divergence from the policy that a
training began with (as in Schmitt et al. 2018, Kickstarting Deep Reinforcement
Learning) holds them without a word about the new mode.
"""

import copy
from typing import Sequence

import torch

from dmc_multimode.agents import core
from dmc_multimode.agents.ppo import networks


class ReferencePolicy:
  """A policy as it is now, near which another is to stay in some modes."""

  def __init__(
    self,
    network: networks.ActorCritic,
    mode_of: core.ModeOf,
    known: Sequence[bool],
  ):
    """Copies a policy.

    Args:
      network: the policy; what it becomes does not matter.
      mode_of: tells modes by raw observations.
      known: whether the policy knows each mode, [M].
    """
    self._network = copy.deepcopy(network).requires_grad_(False)
    self._mode_of = mode_of
    self._known = torch.tensor(known, device=network.log_std.device)

  @torch.no_grad()
  def means(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns its actions for raw observations [N, D], [N, A].

    They are NaN where the mode is none that it knows.
    """
    means = self._network.act(observations)
    known = self._known[self._mode_of(observations)]
    return torch.where(known[:, None], means, torch.nan)


def divergence(
  mean: torch.Tensor, std: torch.Tensor, reference: torch.Tensor
) -> torch.Tensor:
  """Mean KL divergence of Gaussians from those around reference means, nats.

  KL = |mean - reference|^2 / (2 std^2), summed over actions, of Gaussians of
  one deviation.

  Args:
    mean: [N, A].
    std: of all of them, [A].
    reference: the reference means, NaN where any mean will do, [N, A].
  """
  # A NaN must not come near a gradient, not even with a factor of 0.
  reference = torch.where(reference.isnan(), mean.detach(), reference)
  distances = 0.5 * ((mean - reference) / std.detach()).square().sum(dim=-1)
  return distances.mean()
