"""Tests of dmc_multimode.agents.ppo.kickstarting."""

import dataclasses

import pytest
import torch

from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import rollouts

pytestmark = pytest.mark.usefixtures('one_thread')

_T, _B, _D, _A = 8, 32, 6, 2
_LATENTS = torch.tensor([[0.0, 0.0], [2.0, 2.0]])
_CONFIG = ppo_config.PPOConfig(
  hidden_sizes=(16,), epochs=4, learning_rate=3e-3, target_kl=0.0
)


def _network() -> networks.ActorCritic:
  torch.manual_seed(0)
  network = networks.ActorCritic(_D, _A, _CONFIG.hidden_sizes, 0.2)
  with torch.no_grad():  # Actions that depend on what is seen.
    networks.linears_of(network.policy)[-1].weight.mul_(50)
  return network


def _mode_of(raw: torch.Tensor) -> torch.Tensor:
  return (raw[:, 2] > 1).long()


def _observations(*shape: int) -> torch.Tensor:
  """Random ones, of which every other commands the second mode."""
  generator = torch.Generator().manual_seed(1)
  seen = torch.randn(*shape, _D, generator=generator)
  modes = torch.arange(shape[-1]) % 2
  seen[..., 2:4] = _LATENTS[modes]
  return seen


def test_divergence_and_its_gradient_by_hand() -> None:
  mean = torch.tensor([[1.0, 2.0], [5.0, 5.0]], requires_grad=True)
  std = torch.tensor([0.5, 1.0], requires_grad=True)
  reference = torch.tensor([[0.0, 0.0], [torch.nan, torch.nan]])
  found = kickstarting.divergence(mean, std, reference)
  # 0.5 (2^2 + 2^2) / 2 samples for the first, nothing for the second.
  assert found.item() == pytest.approx(2.0)
  found.backward()
  assert mean.grad is not None
  assert mean.grad.tolist() == [[2.0, 1.0], [0.0, 0.0]]  # (1, 2) / std^2 / 2.
  assert std.grad is None  # More noise is no way to be nearer.


def test_reference_knows_some_modes_and_stays_what_it_is() -> None:
  network = _network()
  reference = kickstarting.ReferencePolicy(network, _mode_of, [True, False])
  seen = _observations(8)
  expected = network.act(seen).detach()
  with torch.no_grad():
    for parameter in network.parameters():
      parameter.zero_()
  found = reference.means(seen)
  torch.testing.assert_close(found[::2], expected[::2])
  assert found[1::2].isnan().all()


@pytest.mark.parametrize('weight', [0.0, 30.0])
def test_known_mode_is_held_and_the_other_is_learned(weight: float) -> None:
  """The reward is for actions of 1, whatever is commanded."""
  network = _network()
  config = dataclasses.replace(_CONFIG, kickstarting_weight=weight)
  learner = learning.PPOLearner(
    network,
    config,
    seed=0,
    reference=kickstarting.ReferencePolicy(network, _mode_of, [True, False]),
  )
  seen = _observations(_T, _B)
  before = network.act(seen).detach()
  for seed in range(30):
    metrics = learner.step(_rollouts(network, seen, seed), 0)
  moved = (network.act(seen).detach() - before).abs().mean(dim=(0, 2))
  assert moved[1::2].mean() > 0.2
  if weight:
    assert moved[::2].mean() < 0.1
    assert 0 < metrics['loss/kickstarting'] < 1
  else:
    assert moved[::2].mean() > 0.2


def _rollouts(
  network: networks.ActorCritic, seen: torch.Tensor, seed: int
) -> rollouts.Rollouts:
  generator = torch.Generator().manual_seed(seed)
  with torch.no_grad():
    means = network.act(seen)
    noise = torch.randn(means.shape, generator=generator)
    actions = means + network.std * noise
    log_probs = networks.log_prob(actions, means, network.std)
  return rollouts.Rollouts(
    seen,
    actions,
    log_probs,
    means,
    -(actions - 1).square().sum(dim=-1),
    torch.zeros(_T, _B),
    torch.ones(_T, _B, dtype=torch.bool),
    seen,
  )
