"""Protocols by which agents and environments know each other."""

import dataclasses
from typing import Callable, Mapping, Protocol

from dm_env import specs
import numpy as np
import torch

# Mirror images of raw observations [N, D] and of actions [N, ..., A].
Symmetry = Callable[
  [torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]
]
# Index of the mode that each raw observation commands: [N, D] -> [N].
ModeOf = Callable[[torch.Tensor], torch.Tensor]


class Policy(Protocol):
  """Selects actions in a batch of worlds."""

  def select_action(self, observations: np.ndarray, /) -> np.ndarray:
    """Returns actions [B, A] for observations float32 [B, D]."""


@dataclasses.dataclass(frozen=True, eq=False)
class EnvironmentDescription:
  """Describes an environment to an agent that is to be built for it.

  Attributes:
    observation_spec: one world's observation, with privileged parts, [D].
    action_spec: one world's action, [A].
    privileged_size: how many of the observation's last numbers only the value
      function sees.
    standing_action: what a policy does before it has learned, [A]; zero if
      None.
    symmetry: mirrors observations and actions, if the environment has a mirror
      image.
    mode_of: tells modes by observations, if there are any.
  """

  observation_spec: specs.Array
  action_spec: specs.BoundedArray
  privileged_size: int = 0
  standing_action: np.ndarray | None = None
  symmetry: Symmetry | None = None
  mode_of: ModeOf | None = None


class Outcomes(Protocol):
  """N finished episodes, wherever they were."""

  @property
  def initial(self) -> np.ndarray:
    """Indices of their first modes, [N]."""

  @property
  def final(self) -> np.ndarray:
    """Indices of their last modes, [N]."""

  @property
  def returns(self) -> np.ndarray:
    """Normalised returns, [N]."""

  @property
  def causes(self) -> np.ndarray:
    """Causes of their ends, 0 for the time limit, [N]."""


class EpisodeResults(Outcomes, Protocol):
  """Those that ended in a step; see `BatchedTimeStep`."""

  @property
  def worlds(self) -> np.ndarray:
    """Indices of their worlds, [N]."""

  @property
  def lengths(self) -> np.ndarray:
    """Control steps, [N]."""


class BatchedTimeStep(Protocol):
  """A step of B worlds.

  `discount` is the mask for bootstrapping, `last` that for cutting: at a time
  limit the former is 1 and the latter true.
  """

  @property
  def reward(self) -> np.ndarray:
    """Rewards, [B]."""

  @property
  def discount(self) -> np.ndarray:
    """0 where the episode terminated, 1 elsewhere, [B]."""

  @property
  def last(self) -> np.ndarray:
    """True where the episode ended, [B]."""

  @property
  def observation(self) -> np.ndarray:
    """Of the next episode where `last`, [B, D]."""

  @property
  def final_observation(self) -> np.ndarray:
    """Last observations of the N worlds of `results.worlds`, [N, D]."""

  @property
  def results(self) -> EpisodeResults:
    """The N episodes that ended."""


class BatchedEnvironment(Protocol):
  """B worlds that begin new episodes by themselves."""

  num_worlds: int

  def observation_spec(self) -> specs.Array:
    """One world's observation, float32 [D]."""

  def action_spec(self) -> specs.BoundedArray:
    """One world's action, [A]."""

  def reset(self) -> np.ndarray:
    """Begins an episode everywhere; returns observations [B, D]."""

  def step(self, actions: np.ndarray) -> BatchedTimeStep:
    """Applies actions, [B, A]."""

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of everything that `restore` needs."""

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Restores a `state`; returns the observations of that moment."""


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

  @property
  def steps(self) -> int:
    """Environment steps so far, summed over all worlds of all ranks."""

  def learn(self, outcomes: Outcomes, /) -> None:
    """Learns from finished episodes, its own and others'.

    An environment that trains alone learns by itself, and is not told.
    """
