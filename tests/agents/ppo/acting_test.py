"""Tests of dmc_multimode.agents.ppo.acting."""

import numpy as np
import pytest
import torch

from dmc_multimode.agents import pair
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.utils import schedule

pytestmark = pytest.mark.usefixtures('one_thread')

_D, _A = 3, 2
_CONFIG = ppo_config.PPOConfig(
  hidden_sizes=(16,),
  deterministic_fraction=schedule.step(0.25, 1000),
  deterministic_steps=20,
)


def _network() -> networks.ActorCritic:
  torch.manual_seed(0)
  return networks.ActorCritic(_D, _A, _CONFIG.hidden_sizes, 0.2)


def test_exploration() -> None:
  network = _network()
  actor = acting.BatchedActor(network, 0)
  seen = torch.randn(2000, _D, generator=torch.Generator().manual_seed(0))
  sample = actor.sample(seen)
  noise = (sample.action - sample.mean) / network.std
  assert abs(noise.mean().item()) < 0.05
  assert noise.std().item() == pytest.approx(1.0, abs=0.05)
  expected = networks.log_prob(sample.action, sample.mean, network.std)
  torch.testing.assert_close(sample.log_prob, expected)
  np.testing.assert_array_equal(actor.select_action(seen.numpy()), sample.mean)
  other = acting.BatchedActor(network, 0, threads=pair.Pair(parallel=True))
  assert all(map(torch.equal, other.sample(seen), sample))


def _deterministic(
  actor: acting.BatchedActor, worlds: int, times: int
) -> torch.Tensor:
  """Which worlds took their mean action when, [T, B]."""
  seen = torch.ones(worlds, _D)
  samples = [actor.sample(seen, steps=1000) for _ in range(times)]
  return torch.stack([(s.action == s.mean).all(dim=1) for s in samples])


def test_fraction_and_length_of_deterministic_spells() -> None:
  found = _deterministic(acting.BatchedActor(_network(), 0, _CONFIG), 500, 600)
  settled = found[100:].float()
  assert settled.mean().item() == pytest.approx(0.25, abs=0.02)
  begins = (found[101:] & ~found[100:-1]).sum().item()
  assert settled.sum().item() / begins == pytest.approx(20, rel=0.1)
  # The others explore in every joint.
  assert not (found[0].all() or found[-1].all())


def test_all_explore_before_the_start() -> None:
  actor = acting.BatchedActor(_network(), 0, _CONFIG)
  other = acting.BatchedActor(_network(), 0)
  for _ in range(5):
    sample = actor.sample(torch.ones(500, _D), steps=999)
    assert (sample.action != sample.mean).all()
    same = other.sample(torch.ones(500, _D))
    assert all(map(torch.equal, sample, same))  # And the draws are the same.


def test_restored_actor_goes_on_exactly() -> None:
  first, second = (
    acting.BatchedActor(_network(), seed, _CONFIG) for seed in range(2)
  )
  _deterministic(first, 50, 30)
  second.restore(first.state())
  for _ in range(30):
    samples = [a.sample(torch.ones(50, _D), 1000) for a in (first, second)]
    assert all(map(torch.equal, *samples))
