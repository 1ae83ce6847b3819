"""A batched environment in which PPO learns within a second."""

from typing import Callable, Mapping, NamedTuple

from dm_env import specs
import numpy as np

from dmc_multimode.agents import core
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import builder
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks

Target = Callable[[np.ndarray], np.ndarray]
Draw = Callable[[np.random.RandomState, int], np.ndarray]


class Results(NamedTuple):
  """See `core.EpisodeResults`."""

  worlds: np.ndarray
  initial: np.ndarray
  final: np.ndarray
  returns: np.ndarray
  lengths: np.ndarray
  causes: np.ndarray


class TimeStep(NamedTuple):
  """See `core.BatchedTimeStep`."""

  reward: np.ndarray
  discount: np.ndarray
  last: np.ndarray
  observation: np.ndarray
  final_observation: np.ndarray
  results: Results

  @property
  def transitions(self) -> Results:
    """The episodes, of one transition each."""
    return self.results


class TargetEnvironment:
  """Rewards actions near a target: -|a - target(observation)|^2.

  Every episode reaches its time limit after one step.
  """

  invalid_cause, control_timestep = 4, 0.03

  def __init__(
    self,
    num_worlds: int,
    target: Target,
    draw: Draw,
    seed: int = 0,
    replicas: int = 1,
  ):
    """Draws observations [B, D] by `draw`; `target` maps them to [B, A]."""
    self.num_worlds, self._replicas, self.steps = num_worlds, replicas, 0
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
    self.steps += self.num_worlds * self._replicas
    seen = self._observation
    reward = -np.sum((actions - self._target(seen)) ** 2, axis=-1)
    every, zeros = np.arange(self.num_worlds), np.zeros(self.num_worlds, int)
    ones = np.ones(self.num_worlds)
    results = Results(every, zeros.copy(), zeros, reward, zeros + 1, zeros)
    return TimeStep(reward, ones, ones > 0, self.reset(), seen, results)

  def learn(self, outcomes: core.Outcomes) -> None:
    pass

  def state(self) -> dict[str, np.ndarray]:
    return {
      'observation': self._observation.copy(),
      'steps': np.array(self.steps),
    }

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    self.steps = int(state['steps'])
    self._observation = state['observation'].copy()
    return self._observation

  def description(
    self,
    symmetry: core.Symmetry | None = None,
    mode_of: core.ModeOf | None = None,
  ) -> core.EnvironmentDescription:
    return core.EnvironmentDescription(
      self.observation_spec(),
      self.action_spec(),
      symmetry=symmetry,
      mode_of=mode_of,
    )


def loop(
  environment: TargetEnvironment,
  config: ppo_config.PPOConfig,
  symmetry: core.Symmetry | None = None,
  network: networks.ActorCritic | None = None,
) -> runner.TrainingLoop:
  """Trains in these worlds, in one mode."""
  parts = builder.PPOBuilder(config, environment.description(symmetry), seed=0)
  network = network or parts.make_networks()
  return runner.TrainingLoop(
    environment,
    parts.make_actor(network),
    parts.make_learner(network),
    config.rollout_length,
    ('reach',),
    lambda: {'p/reach': 1.0},
  )
