"""Many worlds of a task as one vector environment of Gymnasium's.

import gymnasium
from dmc_multimode.suite.wrappers import gymnasium_env
envs = gymnasium.make_vec('dmc_multimode/walk_forward-v0', num_envs=64)
"""

from typing import Any, Mapping

import gymnasium
import numpy as np

from dmc_multimode import suite
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.wrappers import gymnasium_env


class BatchedVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
  """The worlds of one `BatchedImitation` behind Gymnasium's vector interface.

  Observations are float32 [B, D], actions joint targets in radians, float32
  [B, 10]. A world whose episode ends is reset in the same step; its last
  observation is `final_obs` of the infos.
  """

  metadata: dict[str, Any] = {
    'autoreset_mode': gymnasium.vector.AutoresetMode.SAME_STEP
  }

  def __init__(self, task: composer_task.Imitation, num_envs: int):
    """Compiles the task's model for B worlds.

    Args:
      task: its own physics is not touched.
      num_envs: B.

    Raises:
      ValueError: `num_envs` is not positive.
    """
    if num_envs < 1:
      raise ValueError(f'num_envs must be positive, got {num_envs}.')
    self.num_envs = num_envs
    # The worlds draw from this generator, and `reset` seeds it.
    self._random_state = np.random.RandomState()
    self._worlds = batched_env.BatchedImitation(
      task, num_envs, self._random_state
    )
    self._untaught, self._begun = self._worlds.state(), False
    self._names = np.array(task.mode_set.names, object)
    self.single_observation_space = gymnasium.spaces.Box(
      -np.inf, np.inf, self._worlds.observation_spec().shape, np.float32
    )
    self.single_action_space = gymnasium_env.space(self._worlds.action_spec())
    batch = gymnasium.vector.utils.batch_space
    self.observation_space = batch(self.single_observation_space, num_envs)
    self.action_space = batch(self.single_action_space, num_envs)

  def reset(
    self, *, seed: int | None = None, options: dict[str, Any] | None = None
  ) -> tuple[np.ndarray, dict[str, Any]]:
    """Begins an episode in every world; see `gymnasium.vector.VectorEnv`.

    Args:
      seed: of everything random from here on, in all worlds together. What an
        adaptive sampler has learned is forgotten as well.
      options: none are known.
    """
    super().reset(seed=seed, options=options)
    if seed is not None:
      self._worlds.restore(self._untaught)
      self._random_state.seed(self.np_random.integers(gymnasium_env.SEEDS))
    self._begun = True
    return self._worlds.reset(), self._modes()

  def step(
    self, actions: Any
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """Applies actions of `action_space`; see `gymnasium.vector.VectorEnv`.

    Raises:
      gymnasium.error.ResetNeeded: `reset` has not been called.
    """
    if not self._begun:
      raise gymnasium.error.ResetNeeded('Call reset() to begin episodes.')
    before = self._modes()['mode']
    step = self._worlds.step(np.asarray(actions))
    terminated = step.last & (step.discount == 0.0)
    infos = self._modes()
    if step.last.any():
      final = np.full(self.num_envs, None)
      for world, seen in zip(
        np.flatnonzero(step.last), step.final_observation, strict=True
      ):
        final[world] = seen
      infos |= {
        'final_obs': final,
        '_final_obs': step.last.copy(),
        'final_info': {'mode': before, '_mode': step.last.copy()},
        '_final_info': step.last.copy(),
      }
    truncated = step.last & ~terminated
    return step.observation, step.reward, terminated, truncated, infos

  def _modes(self) -> dict[str, Any]:
    """Returns the infos that every step has: the running modes, [B]."""
    modes = self._names[self._worlds.core.tracker.state.mode]
    return {'mode': modes, '_mode': np.ones(self.num_envs, dtype=bool)}


def make_vector(
  task: str,
  num_envs: int = 1,
  time_limit: float | None = None,
  task_kwargs: Mapping[str, Any] | None = None,
) -> BatchedVectorEnv:
  """Loads many worlds of a task; the vector entry point of the registry.

  Args:
    task: of the domain `multimode_biped`, whose actions are joint targets.
    num_envs: B.
    time_limit: length of an episode, seconds; the task's own by default.
    task_kwargs: further arguments of the task's factory, such as `config`.

  Raises:
    ValueError: the task is unknown, or B is not positive.
  """
  kwargs = {'time_limit': time_limit, **(task_kwargs or {})}
  environment = suite.load(suite.DOMAIN, task, kwargs)
  return BatchedVectorEnv(environment.task, num_envs)
