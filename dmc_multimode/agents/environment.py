"""What the agents ask of a batched environment: a structural protocol."""

from typing import Any, Mapping, Protocol

from dm_env import specs
import numpy as np


class EpisodeResults(Protocol):
  """Episodes that ended in a step, N of them; see `BatchedEnvironment`."""

  worlds: np.ndarray
  initial: np.ndarray
  final: np.ndarray
  returns: np.ndarray
  lengths: np.ndarray
  causes: np.ndarray


class BatchedTimeStep(Protocol):
  """A step of B worlds.

  `discount` is the mask for bootstrapping, `last` that for cutting: at a time
  limit the former is 1 and the latter true. `observation` [B, D] is already
  that of the next episode where `last`; `final_observation` [N, D] is what the
  N worlds of `results.worlds` saw at the end.
  """

  reward: np.ndarray
  discount: np.ndarray
  last: np.ndarray
  observation: np.ndarray
  final_observation: np.ndarray
  results: Any


class BatchedEnvironment(Protocol):
  """B worlds that begin new episodes by themselves."""

  num_worlds: int

  def observation_spec(self) -> specs.Array:
    """One world's observation, float32 [D]."""

  def action_spec(self) -> specs.BoundedArray:
    """One world's action, [A]."""

  def reset(self) -> np.ndarray:
    """Begins an episode everywhere; returns observations [B, D]."""

  def step(self, actions: np.ndarray) -> Any:
    """Applies actions [B, A]; returns a `BatchedTimeStep`."""

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of everything that `restore` needs."""

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Takes over a `state`; returns the observations of that moment."""


class MeasuredEnvironment(BatchedEnvironment, Protocol):
  """A batched environment that tells what evaluations look at."""

  def measure(self) -> dict[str, np.ndarray]:
    """Returns position, reference, support, contact, ..., [B, ...] each."""
