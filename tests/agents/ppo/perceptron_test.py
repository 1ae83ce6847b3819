"""Tests of dmc_multimode.agents.ppo.perceptron."""

import copy
from typing import Sequence

import pytest
import torch
from torch import nn

from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import perceptron

pytestmark = pytest.mark.usefixtures('library')


def _network(*sizes: int, activation: str = 'silu') -> nn.Sequential:
  torch.manual_seed(0)
  return networks.mlp(sizes, activation)


def _rows(*shape: int) -> torch.Tensor:
  return torch.randn(*shape, generator=torch.Generator().manual_seed(1))


def _gradients(network: nn.Sequential) -> list[torch.Tensor | None]:
  return [parameter.grad for parameter in network.parameters()]


@pytest.mark.parametrize('count', [0, 1, 7, 300])
@pytest.mark.parametrize(
  'sizes', [(5, 3), (6, 1), (37, 256, 128, 10), (5, 16, 16, 8, 1)]
)
def test_values_and_gradients_are_torchs(
  sizes: Sequence[int], count: int
) -> None:
  network = _network(*sizes)
  torchs = copy.deepcopy(network)
  # A part of what is observed, as the policy sees it.
  rows = _rows(count, sizes[0] + 4)[:, : sizes[0]]
  weights = _rows(count, sizes[-1])
  expected = torchs(rows)
  (expected * weights).sum().backward()
  found = perceptron.apply(network, rows)
  (found * weights).sum().backward()
  torch.testing.assert_close(found, expected)
  torch.testing.assert_close(
    _gradients(network), _gradients(torchs), rtol=1e-4, atol=1e-4
  )


def test_it_is_what_runs() -> None:
  found = perceptron.apply(_network(5, 4, 2), _rows(3, 5))
  assert '_Perceptron' in type(found.grad_fn).__name__


@pytest.mark.parametrize(
  'rows',
  [_rows(5), _rows(2, 3, 5), _rows(3, 5).requires_grad_()],
  ids=['one', 'batches', 'gradients'],
)
def test_other_rows_are_left_to_torch(rows: torch.Tensor) -> None:
  network = _network(5, 4, 2)
  found = perceptron.apply(network, rows)
  assert torch.equal(found, network(rows))
  found.sum().backward()
  assert (rows.grad is not None) == rows.requires_grad


def test_double_precision_is_left_to_torch() -> None:
  network, rows = _network(5, 4, 2).double(), _rows(3, 5).double()
  assert torch.equal(perceptron.apply(network, rows), network(rows))


@pytest.mark.parametrize('activation', ['elu', 'tanh'])
def test_other_activations_are_left_to_torch(activation: str) -> None:
  network, rows = _network(5, 4, 2, activation=activation), _rows(3, 5)
  assert torch.equal(perceptron.apply(network, rows), network(rows))


def test_results_outlive_the_next_pass() -> None:
  network = _network(5, 4, 2)
  first = perceptron.apply(network, _rows(3, 5))
  kept = first.detach().clone()
  perceptron.apply(network, torch.zeros(3, 5))
  assert torch.equal(first, kept)


@pytest.mark.parametrize('inference', [False, True])
def test_a_pass_in_between_is_an_error(inference: bool) -> None:
  network = _network(5, 4, 2)
  loss = perceptron.apply(network, _rows(3, 5)).sum()
  with torch.inference_mode(inference):
    perceptron.apply(_network(5, 4, 2), _rows(3, 5))
  with pytest.raises(RuntimeError, match='overwritten'):
    loss.backward()


def test_passes_of_other_threads_do_not_disturb() -> None:
  network = _network(5, 4, 2)
  torchs = copy.deepcopy(network)
  loss = perceptron.apply(network, _rows(3, 5)).sum()
  threads = pair.Pair(parallel=True)
  threads.both(
    lambda: None, lambda: perceptron.apply(network, torch.zeros(9, 5))
  )
  loss.backward()
  torchs(_rows(3, 5)).sum().backward()
  torch.testing.assert_close(_gradients(network), _gradients(torchs))


def test_training_follows_inference() -> None:
  network = _network(5, 4, 2)

  def use() -> None:
    with torch.inference_mode():
      perceptron.apply(network, _rows(3, 5))
    perceptron.apply(network, _rows(3, 5)).sum().backward()

  pair.Pair(parallel=True).both(lambda: None, use)
  assert all(gradient is not None for gradient in _gradients(network))


def test_gradients_add_up() -> None:
  network = _network(5, 4, 2)
  torchs = copy.deepcopy(network)
  for count in (7, 2, 30):
    perceptron.apply(network, _rows(count, 5)).square().sum().backward()
    torchs(_rows(count, 5)).square().sum().backward()
  torch.testing.assert_close(_gradients(network), _gradients(torchs))


def test_only_what_needs_a_gradient_gets_one() -> None:
  network = _network(5, 4, 2).requires_grad_(False)
  assert not perceptron.apply(network, _rows(3, 5)).requires_grad
  network[0].bias.requires_grad_(True)
  perceptron.apply(network, _rows(3, 5)).sum().backward()
  first, *others = [p.grad is not None for p in network.parameters()]
  assert [first, *others] == [False, True, False, False]
