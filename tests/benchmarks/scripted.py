"""A batched environment whose episodes end as a script says."""

import types
from typing import NamedTuple

from dm_env import specs
import numpy as np

ON, TERMINATED, TRUNCATED = 0, 1, 2
SIZE, PRIVILEGED = 3, 2  # Numbers in an observation.
_ACTIONS = 2


class Results(NamedTuple):
  """See `batched.EpisodeResults`; what the adapters read."""

  worlds: np.ndarray


class TimeStep(NamedTuple):
  """See `batched.BatchedTimeStep`."""

  reward: np.ndarray
  discount: np.ndarray
  last: np.ndarray
  observation: np.ndarray
  final_observation: np.ndarray
  results: Results


class Scripted:
  """B worlds; observations begin with the episode, its step and the world."""

  config = types.SimpleNamespace(horizon=7)

  def __init__(self, ends: list[list[int]], privileged: bool = False):
    """Ends step t of world b as `ends[t][b]` says, over and over."""
    self._ends = np.array(ends)
    self.num_worlds = self._ends.shape[1]
    self.privileged_size = PRIVILEGED if privileged else 0
    self._time = 0
    self._episode = np.zeros(self.num_worlds)
    self._age = np.zeros(self.num_worlds)
    self.actions = np.zeros((self.num_worlds, _ACTIONS))

  def observation_spec(self) -> specs.Array:
    return specs.Array((SIZE + self.privileged_size,), np.float32)

  def action_spec(self) -> specs.BoundedArray:
    return specs.BoundedArray((_ACTIONS,), np.float64, [-1, -2], [1, 2])

  def observe(self) -> np.ndarray:
    world = np.arange(self.num_worlds)
    parts = [self._episode, self._age, world]
    parts += [100 + world] * self.privileged_size
    return np.stack(parts, axis=1).astype(np.float32)

  def reset(self) -> np.ndarray:
    self._episode += 1
    self._age[:] = 0
    return self.observe()

  def step(self, actions: np.ndarray) -> TimeStep:
    """Pays 1 + b in world b."""
    self.actions = np.array(actions)
    ends = self._ends[self._time % len(self._ends)]
    self._time += 1
    self._age += 1
    seen, worlds = self.observe(), np.flatnonzero(ends != ON)
    self._episode[worlds] += 1
    self._age[worlds] = 0
    return TimeStep(
      1.0 + np.arange(self.num_worlds),
      np.where(ends == TERMINATED, 0.0, 1.0),
      ends != ON,
      self.observe(),
      seen[worlds],
      Results(worlds),
    )
