"""Keeps a policy near an earlier one in the modes that this one knows.

What is learned for a new mode moves a network's output for the others as well,
and what these lack in practice they lose. The divergence from the policy that a
training began with (as in Schmitt et al. 2018, Kickstarting Deep Reinforcement
Learning) holds them without a word about the new mode.
"""

import copy
from typing import Sequence

import torch

from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import symmetry


class Anchor:
  """A policy as it is now, and the modes in which another is to stay near."""

  def __init__(
    self,
    network: networks.ActorCritic,
    commands: symmetry.Commands,
    kept: Sequence[bool],
  ):
    """Copies a policy.

    Args:
      network: the policy; what it becomes does not matter.
      commands: tells modes by observations.
      kept: whether the policy knows each mode, [M].
    """
    self._network = copy.deepcopy(network).requires_grad_(False)
    self._commands = commands
    self._kept = torch.tensor(kept, device=network.log_std.device)

  @torch.no_grad()
  def means(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns its actions for raw observations [N, D], [N, A].

    They are NaN where the mode is none that it knows.
    """
    means = self._network.act(observations)
    known = self._kept[self._commands.modes(observations)]
    return torch.where(known[:, None], means, torch.nan)


def divergence(
  mean: torch.Tensor, std: torch.Tensor, anchors: torch.Tensor
) -> torch.Tensor:
  """Mean KL divergence of Gaussians from those around other means, nats.

  Args:
    mean: [N, A].
    std: of all of them, [A].
    anchors: the other means, NaN where any mean will do, [N, A].
  """
  # A NaN must not come near a gradient, not even with a factor of 0.
  anchors = torch.where(anchors.isnan(), mean.detach(), anchors)
  distances = 0.5 * ((mean - anchors) / std.detach()).square().sum(dim=-1)
  return distances.mean()
