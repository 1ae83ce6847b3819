"""A batched environment in which PPO learns within a second."""

import dataclasses
from typing import Callable, Mapping, NamedTuple

from dm_env import specs
import numpy as np

Target = Callable[[np.ndarray], np.ndarray]
Draw = Callable[[np.random.RandomState, int], np.ndarray]


@dataclasses.dataclass
class Results:
  """See `environment.EpisodeResults`."""

  worlds: np.ndarray
  initial: np.ndarray
  final: np.ndarray
  returns: np.ndarray
  lengths: np.ndarray
  causes: np.ndarray


class TimeStep(NamedTuple):
  """See `environment.BatchedTimeStep`."""

  reward: np.ndarray
  discount: np.ndarray
  last: np.ndarray
  observation: np.ndarray
  final_observation: np.ndarray
  results: Results


class TargetEnvironment:
  """Rewards actions near a target: -|a - target(observation)|^2.

  Every episode reaches its time limit after one step.
  """

  invalid_cause = 4

  def __init__(
    self, num_worlds: int, target: Target, draw: Draw, seed: int = 0
  ):
    """Draws observations [B, D] by `draw`; `target` maps them to [B, A]."""
    self.num_worlds = num_worlds
    self._target, self._draw = target, draw
    self._random_state = np.random.RandomState(seed)
    self._observation = self.reset()

  def observation_spec(self) -> specs.Array:
    return specs.Array(self._observation.shape[1:], np.float32)

  def action_spec(self) -> specs.BoundedArray:
    shape = self._target(self._observation).shape[1:]
    return specs.BoundedArray(shape, np.float64, -1.0, 1.0)

  def reset(self) -> np.ndarray:
    drawn = self._draw(self._random_state, self.num_worlds)
    self._observation = drawn.astype(np.float32)
    return self._observation

  def step(self, actions: np.ndarray) -> TimeStep:
    seen = self._observation
    reward = -np.sum((actions - self._target(seen)) ** 2, axis=-1)
    every, zeros = np.arange(self.num_worlds), np.zeros(self.num_worlds, int)
    ones = np.ones(self.num_worlds)
    results = Results(every, zeros, zeros, reward, zeros + 1, zeros)
    return TimeStep(reward, ones, ones > 0, self.reset(), seen, results)

  def learn(
    self,
    initial: np.ndarray,
    final: np.ndarray,
    returns: np.ndarray,
    survived: np.ndarray,
  ) -> None:
    pass

  def state(self) -> dict[str, np.ndarray]:
    return {'observation': self._observation.copy()}

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    self._observation = state['observation'].copy()
    return self._observation
