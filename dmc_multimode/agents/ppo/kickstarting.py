"""Kickstarting: keeps a policy near an earlier one in the modes known there.

Learning a new mode also changes a network's actions in the other modes, which
are then forgotten unless they are practised. A penalty on the divergence from
the policy that a training began with (as in Schmitt et al. 2018, Kickstarting
Deep Reinforcement Learning) keeps the known modes, and leaves the new one free.
"""

import copy
from typing import Sequence

import torch

from dmc_multimode.agents import core
from dmc_multimode.agents.ppo import networks


class ReferencePolicy:
  """Frozen copy of a policy: the reference of the divergence."""

  def __init__(
    self,
    network: networks.ActorCritic,
    mode_of: core.ModeOf,
    known: Sequence[bool],
  ):
    """Copies a policy.

    Args:
      network: the policy; later changes of it have no effect.
      mode_of: maps raw observations to mode indices.
      known: whether the policy knows each mode, [M].
    """
    self._network = copy.deepcopy(network).requires_grad_(False)
    self._mode_of = mode_of
    self._known = torch.tensor(known, device=network.log_std.device)

  @torch.no_grad()
  def means(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns mean actions for raw observations [N, D], [N, A].

    The means are NaN in modes that the policy does not know.
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
    std: standard deviation of both, [A].
    reference: reference means, NaN for rows that do not count, [N, A].
  """
  # NaNs must not reach the gradient: 0 * NaN is NaN.
  reference = torch.where(reference.isnan(), mean.detach(), reference)
  distances = 0.5 * ((mean - reference) / std.detach()).square().sum(dim=-1)
  return distances.mean()
