"""Protocols between agents and environments."""

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
  """Description of an environment, from which an agent is built.

  Attributes:
    observation_spec: one world's observation, with privileged parts, [D].
    action_spec: one world's action, [A].
    privileged_size: number of entries at the end of the observation that only
      the value function sees.
    standing_action: mean action of an untrained policy, [A]; zero if None.
    symmetry: mirrors observations and actions; None without a mirror image.
    mode_of: maps observations to mode indices; None without modes.
  """

  observation_spec: specs.Array
  action_spec: specs.BoundedArray
  privileged_size: int = 0
  standing_action: np.ndarray | None = None
  symmetry: Symmetry | None = None
  mode_of: ModeOf | None = None


class Outcomes(Protocol):
  """Outcomes of N finished episodes, of this process or of others."""

  @property
  def initial(self) -> np.ndarray:
    """Indices of the first modes, [N]."""

  @property
  def final(self) -> np.ndarray:
    """Indices of the last modes, [N]."""

  @property
  def returns(self) -> np.ndarray:
    """Normalised returns, [N]."""

  @property
  def causes(self) -> np.ndarray:
    """Indices of the causes of the ends, 0 for the time limit, [N]."""

  @property
  def lengths(self) -> np.ndarray:
    """Lengths in control steps, [N]."""


class EpisodeResults(Outcomes, Protocol):
  """Episodes that ended in a step; see `BatchedTimeStep`."""

  @property
  def worlds(self) -> np.ndarray:
    """Indices of their worlds, [N]."""


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
    """Observations, of the next episode where `last`, [B, D]."""

  @property
  def final_observation(self) -> np.ndarray:
    """Last observations of the N worlds of `results.worlds`, [N, D]."""

  @property
  def results(self) -> EpisodeResults:
    """The N episodes that ended."""

  @property
  def transitions(self) -> Outcomes:
    """The transitions that ended, see `BatchedEnvironment.learn`."""


class BatchedEnvironment(Protocol):
  """B worlds that reset themselves at the end of an episode."""

  num_worlds: int

  def observation_spec(self) -> specs.Array:
    """One world's observation, float32 [D]."""

  def action_spec(self) -> specs.BoundedArray:
    """One world's action, [A]."""

  def reset(self) -> np.ndarray:
    """Begins an episode in every world; returns observations [B, D]."""

  def step(self, actions: np.ndarray) -> BatchedTimeStep:
    """Applies actions, [B, A]."""

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of the state for `restore`."""

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Restores a `state`; returns its observations."""


class MeasuredEnvironment(BatchedEnvironment, Protocol):
  """Batched environment with measurements for evaluations."""

  def measure(self) -> dict[str, np.ndarray]:
    """Returns position, reference, contact, ... by name, [B, ...] each."""


class TrainingEnvironment(BatchedEnvironment, Protocol):
  """Batched environment that adapts which episodes it begins.

  Attributes:
    invalid_cause: index among the `causes` of a world whose physics diverged.
  """

  invalid_cause: int

  @property
  def control_timestep(self) -> float:
    """Seconds of a control step."""

  @property
  def steps(self) -> int:
    """Environment steps so far, summed over all worlds of all ranks."""

  def learn(self, outcomes: Outcomes, /) -> None:
    """Adapts to finished episodes, of this environment and of others.

    An environment that trains alone does so in `step`, without this call.
    """
