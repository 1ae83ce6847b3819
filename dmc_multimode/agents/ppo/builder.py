"""Factory of the parts of PPO."""

from typing import Mapping

import torch
from torch import nn

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks


class PPOBuilder:
  """Makes networks, learner and actor for one environment and seed."""

  def __init__(
    self,
    config: ppo_config.PPOConfig,
    environment: core.EnvironmentDescription,
    seed: int,
    communicator: distributed.Communicator = distributed.LOCAL,
    device: torch.device | str = 'cpu',
    parallel: bool = False,
  ):
    """Prepares the parts of one rank.

    Args:
      config: hyperparameters.
      environment: description of the environment.
      seed: of all randomness of the agent; minibatches and exploration also
        depend on the rank.
      communicator: connects the ranks.
      device: of networks and updates.
      parallel: allows actor and learner a second thread; results are the same.
    """
    self._config, self._seed = config, seed
    self._environment = environment
    self._communicator, self._device = communicator, device
    self._threads = pair.Pair(parallel)
    self._own_seed = distributed.rank_seed(seed, communicator.rank)

  def make_networks(
    self,
    weights: Mapping[str, torch.Tensor] | None = None,
    policy: nn.Module | None = None,
    value: nn.Module | None = None,
  ) -> networks.ActorCritic:
    """Returns networks, freshly initialised or with `weights`.

    Args:
      weights: state dictionary to start from; ignored at ranks other than 0.
      policy, value: see `networks.ActorCritic`.
    """
    about = self._environment
    with torch.random.fork_rng(devices=[]):
      torch.manual_seed(self._seed)
      network = networks.ActorCritic(
        about.observation_spec.shape[0] - about.privileged_size,
        about.action_spec.shape[0],
        self._config.hidden_sizes,
        self._config.initial_std,
        about.standing_action,
        about.privileged_size,
        self._config.activation,
        policy,
        value,
      ).to(self._device)
    if weights is not None:
      network.load_state_dict(weights)
    # Machines of another kind may round differently.
    self._communicator.broadcast(list(network.state_dict().values()))
    return network

  def make_learner(
    self,
    network: networks.ActorCritic,
    reference: kickstarting.ReferencePolicy | None = None,
  ) -> learning.PPOLearner:
    """Returns a learner that updates `network` in place; see `PPOLearner`."""
    return learning.PPOLearner(
      network,
      self._config,
      self._own_seed + 1,
      self._environment.symmetry,
      self._environment.mode_of,
      self._threads,
      self._communicator,
      reference,
    )

  def make_actor(self, network: networks.ActorCritic) -> acting.BatchedActor:
    """Returns an actor that explores with `network`."""
    return acting.BatchedActor(
      network, self._own_seed + 2, self._config, self._threads
    )
