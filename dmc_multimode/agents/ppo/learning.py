"""The PPO learner: one step is one iteration over one batch of rollouts."""

import functools
import itertools
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

import torch

from dmc_multimode.agents import distributed
from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import descent
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import losses
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import symmetry

_LEARNING_RATE_STEP = 1.2  # Factor of each adaptation.
_KL_STRIDE = 8  # Every so many samples enter the estimate of the KL.

Metrics = dict[str, torch.Tensor]


class Rollouts(NamedTuple):
  """T steps of B worlds.

  Attributes:
    observations: raw, [T, B, D].
    actions: [T, B, A].
    log_probs: of the actions when they were taken, [T, B].
    means: of the policy then, [T, B, A].
    rewards: [T, B].
    discounts: environment discounts (0 where terminated), [T, B].
    last: whether an episode ended with the step, [T, B].
    next_observations: what the step led to before any reset, [T, B, D].
  """

  observations: torch.Tensor
  actions: torch.Tensor
  log_probs: torch.Tensor
  means: torch.Tensor
  rewards: torch.Tensor
  discounts: torch.Tensor
  last: torch.Tensor
  next_observations: torch.Tensor


class _Samples(NamedTuple):
  """Flat training samples, [N, ...]; observations are normalised.

  Where there is an anchor, `anchors` are its actions; without, [N, 0].
  """

  observations: torch.Tensor
  actions: torch.Tensor
  log_probs: torch.Tensor
  means: torch.Tensor
  advantages: torch.Tensor
  targets: torch.Tensor
  anchors: torch.Tensor


class PPOLearner:
  """Updates an `ActorCritic` in place.

  Policy and value function share nothing, so that each is fitted by itself, and
  two threads can fit both at once.

  Several ranks, each with rollouts of its own, learn one network: whatever is
  computed over samples is computed over those of all ranks, so that all hold
  the same network to the bit. Only minibatches are drawn by each for itself.
  """

  def __init__(
    self,
    network: networks.ActorCritic,
    config: ppo_config.PPOConfig,
    seed: int,
    mirror: symmetry.Mirror | None = None,
    commands: symmetry.Commands | None = None,
    threads: pair.Pair | None = None,
    communicator: distributed.Communicator = distributed.LOCAL,
    anchor: kickstarting.Anchor | None = None,
  ):
    """Creates the optimisers.

    Args:
      network: what is learned, where it is to be learned. What its normaliser
        has seen by now is no part of this training's schedules.
      config: hyperparameters.
      seed: of the minibatches.
      mirror: needed where `config.symmetry` is not 'none'.
      commands: needed where `config.advantages` is 'mode'.
      threads: fit policy and value function; this one alone by default.
      communicator: connects the ranks that learn this network.
      anchor: what to stay near to, as `config.anchor_weight` says, if anything.

    Raises:
      ValueError: symmetry is asked for without a mirror.
    """
    if config.symmetry != 'none' and mirror is None:
      raise ValueError('symmetry needs an environment that knows its mirror.')
    if config.advantages == 'mode' and commands is None:
      raise ValueError('advantages by mode need the latents of the modes.')
    self.network = network
    self._began = int(network.normaliser.count)
    self._config = config
    self._mirror = mirror if config.symmetry != 'none' else None
    self._commands = commands
    self._anchor = anchor
    self._generator = torch.Generator().manual_seed(seed)
    network.log_std.requires_grad_(config.learn_std)
    value = list(network.value.parameters())
    theirs = {id(parameter) for parameter in value}
    policy = [
      p for p in network.parameters() if p.requires_grad and id(p) not in theirs
    ]
    self._communicator = communicator
    self._policy = descent.Descent(policy, config, communicator)
    # A thread of its own must not come between the operations of this one.
    self._value = descent.Descent(value, config, communicator.split())
    self._threads = threads or pair.Pair()
    self.learning_rate = config.learning_rate
    network.bound_std(*self._std_bounds())

  def step(self, rollouts: Rollouts) -> dict[str, float]:
    """Learns from one iteration's rollouts; returns metrics by name.

    Raises:
      FloatingPointError: the rollouts or the update are not finite, at any
        rank; the network is left as it was before this step.
    """
    device = self.network.log_std.device
    rollouts = Rollouts(*(field.to(device) for field in rollouts))
    numbers = [field for field in rollouts if field.is_floating_point()]
    # A sum that is finite has finite parts, and is a tenth of the work.
    finite = all(
      torch.isfinite(field.sum()) or torch.isfinite(field).all()
      for field in numbers
    )
    if self._communicator.any(not finite)[0]:
      raise FloatingPointError(
        'The rollouts hold values that are not finite; the last checkpoint is '
        'unharmed: resume from it, with a lower learning rate if it recurs.'
      )
    samples = self._prepare(rollouts)
    old_std = self.network.std.detach().clone()
    before = self.state()
    orders = self._orders(len(samples.advantages))
    batches = list(
      itertools.chain.from_iterable(
        order.chunk(self._config.minibatches) for order in orders
      )
    )
    try:
      metrics = self._fit(samples, batches)
    except FloatingPointError:
      self.restore(before)
      raise
    kl = self._divergence(samples, old_std)
    self._adapt_learning_rate(kl)
    self.network.normaliser.update(
      rollouts.observations.flatten(0, 1), self._communicator
    )
    self.network.bound_std(*self._std_bounds())
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
    self, samples: _Samples, batches: Sequence[torch.Tensor]
  ) -> list[Metrics]:
    """Learns from minibatches in turn; returns the metrics of each."""
    both = self._threads.both(
      lambda: [self._fit_policy(samples, ids) for ids in batches],
      lambda: [self._fit_value(samples, ids) for ids in batches],
    )
    return [one | other for one, other in zip(*both, strict=True)]

  def _orders(self, count: int) -> Iterator[torch.Tensor]:
    """Yields, for every pass, which of `count` samples it takes, in order."""
    shuffle = functools.partial(torch.randperm, generator=self._generator)
    device = self.network.log_std.device
    if self._config.symmetry != 'alternate':
      for _ in range(self._config.epochs):
        yield shuffle(count).to(device)
      return
    half = count // 2  # The images follow the originals.
    side = torch.zeros(half, dtype=torch.int64)
    for epoch in range(self._config.epochs):
      if epoch % 2 == 0:
        side.random_(0, 2, generator=self._generator)
      else:
        side = 1 - side
      order = shuffle(half)
      yield (order + half * side[order]).to(device)

  @torch.no_grad()
  def _prepare(self, rollouts: Rollouts) -> _Samples:
    """Computes advantages and targets; flattens; adds mirror images."""
    config, network = self._config, self.network
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
    samples = _Samples(
      seen.flatten(0, 1),
      rollouts.actions.flatten(0, 1),
      rollouts.log_probs.flatten(),
      rollouts.means.flatten(0, 1),
      advantages.flatten(),
      (advantages + values).flatten(),
      self._anchors(raw),
    )
    groups = None
    if config.advantages == 'mode':
      assert self._commands is not None  # So says the constructor.
      groups = self._commands.modes(raw)
    # An action that was not drawn says nothing about the others.
    explored = (samples.actions != samples.means).any(dim=-1)
    samples = samples._replace(
      advantages=explored
      * losses.normalised(samples.advantages, groups, self._communicator)
    )
    return self._with_mirror_images(samples, raw)

  def _anchors(self, raw: torch.Tensor) -> torch.Tensor:
    """Returns the means to stay near to, for raw observations [N, D]."""
    return self._anchor.means(raw) if self._anchor else raw[:, :0]

  def _next_values(
    self, rollouts: Rollouts, values: torch.Tensor
  ) -> torch.Tensor:
    """Values after each step: the following ones but where an episode ended."""
    next_values = torch.empty_like(values)
    next_values[:-1] = values[1:]
    cut = rollouts.last.clone()
    cut[-1] = True
    ends = self.network.normaliser(rollouts.next_observations[cut])
    next_values[cut] = self._threads.map_rows(self.network.values, ends)
    return next_values

  def _with_mirror_images(
    self, samples: _Samples, raw: torch.Tensor
  ) -> _Samples:
    if self._mirror is None:
      return samples
    mirrored = self._mirror.observations(raw)
    image = samples._replace(
      observations=self.network.normaliser(mirrored),
      actions=self._mirror.actions(samples.actions),
      means=self._mirror.actions(samples.means),
      anchors=self._anchors(mirrored),
    )
    return _Samples(
      *(torch.cat(pair) for pair in zip(samples, image, strict=True))
    )

  def _fit_policy(self, samples: _Samples, ids: torch.Tensor) -> Metrics:
    config, network = self._config, self.network
    # Not by indexing, which takes four times as long.
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
    if self._anchor:
      drift = kickstarting.divergence(mean, std, take(samples.anchors))
      loss = loss + config.anchor_weight * drift
      metrics['loss/anchor'] = drift.detach()
    norm = self._policy.descend(loss)
    # The parameter itself: one that has left its bounds must feel the gradient.
    network.bound_std(*self._std_bounds())
    return {
      'loss/policy': surrogate.detach(),
      'loss/entropy': entropy.detach(),
      'clip_fraction': outside,
      'gradient_norm/policy': norm,
      **metrics,
    }

  def _fit_value(self, samples: _Samples, ids: torch.Tensor) -> Metrics:
    values = self.network.values(samples.observations.index_select(0, ids))
    loss = torch.mean((values - samples.targets.index_select(0, ids)) ** 2)
    norm = self._value.descend(loss)
    return {'loss/value': loss.detach(), 'gradient_norm/value': norm}

  @torch.no_grad()
  def _divergence(self, samples: _Samples, old_std: torch.Tensor) -> float:
    """How far this step moved the policy: median of KL(old || new).

    A few samples of robots that tumble, where the policy is steep and nothing
    is at stake, make up most of the mean.
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

  def _std_bounds(self) -> tuple[float, float]:
    """Bounds of the std by the steps that were learned from."""
    steps = int(self.network.normaliser.count) - self._began
    return self._config.std_bounds(steps)

  def _adapt_learning_rate(self, kl: float) -> None:
    """Holds the KL divergence of an iteration near its target."""
    config, rate = self._config, self.learning_rate
    if not config.target_kl:
      return
    # A step is as long as it is in standard deviations.
    scale = self._std_bounds()[0] / config.min_std
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
    """Takes over a `state`; raises ValueError when it is of another network."""
    try:
      self.network.load_state_dict(part_of(state, 'network/'))
    except RuntimeError as error:
      raise ValueError(
        f'The checkpoint is of another network: {error}'.replace('\n', ' ')
      ) from error
    for name, part in self._parts():
      part.restore(part_of(state, f'optimiser/{name}/'))
    self._generator.set_state(state['generator'])
    self._set_learning_rate(float(state['learning_rate']))

  def _parts(self) -> tuple[tuple[str, descent.Descent], ...]:
    return (('policy', self._policy), ('value', self._value))

  def _set_learning_rate(self, value: float) -> None:
    self.learning_rate = value
    for _, part in self._parts():
      part.set_learning_rate(value)


def part_of(
  state: Mapping[str, torch.Tensor], prefix: str
) -> dict[str, torch.Tensor]:
  """Returns what has names that begin with `prefix`, by the rest of them."""
  return {
    key.removeprefix(prefix): value
    for key, value in state.items()
    if key.startswith(prefix)
  }
