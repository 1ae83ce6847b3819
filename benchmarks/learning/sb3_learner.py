"""Learns by Stable-Baselines3's PPO; needs the extra `bench`."""

# Optional: not always there to be checked against.
# mypy: disable-error-code="import-not-found"

import math
from typing import Any

import numpy as np

from benchmarks.learning import learners
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.experiments import setup

try:
  import stable_baselines3
  from stable_baselines3.common import buffers
  from stable_baselines3.common import logger
  from stable_baselines3.common import vec_env

  from dmc_multimode.suite.wrappers import stable_baselines3_env
except ModuleNotFoundError as error:
  raise learners.missing(error) from None


def settings(ppo: ppo_config.PPOConfig, num_worlds: int) -> dict[str, Any]:
  """Returns the arguments of the library's PPO.

  Its `target_kl` is left at None: it would end an update early.

  Args:
    ppo: our hyperparameters.
    num_worlds: B.
  """
  samples = num_worlds * ppo.rollout_length
  return {
    'learning_rate': ppo.learning_rate,
    'n_steps': ppo.rollout_length,
    'batch_size': math.ceil(samples / ppo.minibatches),
    'n_epochs': ppo.epochs,
    'gamma': ppo.discount,
    'gae_lambda': ppo.gae_lambda,
    'clip_range': ppo.clip,
    'ent_coef': ppo.entropy_coefficient,
    'vf_coef': learners.VALUE_COEFFICIENT,
    'max_grad_norm': ppo.max_gradient_norm,
    'policy_kwargs': {
      'net_arch': list(ppo.hidden_sizes),
      'activation_fn': networks.ACTIVATIONS[ppo.activation],
      'log_std_init': math.log(ppo.initial_std),
    },
  }


class Learner(learners.Learner):
  """See `learners.Learner`."""

  update: learners.Methods = (
    (buffers.RolloutBuffer, 'compute_returns_and_advantage'),
    (stable_baselines3.PPO, 'train'),
  )

  def __init__(self, run: setup.Run, reward_scale: float):
    """Learns in the worlds of `run`, from its weights on."""
    super().__init__(run, reward_scale)
    environment, network = run.environment, run.network
    ppo, seed = run.config.ppo, run.config.seed
    self._samples = environment.num_worlds * ppo.rollout_length
    self._worlds = vec_env.VecNormalize(
      stable_baselines3_env.StableBaselines3VecEnv(environment, reward_scale),
      norm_reward=False,
    )
    self.model = stable_baselines3.PPO(
      'MlpPolicy',
      self._worlds,
      seed=seed,
      device='cpu',
      **settings(ppo, environment.num_worlds),
    )
    policy = self.model.policy
    layers = policy.mlp_extractor
    learners.copy_linears(network.policy, layers.policy_net, policy.action_net)
    if not environment.privileged_size:
      learners.copy_linears(network.value, layers.value_net, policy.value_net)
    # Its own would make a folder in every iteration.
    self.model.set_logger(logger.Logger(folder=None, output_formats=[]))

  def iterate(self) -> None:
    # One iteration: nothing is logged before a second.
    self.model.learn(self._samples, log_interval=2, reset_num_timesteps=False)

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    seen = self._worlds.normalize_obs(observations)
    actions, _ = self.model.predict(seen, deterministic=True)
    return actions
