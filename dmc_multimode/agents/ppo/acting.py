"""Actors: select actions by a policy, for training and for dm_env."""

from typing import Any, Mapping, Sequence

import dm_env
import numpy as np
import torch

from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.utils import arrays


class BatchedActor:
  """Selects actions for all worlds of a batched environment."""

  def __init__(
    self,
    network: networks.ActorCritic,
    seed: int,
    config: ppo_config.PPOConfig | None = None,
    threads: pair.Pair | None = None,
  ):
    """Acts with `network`; `seed` is of the exploration noise."""
    self._network = network
    self._generator = torch.Generator().manual_seed(seed)
    self._config = config or ppo_config.PPOConfig()
    self._threads = threads or pair.Pair()
    self._deterministic = torch.zeros(0, dtype=torch.bool)

  @torch.no_grad()
  def sample(
    self, observation: torch.Tensor, steps: int = 0
  ) -> networks.Sample:
    """Samples actions, without noise in deterministic worlds, on the CPU.

    Args:
      observation: float32 [B, D].
      steps: environment steps of the training, summed over all worlds.
    """
    std = self._network.std.cpu()
    mean = self._act(observation)
    noise = torch.empty_like(mean).normal_(generator=self._generator)
    share = self._config.deterministic_fraction.at(steps)
    if share:
      self._change_deterministic(len(mean), share)
      noise[self._deterministic] = 0.0
    action = mean + std * noise
    return networks.Sample(action, networks.log_prob(action, mean, std), mean)

  def _change_deterministic(self, num_worlds: int, share: float) -> None:
    """Draws the worlds whose noise stops or starts in this step."""
    if len(self._deterministic) != num_worlds:
      self._deterministic = torch.zeros(num_worlds, dtype=torch.bool)
    end = 1 / self._config.deterministic_steps
    begin = end * share / (1 - share)
    drawn = torch.rand(num_worlds, generator=self._generator)
    self._deterministic = torch.where(
      self._deterministic, drawn >= end, drawn < begin
    )

  @torch.no_grad()
  def select_action(self, observation: np.ndarray) -> np.ndarray:
    """Returns the mean actions for observations [B, D], float32 [B, A].

    Raises:
      ValueError: they are no numbers, or have another shape.
    """
    rows = arrays.rows(observation, 'observations')
    return self._act(torch.from_numpy(rows)).numpy()

  def _act(self, observation: torch.Tensor) -> torch.Tensor:
    """Returns mean actions of the network, on any device, on the CPU."""
    rows = observation.to(self._network.log_std.device)
    return self._threads.map_rows(self._network.act, rows).cpu()

  def state(self) -> dict[str, torch.Tensor]:
    """Returns the generator's state and the mask of deterministic worlds."""
    state = {'generator': self._generator.get_state()}
    if self._config.most_deterministic:
      state['quiet'] = self._deterministic.clone()  # Checkpoints have this key.
    return state

  def restore(self, state: Mapping[str, torch.Tensor]) -> None:
    """Restores a `state`."""
    self._generator.set_state(state['generator'])
    self._deterministic = state.get('quiet', self._deterministic)


class FeedForwardActor:
  """An Acme-style actor for one dm_env environment.

  Observations are dictionaries whose values, concatenated in their order, make
  up the network's input.
  """

  def __init__(self, network: networks.ActorCritic, parts: Sequence[str] = ()):
    """Acts with the mean of `network`.

    Args:
      network: the policy.
      parts: keys of the observation that it observes, in order; all by default,
        and where an observation has none of them.
    """
    self._network, self._parts = network, tuple(parts)

  @torch.no_grad()
  def select_action(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the mean action, float64 [A].

    Raises:
      ValueError: the parts are no numbers, or have another length together, or
        lack one that the policy observes.
    """
    lacking = [name for name in self._parts if name not in observation]
    if len(lacking) < len(self._parts):
      if lacking:
        raise ValueError(
          f'the policy observes {lacking[0]!r}, which this environment does '
          'not show: build the environment with the task of the policy: '
          'make_task(policy.mode_set, config=policy.config).'
        )
      observation = {name: observation[name] for name in self._parts}
    flat = np.concatenate([np.ravel(part) for part in observation.values()])
    batch = torch.from_numpy(arrays.rows(flat, 'observation'))[None]
    return self._network.act(batch)[0].double().numpy()

  def observe_first(self, timestep: dm_env.TimeStep) -> None:
    """Does nothing: the actor does not learn."""

  def observe(self, action: np.ndarray, next_timestep: dm_env.TimeStep) -> None:
    """Does nothing: the actor does not learn."""

  def update(self, wait: bool = False) -> None:
    """Does nothing: the network is shared."""


class EnvironmentLoop:
  """Runs an actor in one dm_env environment."""

  def __init__(self, environment: dm_env.Environment, actor: FeedForwardActor):
    """Connects `environment` and `actor`."""
    self._environment, self._actor = environment, actor

  def run_episode(self) -> dict[str, Any]:
    """Runs one episode; returns its length, return and whether it survived."""
    timestep = self._environment.reset()
    self._actor.observe_first(timestep)
    steps, total = 0, 0.0
    while not timestep.last():
      action = self._actor.select_action(timestep.observation)
      timestep = self._environment.step(action)
      self._actor.observe(action, timestep)
      self._actor.update()
      steps, total = steps + 1, total + float(timestep.reward)
    return {
      'episode_length': steps,
      'episode_return': total,
      'survived': bool(timestep.discount),
    }
