"""The batched worlds behind rsl_rl's `VecEnv`; needs the extra `rsl_rl`.

    from dmc_multimode.suite.wrappers import rsl_rl_env
    from rsl_rl import runners

    worlds = rsl_rl_env.RslRlVecEnv(environment)
    runners.OnPolicyRunner(worlds, settings, device='cpu').learn(100)

The groups of observations that a runner's `obs_groups` can name are `POLICY`
and, where the environment has any, `PRIVILEGED`.
"""

from typing import Any

import numpy as np
import torch

from dmc_multimode.suite.imitation import batched_env

try:
  from rsl_rl import env as rsl_rl_env
  import tensordict
except ModuleNotFoundError as error:
  raise ModuleNotFoundError(
    f'{error.name} is not installed: pip install dmc_multimode[rsl_rl]',
    name=error.name,
  ) from None

POLICY = 'policy'  # The policy's observations, float32 [B, D].
PRIVILEGED = 'privileged'  # For the value function alone, float32 [B, P].


class RslRlVecEnv(rsl_rl_env.VecEnv):
  """B worlds of a `BatchedImitation` behind rsl_rl's interface.

  Everything is a tensor on the CPU; a runner on another device moves it. A
  world whose episode ends begins the next in the same step, so that the
  observations returned there are the next episode's.

  Attributes:
    num_envs: B.
    num_actions: joints, A.
    max_episode_length: control steps to the time limit.
    episode_length_buf: control steps of the running episodes, int64 [B]. A
      runner may overwrite it (`init_at_random_ep_len`); this does not change
      when episodes end.
    device: where the tensors are.
    cfg: empty.
  """

  def __init__(
    self, environment: batched_env.BatchedImitation, reward_scale: float = 1.0
  ):
    """Resets an environment and takes ownership of it.

    Args:
      environment: B worlds with `auto_reset`. Its seed determines all
        randomness.
      reward_scale: factor of the rewards.
    """
    self._environment, self._scale = environment, reward_scale
    size = environment.observation_spec().shape[0]
    self._size = size - environment.privileged_size
    self.num_envs = environment.num_worlds
    self.num_actions = environment.action_spec().shape[0]
    self.max_episode_length = environment.config.horizon
    self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.int64)
    self.device = 'cpu'
    self.cfg: dict[str, Any] = {}
    self._observation = environment.reset()

  def get_observations(self) -> tensordict.TensorDict:
    """Returns the groups of observations, batch size [B]."""
    return self._groups(self._observation)

  def step(
    self, actions: torch.Tensor
  ) -> tuple[tensordict.TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Applies actions for one control step.

    Args:
      actions: joint targets in radians, [B, A].

    Returns:
      Observations; rewards, float32 [B]; where an episode ended, int64 [B];
      and a dictionary with

        time_outs: which of these ends are time limits, bool [B]. rsl_rl
          bootstraps them from the value of the observation before the end.
        final_observations: the groups of observations with those of the ended
          episodes still in place, to bootstrap from.
    """
    step = self._environment.step(actions)
    self._observation = final = step.observation
    if step.last.any():
      final = final.copy()
      final[step.last] = step.final_observation
    rewards = (self._scale * step.reward).astype(np.float32)
    done = torch.from_numpy(step.last)
    self.episode_length_buf += 1
    self.episode_length_buf[done] = 0
    extras = {
      'time_outs': torch.from_numpy(step.last & (step.discount > 0)),
      'final_observations': self._groups(final),
    }
    return (
      self.get_observations(),
      torch.from_numpy(rewards),
      done.long(),
      extras,
    )

  def _groups(self, observation: np.ndarray) -> tensordict.TensorDict:
    """Splits observations, [B, D + P]."""
    tensor = torch.from_numpy(observation)
    groups = {POLICY: tensor[:, : self._size]}
    if self._size < tensor.shape[1]:
      groups[PRIVILEGED] = tensor[:, self._size :]
    return tensordict.TensorDict(groups, batch_size=[self.num_envs])
