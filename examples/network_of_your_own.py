"""Trains a network of your own by this package's PPO.

    python examples/network_of_your_own.py

The policy maps normalised observations [N, D] to mean actions [N, A], the value
function observations and privileged ones [N, D + P] to [N, 1]. Here both have a
residual block.
"""

import torch
from torch import nn

import dmc_multimode as dmm
from dmc_multimode.agents import ppo


class Residual(nn.Module):
  """Two layers beside a shortcut."""

  def __init__(self, inputs: int, outputs: int, width: int = 128):
    """Makes layers of `width` units."""
    super().__init__()
    self.begin = nn.Linear(inputs, width)
    self.block = nn.Sequential(
      nn.LayerNorm(width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
    )
    self.end = nn.Linear(width, outputs)

  def forward(self, x: torch.Tensor) -> torch.Tensor:
    """Maps [N, inputs] to [N, outputs]."""
    x = self.begin(x)
    return self.end(x + self.block(x))


def main(
  steps: int = 3_000_000, num_worlds: int = 512, out: str = 'network.pt'
) -> None:
  """Trains a walk, and saves the weights."""
  worlds = dmm.make_worlds('walk_forward', num_worlds, privileged=True)
  (seen,), actions = worlds.observation_spec().shape, worlds.action_spec().shape
  network = ppo.fit(
    worlds,
    steps,
    policy=Residual(seen - worlds.privileged_size, actions[0]),
    value=Residual(seen, 1),
  )
  torch.save(network.state_dict(), out)


if __name__ == '__main__':
  main()
