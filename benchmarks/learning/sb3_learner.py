"""Stable-Baselines3's PPO on BatchedImitation; needs the extra `bench`."""

# Optional: not always there to be checked against.
# mypy: disable-error-code="import-not-found"

import math
from typing import Any

import numpy as np

from benchmarks.learning import learners
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.suite.imitation import batched_env

try:
  from gymnasium import spaces
  import stable_baselines3
  from stable_baselines3.common import buffers
  from stable_baselines3.common import logger
  from stable_baselines3.common import vec_env
except ModuleNotFoundError as error:
  raise learners.missing(error) from None


class VecEnv(vec_env.VecEnv):
  """The worlds of a batch behind the library's interface.

  Privileged information is left out: the library has no place for it.
  """

  def __init__(
    self, environment: batched_env.BatchedImitation, reward_scale: float
  ):
    """Takes over an environment.

    Args:
      environment: B worlds that reset by themselves.
      reward_scale: rewards are multiplied by it.
    """
    self._environment, self._scale = environment, reward_scale
    size = environment.observation_spec().shape[0]
    self._size = size - environment.privileged_size
    bounds = environment.action_spec()
    self._actions = np.zeros((environment.num_worlds, *bounds.shape))
    super().__init__(
      environment.num_worlds,
      spaces.Box(-np.inf, np.inf, (self._size,), np.float32),
      spaces.Box(
        bounds.minimum.astype(np.float32), bounds.maximum.astype(np.float32)
      ),
    )

  def reset(self) -> np.ndarray:
    """Begins an episode everywhere; returns float32 [B, D]."""
    return self._environment.reset()[:, : self._size]

  def step_async(self, actions: np.ndarray) -> None:
    """Takes actions [B, A]."""
    self._actions = actions

  def step_wait(
    self,
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
    """Applies them; returns observations, rewards, ends and infos."""
    step = self._environment.step(self._actions)
    infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
    ends = step.final_observation[:, : self._size]
    for world, end in zip(step.results.worlds, ends, strict=True):
      infos[world] = {
        'terminal_observation': end,
        'TimeLimit.truncated': bool(step.discount[world] > 0),
      }
    rewards = (self._scale * step.reward).astype(np.float32)
    return step.observation[:, : self._size], rewards, step.last, infos

  def close(self) -> None:
    """Has nothing to end."""

  def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
    """Returns an attribute for each of the worlds `indices`."""
    if attr_name == 'render_mode':
      return [None for _ in self._get_indices(indices)]
    raise AttributeError(f'The worlds of a batch have no {attr_name}.')

  def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
    """Is not supported: worlds of a batch are no objects."""
    raise NotImplementedError(attr_name)

  def env_method(
    self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
  ) -> list[Any]:
    """Is not supported: worlds of a batch are no objects."""
    raise NotImplementedError(method_name)

  def env_is_wrapped(
    self, wrapper_class: Any, indices: Any = None
  ) -> list[bool]:
    """Returns that none is."""
    return [False for _ in self._get_indices(indices)]


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


class Learner:
  """See `learners.Learner`."""

  threads = 1
  update: learners.Methods = (
    (buffers.RolloutBuffer, 'compute_returns_and_advantage'),
    (stable_baselines3.PPO, 'train'),
  )

  def __init__(
    self,
    environment: batched_env.BatchedImitation,
    network: networks.ActorCritic,
    ppo: ppo_config.PPOConfig,
    seed: int,
    reward_scale: float,
  ):
    """Learns in `environment`, from the weights of `network` on."""
    self.environment = environment
    self._samples = environment.num_worlds * ppo.rollout_length
    self._worlds = vec_env.VecNormalize(
      VecEnv(environment, reward_scale), norm_reward=False
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

  def begin_episodes(self) -> None:
    """Has no memory."""

  def iterate(self) -> None:
    """See `learners.Learner`."""
    # One iteration: nothing is logged before a second.
    self.model.learn(self._samples, log_interval=2, reset_num_timesteps=False)

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    """See `learners.Learner`."""
    seen = self._worlds.normalize_obs(observations)
    actions, _ = self.model.predict(seen, deterministic=True)
    return actions
