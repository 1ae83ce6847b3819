"""Tests of dmc_multimode.agents.ppo.losses, and of Gaussians."""

import numpy as np
import pytest
import torch
from torch import distributions

from dmc_multimode.agents.ppo import losses
from dmc_multimode.agents.ppo import networks


def _column(*values: float) -> torch.Tensor:
  """T steps of one world, [T, 1]."""
  return torch.tensor(values, dtype=torch.float64)[:, None]


@pytest.mark.parametrize(
  ('discounts', 'last', 'expected'),
  [
    # gamma = lambda = 0.5; the errors are 1, 1.75 and 2.5 without an end.
    ((0.5, 0.5, 0.5), (False, False, False), (1.59375, 2.375, 2.5)),
    # Terminated.
    ((0.5, 0.0, 0.5), (False, True, False), (1.25, 1.0, 2.5)),
    # A time limit: bootstrapped from what was seen last, and nothing flows
    # across.
    ((0.5, 0.5, 0.5), (False, True, False), (1.4375, 1.75, 2.5)),
    ((0.5, 0.5, 0.5), (False, False, True), (1.59375, 2.375, 2.5)),
  ],
)
def test_advantages_by_hand(
  discounts: tuple[float, ...],
  last: tuple[bool, ...],
  expected: tuple[float, ...],
) -> None:
  found = losses.generalised_advantages(
    _column(1.0, 2.0, 3.0),
    _column(0.5, 1.0, 1.5),
    _column(1.0, 1.5, 2.0),
    _column(*discounts),
    torch.tensor(last)[:, None],
    0.5,
  )
  assert tuple(found[:, 0].tolist()) == expected


def test_advantages_are_normalised_over_all_or_by_group() -> None:
  found = losses.normalised(torch.tensor([1.0, 2.0, 3.0]))
  torch.testing.assert_close(found, torch.tensor([-1.0, 0.0, 1.0]))
  advantages = torch.tensor([1.0, 40.0, 2.0, 20.0, 3.0, 7.0])
  kept = advantages.clone()
  groups = torch.tensor([5, 0, 5, 0, 5, 2])
  found = losses.normalised(advantages, groups)
  # Of two, half of their difference over the difference by sqrt 2; of one,
  # nothing is known.
  half = 0.5**0.5
  expected = torch.tensor([-1.0, half, 0.0, -half, 1.0, 0.0])
  torch.testing.assert_close(found, expected)
  assert torch.equal(advantages, kept)
  for same in (None, torch.tensor([0, 0, 1, 1])):  # Which stay finite.
    found = losses.normalised(torch.full((4,), 7.0), same)
    torch.testing.assert_close(found, torch.zeros(4))


@pytest.mark.parametrize(
  ('ratio', 'advantage', 'surrogate', 'moves'),
  # Moves: the gradient still moves the policy.
  [
    (1.5, 1.0, 1.2, False),
    (0.5, 1.0, 0.5, True),
    (1.5, -1.0, -1.5, True),
    (0.5, -1.0, -0.8, False),
    (1.1, 2.0, 2.2, True),
    (0.9, -2.0, -1.8, True),
  ],
)
def test_clipped_surrogate(
  ratio: float, advantage: float, surrogate: float, moves: bool
) -> None:
  log_prob = torch.tensor([np.log(ratio) - 3.0], requires_grad=True)
  loss, outside = losses.surrogate_loss(
    log_prob, torch.tensor([-3.0]), torch.tensor([advantage]), clip=0.2
  )
  assert loss.item() == pytest.approx(-surrogate, abs=1e-5)
  assert outside.item() == float(abs(ratio - 1) > 0.2)
  (gradient,) = torch.autograd.grad(loss, log_prob)
  expected = -ratio * advantage if moves else 0.0
  assert gradient.item() == pytest.approx(expected, abs=1e-5)


def test_surrogate_is_a_mean_over_the_batch() -> None:
  loss, outside = losses.surrogate_loss(
    torch.log(torch.tensor([1.5, 0.5, 1.1])),
    torch.zeros(3),
    torch.tensor([1.0, 1.0, 1.0]),
    clip=0.2,
  )
  assert loss.item() == pytest.approx(-(1.2 + 0.5 + 1.1) / 3)
  assert outside.item() == pytest.approx(2 / 3)


def test_gaussians_are_torchs() -> None:
  generator = torch.Generator().manual_seed(0)
  normal = lambda *shape: torch.randn(
    *shape, generator=generator, dtype=torch.float64
  )
  mean, new_mean, action = normal(3, 7, 5)
  std, new_std = normal(2, 5).exp()
  make = lambda mean, std: distributions.Independent(
    distributions.Normal(mean, std), 1
  )
  old, new = make(mean, std), make(new_mean, new_std)
  check = torch.testing.assert_close
  check(networks.log_prob(action, mean, std), old.log_prob(action))
  check(networks.entropy(std), old.entropy()[0])
  check(
    networks.kl_divergence(mean, std, new_mean, new_std),
    distributions.kl_divergence(old, new),
  )
