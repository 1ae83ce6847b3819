"""Random data for the learner of PPO."""

import torch

from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import rollouts as rollouts_lib

T, B, D, A = 4, 8, 3, 2  # Steps, worlds, observations, actions.
CONFIG = ppo_config.PPOConfig(hidden_sizes=(16,), rollout_length=T)


def network(
  config: ppo_config.PPOConfig = CONFIG, privileged_size: int = 0
) -> networks.ActorCritic:
  """Of observations of D numbers, of which the last may be privileged."""
  torch.manual_seed(0)
  return networks.ActorCritic(
    D - privileged_size,
    A,
    config.hidden_sizes,
    config.initial_std,
    privileged_size=privileged_size,
    activation=config.activation,
  )


def rollouts(
  network: networks.ActorCritic, seed: int = 0
) -> rollouts_lib.Rollouts:
  """Random observations and rewards, and the network's own actions."""
  generator = torch.Generator().manual_seed(seed)
  draw = lambda *shape: torch.randn(T, B, *shape, generator=generator)
  observations, noise = draw(D), draw(A)
  with torch.no_grad():
    means = network.act(observations)
    actions = means + network.std * noise
    log_probs = networks.log_prob(actions, means, network.std)
  last = torch.rand(T, B, generator=generator) < 0.3
  return rollouts_lib.Rollouts(
    observations=observations,
    actions=actions,
    log_probs=log_probs,
    means=means,
    rewards=draw(),
    discounts=1.0 - (last & (draw() > 0)).float(),
    last=last,
    next_observations=draw(D),
  )
