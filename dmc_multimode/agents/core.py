"""What the agents ask of a batched environment: a structural protocol."""

from typing import Any, Mapping, Protocol

from dm_env import specs
import numpy as np


class FinishedEpisodes(Protocol):
  """N episodes, wherever they were.

  Attributes:
    initial, final: indices of their first and last modes, [N].
    returns: normalised returns, [N].
    causes: why they ended, 0 for the time limit, [N].
  """

  initial: np.ndarray
  final: np.ndarray
  returns: np.ndarray
  causes: np.ndarray


class EpisodeResults(FinishedEpisodes, Protocol):
  """Those that ended in a step; see `BatchedTimeStep`."""

  worlds: np.ndarray
  lengths: np.ndarray


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


class TrainingEnvironment(BatchedEnvironment, Protocol):
  """A batched environment that learns which episodes to begin.

  Attributes:
    invalid_cause: the one of the `causes` that stands for a world whose physics
      diverged.
  """

  invalid_cause: int

  def learn(
    self,
    initial: np.ndarray,
    final: np.ndarray,
    returns: np.ndarray,
    survived: np.ndarray,
  ) -> None:
    """Takes the outcome of finished episodes, its own and others', [N] each.

    An environment that trains alone learns by itself, and is not told.
    """
