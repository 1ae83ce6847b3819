"""Puts the parts of PPO together."""

from dm_env import specs
import numpy as np
import torch

from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import config as config_lib
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import symmetry


class PPOBuilder:
  """Makes networks, learner and actors for one configuration and seed."""

  def __init__(self, config: config_lib.PPOConfig, seed: int):
    """All randomness of the agent derives from `seed`."""
    self._config, self._seed = config, seed

  def make_networks(
    self,
    observation_spec: specs.Array,
    action_spec: specs.Array,
    initial_action: np.ndarray | None = None,
    privileged_size: int = 0,
  ) -> networks.ActorCritic:
    """Returns freshly initialised networks for these specs.

    Args:
      observation_spec: one world's observation, with what is privileged, [D].
      action_spec: one world's action, [A].
      initial_action: what the policy does before it learns, [A].
      privileged_size: how many of the last numbers only the value sees.
    """
    with torch.random.fork_rng(devices=[]):
      torch.manual_seed(self._seed)
      return networks.ActorCritic(
        observation_spec.shape[0] - privileged_size,
        action_spec.shape[0],
        self._config.hidden_sizes,
        self._config.initial_std,
        initial_action,
        privileged_size,
        self._config.activation,
      )

  def make_learner(
    self,
    network: networks.ActorCritic,
    mirror: symmetry.Mirror | None = None,
    commands: symmetry.Commands | None = None,
    parallel: bool = False,
  ) -> learning.PPOLearner:
    """Returns a learner that updates `network` in place; see `PPOLearner`."""
    return learning.PPOLearner(
      network, self._config, self._seed + 1, mirror, commands, parallel
    )

  def make_actor(self, network: networks.ActorCritic) -> acting.BatchedActor:
    """Returns an actor that explores with `network`."""
    return acting.BatchedActor(network, self._seed + 2)
