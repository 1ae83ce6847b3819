"""Gaussian policy, value function and observation normaliser."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from dmc_multimode.agents import distributed

_VARIANCE_FLOOR = 1e-4
ACTIVATIONS = {'elu': nn.ELU, 'silu': nn.SiLU, 'tanh': nn.Tanh}
_CLIP = 8.0  # Normalised observations are clipped to this many sigmas.


class Normaliser(nn.Module):
  """Running mean and variance of the observations (Welford, by batches)."""

  mean: torch.Tensor
  variance: torch.Tensor
  count: torch.Tensor

  def __init__(self, size: int):
    """Starts as the identity for observations of `size` numbers."""
    super().__init__()
    self.register_buffer('mean', torch.zeros(size))
    self.register_buffer('variance', torch.ones(size))
    self.register_buffer('count', torch.zeros((), dtype=torch.float64))

  def forward(self, observation: torch.Tensor) -> torch.Tensor:
    """Normalises observations [..., D], or their first entries."""
    size = observation.shape[-1]
    scale = torch.rsqrt(self.variance[:size] + _VARIANCE_FLOOR)
    return ((observation - self.mean[:size]) * scale).clamp_(-_CLIP, _CLIP)

  @torch.no_grad()
  def update(
    self,
    observations: torch.Tensor,
    communicator: distributed.Communicator = distributed.LOCAL,
  ) -> None:
    """Updates the statistics by observations [N, D] (Chan et al. 1979).

    Args:
      observations: of this rank; every rank has as many.
      communicator: of the ranks whose batches count together.
    """
    added = observations.shape[0] * communicator.size
    total = self.count + added
    share = float(added / total)
    # `var_mean` takes ten times as long.
    mean = observations.mean(dim=0)
    variance = (observations - mean).square().mean(dim=0)
    own_mean = mean.clone()
    communicator.average([mean])
    variance += (own_mean - mean) ** 2
    communicator.average([variance])
    delta = mean - self.mean
    self.variance.lerp_(variance, share)
    self.variance.add_(delta**2 * (share * (1 - share)))
    self.mean.add_(delta * share)
    self.count.copy_(total)


def mlp(sizes: tuple[int, ...], activation: str = 'elu') -> nn.Sequential:
  """Returns a multi-layer perceptron; `activation` is in `ACTIVATIONS`."""
  layers: list[nn.Module] = []
  for i, (fan_in, fan_out) in enumerate(zip(sizes, sizes[1:], strict=False)):
    if i:
      layers.append(ACTIVATIONS[activation]())
    layers.append(nn.Linear(fan_in, fan_out))
  return nn.Sequential(*layers)


def linears_of(network: nn.Module) -> list[nn.Linear]:
  """Returns the linear layers of a network, in order."""
  return [m for m in network.modules() if isinstance(m, nn.Linear)]


def initialise(network: nn.Sequential, gain: float) -> None:
  """Makes weights orthogonal, those of the last layer with `gain`."""
  *hidden, output = linears_of(network)
  for linear in (*hidden, output):
    nn.init.orthogonal_(linear.weight, gain if linear is output else 2**0.5)
    nn.init.zeros_(linear.bias)


class ActorCritic(nn.Module):
  """pi(a | o) = N(mean(o), std^2) and v(o, p), two separate networks.

  Privileged observations p, if any, follow the observation o in one vector;
  only the value function sees them, and acting does not need them.
  """

  def __init__(
    self,
    observation_size: int,
    action_size: int,
    hidden_sizes: tuple[int, ...],
    initial_std: float = 0.25,
    initial_action: np.ndarray | None = None,
    privileged_size: int = 0,
    activation: str = 'elu',
    policy: nn.Module | None = None,
    value: nn.Module | None = None,
  ):
    """Initialises orthogonally; first actions are near `initial_action`.

    Args:
      observation_size: D, without privileged observations.
      action_size: A.
      hidden_sizes: of both networks.
      initial_std: of the actions.
      initial_action: mean action of the untrained policy, [A]; zero if None.
      privileged_size: P, length of the privileged observations.
      activation: of the hidden layers, a name in `ACTIVATIONS`.
      policy: module from normalised observations [N, D] to mean actions [N, A];
        an initialised multi-layer perceptron if None.
      value: likewise, from [N, D + P] to [N, 1]; shares no weights.

    Raises:
      ValueError: `policy` or `value` is no such module.
    """
    super().__init__()
    self.observation_size = observation_size
    self.privileged_size = privileged_size
    self.normaliser = Normaliser(observation_size + privileged_size)
    self.activation = activation
    mlps = (
      mlp((observation_size, *hidden_sizes, action_size), activation),
      mlp((observation_size + privileged_size, *hidden_sizes, 1), activation),
    )
    self.policy = mlps[0] if policy is None else policy
    self.value = mlps[1] if value is None else value
    self.log_std = nn.Parameter(
      torch.full((action_size,), float(np.log(initial_std)))
    )
    for network, gain in zip(mlps, (0.01, 1.0), strict=True):
      initialise(network, gain)
    if initial_action is not None:
      output = linears_of(mlps[0])[-1]
      output.bias.data.copy_(torch.as_tensor(initial_action))
    if policy is not None or value is not None:
      self.check()

  @torch.no_grad()
  def check(self) -> None:
    """Tries policy and value on two observations.

    Raises:
      ValueError: in one line, one of them is no module, fails, or returns
        another shape.
    """
    size, more = self.observation_size, self.privileged_size
    training = {module: module.training for module in self.modules()}
    self.eval()
    for name, length, expected in (
      ('policy', size, len(self.log_std)),
      ('value', size + more, 1),
    ):
      part: Any = getattr(self, name, None)
      seen = torch.zeros(2, length, device=self.log_std.device)
      try:
        found = f'returns {tuple(part(seen).shape)}'
      except Exception as error:  # Of a module that is not ours.
        found = f'fails: {" ".join(str(error).split())}'
      if found != f'returns {(2, expected)}' or not isinstance(part, nn.Module):
        raise ValueError(
          f'{name} must be a torch module that maps [N, {length}] to '
          f'[N, {expected}]; {type(part).__name__} for N = 2 {found}'
        )
    for module, was in training.items():
      module.training = was

  def own_modules(self, hidden_sizes: tuple[int, ...]) -> dict[str, str]:
    """Returns the classes of parts that are no perceptrons, by their names.

    Args:
      hidden_sizes: of the perceptrons.
    """
    if type(self) is not ActorCritic:
      return {'network': type(self).__name__}
    with torch.device('meta'):  # Allocates no memory.
      plain = ActorCritic(
        self.observation_size,
        len(self.log_std),
        hidden_sizes,
        privileged_size=self.privileged_size,
        activation=self.activation,
      )
    return {
      name: type(getattr(self, name)).__name__
      for name in ('policy', 'value')
      if _layers(getattr(self, name)) != _layers(getattr(plain, name))
    }

  @property
  def std(self) -> torch.Tensor:
    """Standard deviation of the actions, [A]."""
    return self.log_std.exp()

  @torch.no_grad()
  def bound_std(self, least: float, largest: float) -> None:
    """Clamps the standard deviation of every action, in place."""
    self.log_std.clamp_(math.log(least), math.log(largest))

  def act(self, observation: torch.Tensor) -> torch.Tensor:
    """Returns the mean actions for raw observations [..., D], [..., A].

    Privileged observations may follow and are ignored.

    Raises:
      ValueError: observations have another length.
    """
    size, length = self.observation_size, observation.shape[-1]
    if length not in (size, size + self.privileged_size):
      more = f', or {size + self.privileged_size} with the privileged ones'
      raise ValueError(
        f'an observation has {size} numbers'
        f'{more if self.privileged_size else ""}, got {length}: worlds of this '
        "policy are make_worlds(policy, ...), those of a name are a mode set's"
      )
    seen = observation[..., : self.observation_size]
    return self.policy(self.normaliser(seen))

  def mean(self, seen: torch.Tensor) -> torch.Tensor:
    """Returns the mean actions for normalised [..., D + P], [..., A]."""
    return self.policy(seen[..., : self.observation_size])

  def values(self, seen: torch.Tensor) -> torch.Tensor:
    """Returns the values of normalised [..., D + P], [...]."""
    return self.value(seen).squeeze(-1)


def _layers(network: nn.Module) -> list[tuple[Any, ...]]:
  """Returns class and sizes of every module in a network."""
  return [
    (type(module), *(tuple(p.shape) for p in module.parameters(recurse=False)))
    for module in network.modules()
  ]


class Sample(NamedTuple):
  """Actions [B, A], their log-probabilities [B] and means [B, A]."""

  action: torch.Tensor
  log_prob: torch.Tensor
  mean: torch.Tensor


def log_prob(
  action: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
) -> torch.Tensor:
  """Log-density of diagonal Gaussians, [B, A] -> [B]."""
  z = (action - mean) * std.reciprocal()
  constant = torch.log(std).sum() + 0.5 * math.log(2 * math.pi) * len(std)
  return -0.5 * z.square().sum(dim=-1) - constant


def entropy(std: torch.Tensor) -> torch.Tensor:
  """Entropy of a diagonal Gaussian with `std` [A], in nats."""
  return (torch.log(std) + 0.5 * math.log(2 * math.pi * math.e)).sum()


def kl_divergence(
  mean: torch.Tensor,
  std: torch.Tensor,
  new_mean: torch.Tensor,
  new_std: torch.Tensor,
) -> torch.Tensor:
  """KL(old || new) of diagonal Gaussians, [B, A] -> [B]."""
  ratio = (std / new_std) ** 2
  shift = ((mean - new_mean) / new_std) ** 2
  return 0.5 * (ratio + shift - 1 - torch.log(ratio)).sum(dim=-1)
