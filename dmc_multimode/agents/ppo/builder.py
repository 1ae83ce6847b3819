"""Puts the parts of PPO together."""

from typing import Mapping

from dm_env import specs
import numpy as np
import torch

from dmc_multimode.agents import distributed
from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import symmetry


class PPOBuilder:
  """Makes networks, learner and actors for one configuration and seed."""

  def __init__(
    self,
    config: ppo_config.PPOConfig,
    seed: int,
    communicator: distributed.Communicator = distributed.LOCAL,
    device: torch.device | str = 'cpu',
    parallel: bool = False,
  ):
    """Makes what one of the communicating ranks has.

    Args:
      config: hyperparameters.
      seed: all randomness of the agent derives from it, and that of minibatches
        and exploration from the rank too.
      communicator: connects the ranks.
      device: on which networks are, and learn.
      parallel: whether actor and learner may use a second thread. Results do
        not depend on it.
    """
    self._config, self._seed = config, seed
    self._communicator, self._device = communicator, device
    self._threads = pair.Pair(parallel)
    self._own_seed = distributed.rank_seed(seed, communicator.rank)

  def make_networks(
    self,
    observation_spec: specs.Array,
    action_spec: specs.Array,
    initial_action: np.ndarray | None = None,
    privileged_size: int = 0,
    weights: Mapping[str, torch.Tensor] | None = None,
  ) -> networks.ActorCritic:
    """Returns networks for these specs, freshly initialised or with `weights`.

    Args:
      observation_spec: one world's observation, with what is privileged, [D].
      action_spec: one world's action, [A].
      initial_action: what the policy does before it learns, [A].
      privileged_size: how many of the last numbers only the value sees.
      weights: of such networks, for all ranks; only those of rank 0 matter.
    """
    with torch.random.fork_rng(devices=[]):
      torch.manual_seed(self._seed)
      network = networks.ActorCritic(
        observation_spec.shape[0] - privileged_size,
        action_spec.shape[0],
        self._config.hidden_sizes,
        self._config.initial_std,
        initial_action,
        privileged_size,
        self._config.activation,
      ).to(self._device)
    if weights is not None:
      network.load_state_dict(weights)
    # Another kind of machine may round another way.
    self._communicator.broadcast(list(network.state_dict().values()))
    return network

  def make_learner(
    self,
    network: networks.ActorCritic,
    mirror: symmetry.Mirror | None = None,
    commands: symmetry.Commands | None = None,
    anchor: kickstarting.Anchor | None = None,
  ) -> learning.PPOLearner:
    """Returns a learner that updates `network` in place; see `PPOLearner`."""
    return learning.PPOLearner(
      network,
      self._config,
      self._own_seed + 1,
      mirror,
      commands,
      self._threads,
      self._communicator,
      anchor,
    )

  def make_actor(self, network: networks.ActorCritic) -> acting.BatchedActor:
    """Returns an actor that explores with `network`."""
    return acting.BatchedActor(
      network, self._own_seed + 2, self._config, self._threads
    )
