"""Trains a network in worlds of one's own: PPO in one call."""

from typing import Protocol

import numpy as np
from torch import nn

from dmc_multimode.agents import core
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import builder as builder_lib
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks


class Worlds(core.TrainingEnvironment, Protocol):
  """Worlds that say what an agent has to know; `BatchedImitation` is one.

  Attributes:
    privileged_size: number of entries at the end of the observation that only
      the value function sees.
  """

  privileged_size: int

  @property
  def mode_names(self) -> tuple[str, ...]:
    """Names of the modes, for the logs."""

  def standing_action(self) -> np.ndarray:
    """Returns the mean action of an untrained policy, [A]."""


def fit(
  worlds: Worlds,
  steps: int,
  config: ppo_config.PPOConfig | None = None,
  seed: int = 0,
  policy: nn.Module | None = None,
  value: nn.Module | None = None,
  quiet: bool = False,
) -> networks.ActorCritic:
  """Trains in worlds as they are; nothing is saved.

  Args:
    worlds: with `auto_reset`.
    steps: environment steps, summed over all worlds.
    config: hyperparameters; without symmetry.
    seed: of the agent.
    policy, value: modules of one's own; see `ActorCritic`.
    quiet: hides the progress bar.

  Returns:
    The network.

  Raises:
    FloatingPointError: a rollout or an update is not finite.
    ValueError: `policy` or `value` is no such module, or the configuration
      needs what the worlds do not tell.
  """
  config = config or ppo_config.PPOConfig()
  about = core.EnvironmentDescription(
    worlds.observation_spec(),
    worlds.action_spec(),
    worlds.privileged_size,
    worlds.standing_action(),
  )
  builder = builder_lib.PPOBuilder(config, about, seed)
  network = builder.make_networks(policy=policy, value=value)
  loop = runner.TrainingLoop(
    worlds,
    builder.make_actor(network),
    builder.make_learner(network),
    config.rollout_length,
    worlds.mode_names,
    dict,
  )
  bars = [] if quiet else [loggers.ProgressLogger(steps)]
  logger = loggers.Dispatcher(bars)
  try:
    loop.run(runner.TrainingConfig(steps=steps), logger, save=lambda: None)
  finally:
    logger.close()
  return network
