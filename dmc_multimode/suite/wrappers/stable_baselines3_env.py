"""The batched worlds behind Stable-Baselines3's `VecEnv`; extra `sb3`.

    from dmc_multimode.suite.wrappers import stable_baselines3_env
    import stable_baselines3

    worlds = stable_baselines3_env.StableBaselines3VecEnv(environment)
    stable_baselines3.PPO('MlpPolicy', worlds).learn(1_000_000)

`VecMonitor` and `VecNormalize` wrap it as they wrap any other.
"""

from typing import Any, Sequence

import numpy as np

from dmc_multimode.suite.imitation import batched_env

try:
  from gymnasium import spaces
  from stable_baselines3.common import vec_env
except ModuleNotFoundError as error:
  raise ModuleNotFoundError(
    f'{error.name} is not installed: pip install dmc_multimode[sb3]',
    name=error.name,
  ) from None

_Indices = int | Sequence[int] | None


class StableBaselines3VecEnv(vec_env.VecEnv):
  """B worlds of a `BatchedImitation` behind Stable-Baselines3's interface.

  Observations are float32 [B, D], actions joint targets in radians, float32
  [B, A]. Privileged observations are left out: the library has no place for
  them. The worlds are rows of arrays and no objects, so that nothing can be set
  or called in one of them, and all randomness is of the seed that the
  environment was made with: `seed` changes nothing.
  """

  def __init__(
    self, environment: batched_env.BatchedImitation, reward_scale: float = 1.0
  ):
    """Wraps an environment and takes ownership of it.

    Args:
      environment: B worlds with `auto_reset`.
      reward_scale: factor of the rewards.
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
    """Begins an episode in every world; returns float32 [B, D]."""
    return self._environment.reset()[:, : self._size]

  def step_async(self, actions: np.ndarray) -> None:
    """Keeps actions [B, A] for `step_wait`."""
    self._actions = actions

  def step_wait(
    self,
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
    """Applies the actions for one control step.

    Returns:
      Observations, which are the next episode's where one ended; rewards,
      float32 [B]; where an episode ended, bool [B]; and a dictionary a world,
      empty but where an episode ended:

        terminal_observation: the last of the episode that ended, float32 [D].
        TimeLimit.truncated: whether the time limit ended it. The library then
          bootstraps from the value of `terminal_observation`.
    """
    step = self._environment.step(self._actions)
    infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
    ends = step.final_observation[:, : self._size]
    for world, end in zip(np.flatnonzero(step.last), ends, strict=True):
      infos[world] = {
        'terminal_observation': end,
        'TimeLimit.truncated': bool(step.discount[world] > 0),
      }
    rewards = (self._scale * step.reward).astype(np.float32)
    return step.observation[:, : self._size], rewards, step.last, infos

  def close(self) -> None:
    """Does nothing: there are no processes to end."""

  def get_attr(self, attr_name: str, indices: _Indices = None) -> list[Any]:
    """Returns `render_mode`, None in each of the worlds `indices`.

    Raises:
      AttributeError: the name is another.
    """
    if attr_name == 'render_mode':
      return [None for _ in self._get_indices(indices)]
    raise AttributeError(f'The worlds of a batch have no {attr_name}.')

  def set_attr(
    self, attr_name: str, value: Any, indices: _Indices = None
  ) -> None:
    """Raises NotImplementedError: see the class."""
    raise NotImplementedError(f'Nothing can set {attr_name} in one world.')

  def env_method(
    self,
    method_name: str,
    *method_args: Any,
    indices: _Indices = None,
    **method_kwargs: Any,
  ) -> list[Any]:
    """Raises NotImplementedError: see the class."""
    raise NotImplementedError(f'Nothing can call {method_name} in one world.')

  def env_is_wrapped(
    self, wrapper_class: type[Any], indices: _Indices = None
  ) -> list[bool]:
    """Returns False for each of the worlds `indices`."""
    return [False for _ in self._get_indices(indices)]
