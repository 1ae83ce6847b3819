"""The PPO learner: one step is one iteration over one batch of rollouts."""

import functools
import math
from typing import Any, Iterator, Mapping, NamedTuple

import torch
from torch import nn

from dmc_multimode.agents.ppo import config as config_lib
from dmc_multimode.agents.ppo import losses
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import symmetry

_LEARNING_RATE_STEP = 1.2  # Factor of each adaptation.
_KL_STRIDE = 8  # Every so many samples enter the estimate of the KL.


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
  """Flat training samples, [N, ...]; observations are normalised."""

  observations: torch.Tensor
  actions: torch.Tensor
  log_probs: torch.Tensor
  means: torch.Tensor
  advantages: torch.Tensor
  targets: torch.Tensor

  def rows(self, ids: torch.Tensor | slice) -> '_Samples':
    return _Samples(*(field[ids] for field in self))


class PPOLearner:
  """Updates an `ActorCritic` in place."""

  def __init__(
    self,
    network: networks.ActorCritic,
    config: config_lib.PPOConfig,
    seed: int,
    mirror: symmetry.Mirror | None = None,
    commands: symmetry.Commands | None = None,
  ):
    """Creates the optimiser.

    Args:
      network: what is learned.
      config: hyperparameters.
      seed: of the minibatches.
      mirror: needed where `config.symmetry` is not 'none'.
      commands: needed where `config.advantages` is 'mode'.

    Raises:
      ValueError: symmetry is asked for without a mirror.
    """
    if config.symmetry != 'none' and mirror is None:
      raise ValueError('symmetry needs an environment that knows its mirror.')
    if config.advantages == 'mode' and commands is None:
      raise ValueError('advantages by mode need the latents of the modes.')
    self.network = network
    self._config = config
    self._mirror = mirror if config.symmetry != 'none' else None
    self._commands = commands
    self._generator = torch.Generator().manual_seed(seed)
    network.log_std.requires_grad_(config.learn_std)
    self._parameters = [p for p in network.parameters() if p.requires_grad]
    self._optimiser = torch.optim.Adam(
      self._parameters, lr=config.learning_rate, eps=1e-5, fused=True
    )
    self.learning_rate = config.learning_rate

  def step(self, rollouts: Rollouts) -> dict[str, float]:
    """Learns from one iteration's rollouts; returns metrics by name.

    Raises:
      FloatingPointError: the rollouts or the update are not finite; the
        network is left as it was before this step.
    """
    numbers = [field for field in rollouts if field.is_floating_point()]
    if not all(torch.isfinite(field).all() for field in numbers):
      raise FloatingPointError(
        'The rollouts hold values that are not finite; the last checkpoint is '
        'unharmed: resume from it, with a lower learning rate if it recurs.'
      )
    samples = self._prepare(rollouts)
    old_std = self.network.std.detach().clone()
    before = self.state()
    try:
      metrics = self._epochs(samples)
    except FloatingPointError:
      self.restore(before)
      raise
    kl = self._divergence(samples, old_std)
    self._adapt_learning_rate(kl)
    self.network.normaliser.update(rollouts.observations.flatten(0, 1))
    self._lower_std_floor()
    mean = {
      key: float(torch.stack([m[key] for m in metrics]).mean())
      for key in metrics[0]
    }
    mean['kl'] = kl
    mean['learning_rate'] = self.learning_rate
    mean['std'] = float(self.network.std.detach().mean())
    return mean

  def _epochs(self, samples: _Samples) -> list[dict[str, torch.Tensor]]:
    """Passes over the samples; returns the metrics of every minibatch."""
    metrics = []
    for order in self._orders(len(samples.advantages)):
      for ids in order.chunk(self._config.minibatches):
        metrics.append(self._update(samples.rows(ids)))
    return metrics

  def _orders(self, count: int) -> Iterator[torch.Tensor]:
    """Yields, for every pass, which of `count` samples it takes, in order."""
    shuffle = functools.partial(torch.randperm, generator=self._generator)
    if self._config.symmetry != 'alternate':
      for _ in range(self._config.epochs):
        yield shuffle(count)
      return
    half = count // 2  # The images follow the originals.
    side = torch.zeros(half, dtype=torch.int64)
    for epoch in range(self._config.epochs):
      if epoch % 2 == 0:
        side.random_(0, 2, generator=self._generator)
      else:
        side = 1 - side
      order = shuffle(half)
      yield order + half * side[order]

  @torch.no_grad()
  def _prepare(self, rollouts: Rollouts) -> _Samples:
    """Computes advantages and targets; flattens; adds mirror images."""
    config, network = self._config, self.network
    seen = network.normaliser(rollouts.observations)
    values = network.values(seen)
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
    samples = _Samples(
      seen.flatten(0, 1),
      rollouts.actions.flatten(0, 1),
      rollouts.log_probs.flatten(),
      rollouts.means.flatten(0, 1),
      advantages.flatten(),
      (advantages + values).flatten(),
    )
    groups = None
    if config.advantages == 'mode':
      assert self._commands is not None  # So says the constructor.
      groups = self._commands.modes(rollouts.observations.flatten(0, 1))
    samples = samples._replace(
      advantages=losses.normalised(samples.advantages, groups)
    )
    return self._with_mirror_images(samples, rollouts)

  def _next_values(
    self, rollouts: Rollouts, values: torch.Tensor
  ) -> torch.Tensor:
    """Values after each step: the following ones but where an episode ended."""
    next_values = torch.empty_like(values)
    next_values[:-1] = values[1:]
    cut = rollouts.last.clone()
    cut[-1] = True
    ends = self.network.normaliser(rollouts.next_observations[cut])
    next_values[cut] = self.network.values(ends)
    return next_values

  def _with_mirror_images(
    self, samples: _Samples, rollouts: Rollouts
  ) -> _Samples:
    if self._mirror is None:
      return samples
    raw = self._mirror.observations(rollouts.observations.flatten(0, 1))
    image = samples._replace(
      observations=self.network.normaliser(raw),
      actions=self._mirror.actions(samples.actions),
      means=self._mirror.actions(samples.means),
    )
    return _Samples(
      *(torch.cat(pair) for pair in zip(samples, image, strict=True))
    )

  def _update(self, batch: _Samples) -> dict[str, torch.Tensor]:
    config, network = self._config, self.network
    mean = network.mean(batch.observations)
    std = network.std
    terms = losses.ppo_losses(
      networks.log_prob(batch.actions, mean, std),
      batch.log_probs,
      batch.advantages,
      network.values(batch.observations),
      batch.targets,
      std,
      config.clip,
    )
    loss = (
      terms.policy
      + config.value_coefficient * terms.value
      - config.entropy_coefficient * terms.entropy
    )
    self._optimiser.zero_grad(set_to_none=True)
    loss.backward()
    norm = nn.utils.clip_grad_norm_(self._parameters, config.max_gradient_norm)
    if not math.isfinite(norm):
      raise FloatingPointError(
        'A gradient is not finite; the last checkpoint is unharmed: resume '
        'from it, with a lower learning rate if it recurs.'
      )
    self._optimiser.step()
    return {
      'loss/policy': terms.policy.detach(),
      'loss/value': terms.value.detach(),
      'loss/entropy': terms.entropy.detach(),
      'clip_fraction': terms.clip_fraction,
      'gradient_norm': norm,
    }

  @torch.no_grad()
  def _divergence(self, samples: _Samples, old_std: torch.Tensor) -> float:
    """How far this step moved the policy: mean KL(old || new)."""
    probe = samples.rows(slice(None, None, _KL_STRIDE))
    return float(
      networks.kl_divergence(
        probe.means,
        old_std,
        self.network.mean(probe.observations),
        self.network.std,
      ).mean()
    )

  def _lower_std_floor(self) -> None:
    """Follows the floor's schedule by the steps that were learned from."""
    steps = int(self.network.normaliser.count)
    self.network.min_std = self._config.std_floor(steps)

  def _adapt_learning_rate(self, kl: float) -> None:
    """Holds the KL divergence of an iteration near its target."""
    config, rate = self._config, self.learning_rate
    if not config.target_kl:
      return
    if kl > 2 * config.target_kl:
      rate = max(rate / _LEARNING_RATE_STEP, config.min_learning_rate)
    elif kl < config.target_kl / 2:
      rate = min(rate * _LEARNING_RATE_STEP, config.max_learning_rate)
    self._set_learning_rate(rate)

  def state(self) -> dict[str, Any]:
    """Returns tensors by name: weights, normaliser, optimiser, generator."""
    state = {f'network/{k}': v for k, v in self.network.state_dict().items()}
    for i, p in enumerate(self._parameters):
      for key, value in self._optimiser.state.get(p, {}).items():
        state[f'optimiser/{i}/{key}'] = value
    state['generator'] = self._generator.get_state()
    state['learning_rate'] = torch.tensor(
      self.learning_rate, dtype=torch.float64
    )
    return {key: value.clone() for key, value in state.items()}

  def restore(self, state: Mapping[str, torch.Tensor]) -> None:
    """Takes over a `state`; raises ValueError when it is of another network."""
    weights = {
      key.removeprefix('network/'): value
      for key, value in state.items()
      if key.startswith('network/')
    }
    try:
      self.network.load_state_dict(weights)
    except RuntimeError as error:
      raise ValueError(
        f'The checkpoint is of another network: {error}'.replace('\n', ' ')
      ) from error
    self._optimiser.state.clear()
    for i, p in enumerate(self._parameters):
      moments = {
        key.rpartition('/')[2]: value.clone()
        for key, value in state.items()
        if key.startswith(f'optimiser/{i}/')
      }
      if moments:
        self._optimiser.state[p] = moments
    self._lower_std_floor()
    self._generator.set_state(state['generator'])
    self._set_learning_rate(float(state['learning_rate']))

  def _set_learning_rate(self, value: float) -> None:
    self.learning_rate = value
    for group in self._optimiser.param_groups:
      group['lr'] = value
