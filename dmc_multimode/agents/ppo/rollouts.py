"""Rollouts of a policy, and their conversion to training samples."""

import functools
from typing import Iterator, NamedTuple

import torch

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import losses
from dmc_multimode.agents.ppo import networks


class Rollouts(NamedTuple):
  """T steps of B worlds.

  Attributes:
    observations: raw, [T, B, D].
    actions: [T, B, A].
    log_probs: of the actions when they were taken, [T, B].
    means: mean actions of the policy at that time, [T, B, A].
    rewards: [T, B].
    discounts: environment discounts (0 where terminated), [T, B].
    last: whether an episode ended with the step, [T, B].
    next_observations: after the step, before any reset, [T, B, D].
  """

  observations: torch.Tensor
  actions: torch.Tensor
  log_probs: torch.Tensor
  means: torch.Tensor
  rewards: torch.Tensor
  discounts: torch.Tensor
  last: torch.Tensor
  next_observations: torch.Tensor

  def is_finite(self) -> bool:
    """Returns True if all values are finite."""
    # A finite sum has finite parts, and costs a tenth.
    return all(
      bool(torch.isfinite(field.sum()) or torch.isfinite(field).all())
      for field in self
      if field.is_floating_point()
    )


class Samples(NamedTuple):
  """Training samples.

  Attributes:
    observations: normalised, [N, D].
    actions: [N, A].
    log_probs: of the actions when they were taken, [N].
    means: mean actions of the policy at that time, [N, A].
    advantages: normalised, [N].
    targets: of the value function, [N].
    reference_means: mean actions of the reference policy, [N, A]; [N, 0]
      without one.
  """

  observations: torch.Tensor
  actions: torch.Tensor
  log_probs: torch.Tensor
  means: torch.Tensor
  advantages: torch.Tensor
  targets: torch.Tensor
  reference_means: torch.Tensor


class SampleMaker:
  """Converts rollouts to samples: advantages, targets, mirror images."""

  def __init__(
    self,
    network: networks.ActorCritic,
    config: ppo_config.PPOConfig,
    symmetry: core.Symmetry | None = None,
    mode_of: core.ModeOf | None = None,
    reference: kickstarting.ReferencePolicy | None = None,
    threads: pair.Pair | None = None,
    communicator: distributed.Communicator = distributed.LOCAL,
  ):
    """Keeps the network and options; see `learning.PPOLearner`.

    Raises:
      ValueError: the configuration requires an argument that is missing.
    """
    if config.symmetry != 'none' and symmetry is None:
      raise ValueError('symmetry needs an environment that knows its mirror.')
    if config.advantages == 'mode' and mode_of is None:
      raise ValueError('advantages by mode need the latents of the modes.')
    self._network, self._config = network, config
    self._symmetry = symmetry if config.symmetry != 'none' else None
    self._mode_of = mode_of if config.advantages == 'mode' else None
    self._reference = reference
    self._threads = threads or pair.Pair()
    self._communicator = communicator

  @torch.no_grad()
  def make(self, rollouts: Rollouts) -> Samples:
    """Returns N = T x B samples, followed by their N mirror images, if any."""
    config, network = self._config, self._network
    seen = network.normaliser(rollouts.observations)
    flat = self._threads.map_rows(network.values, seen.flatten(0, 1))
    values = flat.view_as(rollouts.rewards)
    next_values = self._next_values(rollouts, values)
    # In units of 1 - gamma a value is a mean reward: of order one, any gamma.
    advantages = losses.generalised_advantages(
      (1 - config.discount) * rollouts.rewards,
      values,
      next_values,
      config.discount * rollouts.discounts,
      rollouts.last,
      config.gae_lambda,
    )
    raw = rollouts.observations.flatten(0, 1)
    samples = Samples(
      seen.flatten(0, 1),
      rollouts.actions.flatten(0, 1),
      rollouts.log_probs.flatten(),
      rollouts.means.flatten(0, 1),
      advantages.flatten(),
      (advantages + values).flatten(),
      self._reference_means(raw),
    )
    groups = self._mode_of(raw) if self._mode_of else None
    # Actions without noise have no likelihood to improve.
    explored = (samples.actions != samples.means).any(dim=-1)
    samples = samples._replace(
      advantages=explored
      * losses.normalised(samples.advantages, groups, self._communicator)
    )
    return self._with_mirror_images(samples, raw)

  def _reference_means(self, raw: torch.Tensor) -> torch.Tensor:
    """Returns the kickstarting policy's mean actions; width 0 without one."""
    return self._reference.means(raw) if self._reference else raw[:, :0]

  def _next_values(
    self, rollouts: Rollouts, values: torch.Tensor
  ) -> torch.Tensor:
    """Returns bootstrap values v(o_{t+1}), [T, B].

    They are the values of the next row or, at the end of an episode or of the
    rollout, that of the last observation before the reset.
    """
    next_values = torch.empty_like(values)
    next_values[:-1] = values[1:]
    cut = rollouts.last.clone()
    cut[-1] = True
    ends = self._network.normaliser(rollouts.next_observations[cut])
    next_values[cut] = self._threads.map_rows(self._network.values, ends)
    return next_values

  def _with_mirror_images(self, samples: Samples, raw: torch.Tensor) -> Samples:
    """Appends the mirror images of samples of raw observations [N, D]."""
    if self._symmetry is None:
      return samples
    both = torch.stack([samples.actions, samples.means], dim=1)
    mirrored, both = self._symmetry(raw, both)
    image = samples._replace(
      observations=self._network.normaliser(mirrored),
      actions=both[:, 0],
      means=both[:, 1],
      reference_means=self._reference_means(mirrored),
    )
    return Samples(
      *(torch.cat(parts) for parts in zip(samples, image, strict=True))
    )


def passes(
  count: int, config: ppo_config.PPOConfig, generator: torch.Generator
) -> Iterator[torch.Tensor]:
  """Yields the indices of the samples of every pass, in order.

  Args:
    count: number of samples. With `config.symmetry` 'alternate' the second half
      are mirror images of the first, and a pass takes one of the two.
    config: has the number of passes.
    generator: draws the order.
  """
  shuffle = functools.partial(torch.randperm, generator=generator)
  if config.symmetry != 'alternate':
    for _ in range(config.epochs):
      yield shuffle(count)
    return
  half = count // 2
  side = torch.zeros(half, dtype=torch.int64)
  for epoch in range(config.epochs):
    if epoch % 2 == 0:
      side.random_(0, 2, generator=generator)
    else:
      side = 1 - side
    order = shuffle(half)
    yield order + half * side[order]
