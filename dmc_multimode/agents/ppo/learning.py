"""The PPO learner: one step is one iteration over one batch of rollouts."""

from typing import Any, Mapping, Sequence

import torch

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import losses
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import optimiser
from dmc_multimode.agents.ppo import rollouts as rollouts_lib
from dmc_multimode.utils import arrays

_LEARNING_RATE_STEP = 1.2  # Factor of each adaptation.
_KL_STRIDE = 8  # Stride of the samples from which the KL is estimated.

Metrics = dict[str, torch.Tensor]


class PPOLearner:
  """Updates an `ActorCritic` in place.

  Policy and value function share no weights, so that two threads fit them in
  parallel.

  Several ranks, each with its own rollouts, train one network: statistics and
    gradients are over the samples of all ranks, so that all hold the same
    network to the bit. Each rank draws its own minibatches.

  Attributes:
    network: the trained network.
    learning_rate: current learning rate.
  """

  def __init__(
    self,
    network: networks.ActorCritic,
    config: ppo_config.PPOConfig,
    seed: int,
    symmetry: core.Symmetry | None = None,
    mode_of: core.ModeOf | None = None,
    threads: pair.Pair | None = None,
    communicator: distributed.Communicator = distributed.LOCAL,
    reference: kickstarting.ReferencePolicy | None = None,
  ):
    """Creates the optimisers.

    Args:
      network: to be trained, on its device.
      config: hyperparameters.
      seed: of the minibatches.
      symmetry: required unless `config.symmetry` is 'none'.
      mode_of: required if `config.advantages` is 'mode'.
      threads: for policy and value function; the calling one by default.
      communicator: connects the ranks that train this network.
      reference: policy to stay near to, for kickstarting.

    Raises:
      ValueError: the configuration requires an argument that is missing.
    """
    self.network, self._config = network, config
    self._communicator = communicator
    self._threads = threads or pair.Pair()
    self._has_reference = reference is not None
    self._samples = rollouts_lib.SampleMaker(
      network, config, symmetry, mode_of, reference, self._threads, communicator
    )
    self._generator = torch.Generator().manual_seed(seed)
    network.log_std.requires_grad_(config.learn_std)
    value = list(network.value.parameters())
    theirs = {id(parameter) for parameter in value}
    policy = [
      p for p in network.parameters() if p.requires_grad and id(p) not in theirs
    ]
    self._policy = optimiser.Optimiser(policy, config, communicator)
    # Two threads must not interleave collective operations on one group.
    self._value = optimiser.Optimiser(value, config, communicator.split())
    self.learning_rate = config.learning_rate
    network.bound_std(*config.std_bounds(0))

  def step(
    self, rollouts: rollouts_lib.Rollouts, steps: int
  ) -> dict[str, float]:
    """Updates the network by one iteration's rollouts; returns metrics.

    Args:
      rollouts: of this rank.
      steps: environment steps, summed over all worlds, before these rollouts.

    Raises:
      FloatingPointError: the rollouts or the update are not finite, at any
        rank; the network is as before this step.
    """
    device = self.network.log_std.device
    rollouts = rollouts_lib.Rollouts(*(field.to(device) for field in rollouts))
    if self._communicator.any(not rollouts.is_finite())[0]:
      raise FloatingPointError(
        'The rollouts hold values that are not finite; the last checkpoint is '
        'unharmed: resume from it, with a lower learning rate if it recurs.'
      )
    samples = self._samples.make(rollouts)
    old_std = self.network.std.detach().clone()
    before = self.state()
    bounds = self._config.std_bounds(steps)
    try:
      metrics = self._fit(samples, bounds)
    except FloatingPointError:
      self.restore(before)
      raise
    kl = self._divergence(samples, old_std)
    self._adapt_learning_rate(kl, bounds[0])
    seen = rollouts.observations.flatten(0, 1)
    self.network.normaliser.update(seen, self._communicator)
    steps += len(seen) * self._communicator.size
    self.network.bound_std(*self._config.std_bounds(steps))
    mean = self._mean(metrics)
    mean['kl'] = kl
    mean['learning_rate'] = self.learning_rate
    mean['std'] = float(self.network.std.detach().mean())
    return mean

  def _mean(self, metrics: Sequence[Metrics]) -> dict[str, float]:
    """Returns the mean over minibatches and ranks of each metric."""
    means = [
      torch.stack([m[key] for m in metrics]).mean() for key in metrics[0]
    ]
    self._communicator.average(means)
    return {key: float(m) for key, m in zip(metrics[0], means, strict=True)}

  def _fit(
    self, samples: rollouts_lib.Samples, std_bounds: tuple[float, float]
  ) -> list[Metrics]:
    """Fits minibatches one by one; returns the metrics of each."""
    device, config = self.network.log_std.device, self._config
    orders = rollouts_lib.passes(
      len(samples.advantages), config, self._generator
    )
    batches = [
      ids
      for order in orders
      for ids in order.to(device).chunk(config.minibatches)
    ]
    both = self._threads.both(
      lambda: [self._fit_policy(samples, ids, std_bounds) for ids in batches],
      lambda: [self._fit_value(samples, ids) for ids in batches],
    )
    return [one | other for one, other in zip(*both, strict=True)]

  def _fit_policy(
    self,
    samples: rollouts_lib.Samples,
    ids: torch.Tensor,
    std_bounds: tuple[float, float],
  ) -> Metrics:
    config, network = self._config, self.network
    # Indexing takes four times as long.
    take = lambda field: field.index_select(0, ids)
    mean = network.mean(take(samples.observations))
    std = network.std
    surrogate, outside = losses.surrogate_loss(
      networks.log_prob(take(samples.actions), mean, std),
      take(samples.log_probs),
      take(samples.advantages),
      config.clip,
    )
    entropy = networks.entropy(std)
    loss = surrogate - config.entropy_coefficient * entropy
    metrics = {}
    if self._has_reference:
      drift = kickstarting.divergence(mean, std, take(samples.reference_means))
      loss = loss + config.kickstarting_weight * drift
      metrics['loss/kickstarting'] = drift.detach()
    norm = self._policy.step(loss)
    # Not clamped: outside its bounds the parameter needs its gradient.
    network.bound_std(*std_bounds)
    return {
      'loss/policy': surrogate.detach(),
      'loss/entropy': entropy.detach(),
      'clip_fraction': outside,
      'gradient_norm/policy': norm,
      **metrics,
    }

  def _fit_value(
    self, samples: rollouts_lib.Samples, ids: torch.Tensor
  ) -> Metrics:
    values = self.network.values(samples.observations.index_select(0, ids))
    loss = torch.mean((values - samples.targets.index_select(0, ids)) ** 2)
    norm = self._value.step(loss)
    return {'loss/value': loss.detach(), 'gradient_norm/value': norm}

  @torch.no_grad()
  def _divergence(
    self, samples: rollouts_lib.Samples, old_std: torch.Tensor
  ) -> float:
    """Returns the median of KL(old || new) over samples, nats.

    The mean would be dominated by a few samples of robots that tumble, where
    the policy is steep.
    """
    divergences = networks.kl_divergence(
      samples.means[::_KL_STRIDE],
      old_std,
      self._threads.map_rows(
        self.network.mean, samples.observations[::_KL_STRIDE]
      ),
      self.network.std,
    )
    return float(self._communicator.gather(divergences).median())

  def _adapt_learning_rate(self, kl: float, std_floor: float) -> None:
    """Adapts the learning rate to the KL divergence of an iteration."""
    config, rate = self._config, self.learning_rate
    if not config.target_kl:
      return
    # The KL measures steps in units of the standard deviation.
    scale = std_floor / config.std_floor.first
    if kl > 2 * config.target_kl:
      rate = max(rate / _LEARNING_RATE_STEP, config.min_learning_rate * scale)
    elif kl < config.target_kl / 2:
      rate = min(rate * _LEARNING_RATE_STEP, config.max_learning_rate * scale)
    self._set_learning_rate(rate)

  def state(self) -> dict[str, Any]:
    """Returns tensors by name: weights, normaliser, optimiser, generator."""
    state = {f'network/{k}': v for k, v in self.network.state_dict().items()}
    for name, part in self._parts():
      state |= {f'optimiser/{name}/{k}': v for k, v in part.state().items()}
    state['generator'] = self._generator.get_state()
    state['learning_rate'] = torch.tensor(
      self.learning_rate, dtype=torch.float64
    )
    return {key: value.clone() for key, value in state.items()}

  def restore(self, state: Mapping[str, torch.Tensor]) -> None:
    """Restores a `state`; raises ValueError when it is of another network."""
    try:
      self.network.load_state_dict(arrays.part_of(state, 'network/'))
    except RuntimeError as error:
      raise ValueError(
        f'The checkpoint is of another network: {error}'.replace('\n', ' ')
      ) from error
    for name, part in self._parts():
      part.restore(arrays.part_of(state, f'optimiser/{name}/'))
    self._generator.set_state(state['generator'])
    self._set_learning_rate(float(state['learning_rate']))

  def _parts(self) -> tuple[tuple[str, optimiser.Optimiser], ...]:
    return (('policy', self._policy), ('value', self._value))

  def _set_learning_rate(self, value: float) -> None:
    self.learning_rate = value
    for _, part in self._parts():
      part.set_learning_rate(value)
