"""Tests of dmc_multimode.agents.ppo.networks."""

from typing import Any, Callable

import numpy as np
import pytest
import torch
from torch import nn

from dmc_multimode.agents.ppo import networks


def _equal(found: torch.Tensor, expected: torch.Tensor) -> None:
  torch.testing.assert_close(found, expected, rtol=0.0, atol=0.0)


def test_running_moments_are_numpys() -> None:
  rng = np.random.RandomState(0)
  scale, offset = np.array([0.1, 1.0, 30.0]), np.array([5.0, 0.0, -100.0])
  batches = [
    (offset + scale * (rng.standard_normal((n, 3)) + i)).astype(np.float32)
    for i, n in enumerate((1, 64, 7, 500, 32))
  ]
  normaliser = networks.Normaliser(3)
  seen = torch.tensor([[0.5, -2.0, 3.0]])  # The identity at first.
  torch.testing.assert_close(normaliser(seen), seen, rtol=1e-4, atol=0.0)
  for batch in batches:
    normaliser.update(torch.from_numpy(batch))
  every = np.concatenate(batches).astype(np.float64)
  np.testing.assert_allclose(normaliser.mean, every.mean(axis=0), rtol=1e-5)
  np.testing.assert_allclose(normaliser.variance, every.var(axis=0), rtol=1e-4)
  assert normaliser.count.item() == len(every)
  np.testing.assert_allclose(
    normaliser(torch.from_numpy(batches[3])),
    (batches[3] - every.mean(axis=0)) / np.sqrt(every.var(axis=0) + 1e-4),
    atol=1e-3,
  )


def test_constants_and_outliers_stay_bounded() -> None:
  normaliser = networks.Normaliser(2)
  normaliser.update(torch.tensor([[1.0, 0.0], [1.0, 1.0]]))
  seen = torch.tensor([[1.0, 0.5], [1.001, 1e9], [1.0, -1e9]])
  kept = seen.clone()
  expected = torch.tensor([[0.0, 0.0], [0.1, 8.0], [0.0, -8.0]])
  torch.testing.assert_close(normaliser(seen), expected, atol=1e-3, rtol=0.0)
  _equal(seen, kept)  # Observations are left alone.


def test_initial_action() -> None:
  action = np.linspace(-1.0, 1.0, 3)
  network = networks.ActorCritic(6, 3, (32, 16), initial_action=action)
  seen = torch.randn(100, 6, generator=torch.Generator().manual_seed(0))
  found = network.act(seen).detach().numpy()
  np.testing.assert_allclose(found, np.tile(action, (100, 1)), atol=0.1)
  assert found.std(axis=0).min() > 0.0
  network = networks.ActorCritic(6, 3, (32,))  # Zero by default.
  assert network.act(torch.ones(1, 6)).abs().max().item() < 0.1


def test_orthogonal_initialisation() -> None:
  network = networks.ActorCritic(12, 3, (10, 8))
  for part, output, output_gain in (
    (network.policy, 3, 0.01),
    (network.value, 1, 1.0),
  ):
    linears = networks.linears_of(part)
    assert [linear.out_features for linear in linears] == [10, 8, output]
    gains = (2**0.5, 2**0.5, output_gain)
    for linear, gain in zip(linears, gains, strict=True):
      # Every layer narrows, so that its rows are orthogonal.
      rows = linear.weight @ linear.weight.T
      expected = gain**2 * torch.eye(len(rows))
      torch.testing.assert_close(rows, expected, atol=1e-5, rtol=0.0)
      assert not linear.bias.any()


@pytest.mark.parametrize(
  ('name', 'function'),
  [
    ('elu', torch.nn.functional.elu),
    ('silu', torch.nn.functional.silu),
    ('tanh', torch.tanh),
  ],
)
def test_activation(
  name: str, function: Callable[[torch.Tensor], torch.Tensor]
) -> None:
  network = networks.ActorCritic(5, 2, (4, 3), activation=name)
  assert network.activation == name
  observation = torch.randn(6, 5)
  for perceptron in (network.policy, network.value):
    first, second, output = networks.linears_of(perceptron)
    expected = output(function(second(function(first(observation)))))
    torch.testing.assert_close(perceptron(observation), expected)


@pytest.mark.parametrize(
  ('part', 'module', 'message'),
  [
    (
      'policy',
      nn.Linear(5, 3),
      r'maps \[N, 5\] to \[N, 2\].* returns \(2, 3\)',
    ),
    ('policy', nn.Linear(4, 2), 'Linear for N = 2 fails: '),
    ('policy', nn.LSTM(5, 2), 'LSTM for N = 2 fails: '),
    ('policy', lambda x: x[..., :2], r'function for N = 2 returns \(2, 2\)'),
    ('value', nn.Flatten(0), r'maps \[N, 8\] to \[N, 1\]'),
  ],
)
def test_modules_refused(part: str, module: Any, message: str) -> None:
  with pytest.raises(ValueError, match=f'{part} must be.*{message}') as error:
    networks.ActorCritic(5, 2, (4,), privileged_size=3, **{part: module})
  assert '\n' not in str(error.value)


def test_modules_of_ones_own() -> None:
  """Trying them changes no statistics, and an empty module is one."""
  norm = nn.BatchNorm1d(5)
  policy = nn.Sequential(norm, nn.Linear(5, 2))
  network = networks.ActorCritic(5, 2, (4,), policy=policy)
  assert norm.training and not norm.num_batches_tracked
  assert network.own_modules((4,)) == {'policy': 'Sequential'}
  network = networks.ActorCritic(2, 2, (4,), policy=nn.Sequential())
  torch.testing.assert_close(network.mean(torch.ones(1, 2)), torch.ones(1, 2))
  assert networks.ActorCritic(2, 2, (4,)).own_modules((4,)) == {}


def test_std() -> None:
  network = networks.ActorCritic(2, 3, (4,), initial_std=0.25)
  torch.testing.assert_close(network.std, torch.full((3,), 0.25))
  with torch.no_grad():
    network.log_std.copy_(torch.log(torch.tensor([0.02, 0.1, 0.7])))
  network.bound_std(0.1, 0.5)
  torch.testing.assert_close(network.std, torch.tensor([0.1, 0.1, 0.5]))


# Four numbers for the policy, and three more for the value.


@pytest.fixture
def network() -> networks.ActorCritic:
  """Network whose normaliser has statistics that differ by entry."""
  torch.manual_seed(0)
  network = networks.ActorCritic(4, 2, (8,), privileged_size=3)
  network.normaliser.update(_observations(200))
  return network


def _observations(count: int) -> torch.Tensor:
  scale = torch.tensor([0.1, 1.0, 5.0, 2.0, 30.0, 0.3, 7.0])
  generator = torch.Generator().manual_seed(count)
  return 3 * scale + scale * torch.randn(count, 7, generator=generator)


@torch.no_grad()
def test_acting_does_without_what_is_privileged(
  network: networks.ActorCritic,
) -> None:
  seen = _observations(50)
  expected = network.act(seen)
  other = seen.clone()
  other[:, 4:] = np.nan
  _equal(network.act(other), expected)
  _equal(network.act(seen[:, :4]), expected)
  normalised = network.normaliser(seen)
  _equal(network.normaliser(seen[:, :4]), normalised[:, :4])
  torch.testing.assert_close(network.mean(normalised), expected)
