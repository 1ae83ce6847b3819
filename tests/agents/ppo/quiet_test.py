"""Tests of worlds that take mean actions for a while."""

import dataclasses
from typing import Any

import pytest
import torch

from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks

pytestmark = pytest.mark.usefixtures('one_thread')

_T, _B, _D, _A = 4, 8, 3, 2
_CONFIG = ppo_config.PPOConfig(
  hidden_sizes=(16,), quiet_share=0.25, quiet_steps=20, quiet_start=1000
)


def _network() -> networks.ActorCritic:
  torch.manual_seed(0)
  return networks.ActorCritic(_D, _A, _CONFIG.hidden_sizes, 0.2)


def _quiet(actor: acting.BatchedActor, worlds: int, times: int) -> torch.Tensor:
  """Which worlds took their mean action when, [T, B]."""
  seen = torch.ones(worlds, _D)
  samples = [actor.sample(seen, steps=1000) for _ in range(times)]
  return torch.stack([(s.action == s.mean).all(dim=1) for s in samples])


def test_share_and_length_of_quiet_spells() -> None:
  quiet = _quiet(acting.BatchedActor(_network(), 0, _CONFIG), 500, 600)
  settled = quiet[100:].float()
  assert settled.mean().item() == pytest.approx(0.25, abs=0.02)
  begins = (quiet[101:] & ~quiet[100:-1]).sum().item()
  assert settled.sum().item() / begins == pytest.approx(20, rel=0.1)
  # What is not quiet explores in every joint.
  assert not (quiet[0].all() or quiet[-1].all())


def test_nobody_is_quiet_before_its_start() -> None:
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
  _quiet(first, 50, 30)
  second.restore(first.state())
  for _ in range(30):
    samples = [a.sample(torch.ones(50, _D), 1000) for a in (first, second)]
    assert all(map(torch.equal, *samples))


@pytest.mark.parametrize('is_quiet', [True, False])
def test_policy_learns_nothing_from_quiet_actions(is_quiet: bool) -> None:
  config = dataclasses.replace(_CONFIG, entropy_coefficient=0.0)
  network = _network()
  learner = learning.PPOLearner(network, config, 0)
  generator = torch.Generator().manual_seed(0)
  draw = lambda *shape: torch.randn(_T, _B, *shape, generator=generator)
  observations, noise = draw(_D), draw(_A)
  with torch.no_grad():
    means = network.act(observations)
  actions = means if is_quiet else means + 0.2 * noise
  policy, value = (
    [p.detach().clone() for p in part.parameters()]
    for part in (network.policy, network.value)
  )
  learner.step(
    learning.Rollouts(
      observations,
      actions,
      networks.log_prob(actions, means, network.std.detach()),
      means,
      draw(),
      torch.ones(_T, _B),
      torch.zeros(_T, _B, dtype=torch.bool),
      draw(_D),
    )
  )
  moved = lambda before, part: (
    not all(map(torch.equal, before, part.parameters()))
  )
  assert moved(policy, network.policy) != is_quiet
  assert moved(value, network.value)


@pytest.mark.parametrize(
  ('name', 'value'),
  [('quiet_share', 1.0), ('quiet_share', -0.1), ('quiet_steps', 0)],
)
def test_config_rejects(name: str, value: Any) -> None:
  with pytest.raises(ValueError, match=name):
    ppo_config.PPOConfig(**{name: value})
