"""Tests of dmc_multimode.agents.ppo.learning."""

import dataclasses
import math
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from torch import nn

from dmc_multimode.agents import pair
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import builder
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import rollouts as rollouts_lib
from dmc_multimode.utils import schedule
from tests.agents import toy
from tests.agents.ppo import random_data

pytestmark = pytest.mark.usefixtures('one_thread')

_CONFIG = random_data.CONFIG
_STEPS = random_data.T * random_data.B  # Of an iteration.


def _learner(parallel: bool = False, **changes: Any) -> learning.PPOLearner:
  config = dataclasses.replace(_CONFIG, **changes)
  network = random_data.network(config)
  return learning.PPOLearner(network, config, 1, threads=pair.Pair(parallel))


def _same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
  return one.keys() == other.keys() and all(
    torch.equal(one[key], other[key]) for key in one
  )


_draw = lambda rng, count: rng.uniform(-1, 1, (count, random_data.D))
_REACHING = dataclasses.replace(
  _CONFIG, rollout_length=16, minibatches=2, learning_rate=2e-3
)


def _target(seen: np.ndarray) -> np.ndarray:
  return np.stack([0.5 * seen[:, 0], 0.3 - seen[:, 1]], axis=1)


class _Residual(nn.Module):
  """A network of a user's own, with layers that no perceptron has."""

  def __init__(self, outputs: int):
    super().__init__()
    self.linear, self.norm = nn.Linear(random_data.D, 8), nn.LayerNorm(8)
    self.output, self.skip = (
      nn.Linear(8, outputs),
      nn.Linear(random_data.D, outputs),
    )

  def forward(self, seen: torch.Tensor) -> torch.Tensor:
    hidden = torch.relu(self.norm(self.linear(seen)))
    return 0.1 * self.output(hidden) + self.skip(seen)


@pytest.mark.parametrize('is_own', [False, True])
def test_policy_learns_to_reach(is_own: bool) -> None:
  environment = toy.TargetEnvironment(32, _target, _draw)
  parts = builder.PPOBuilder(_REACHING, environment.description(), seed=0)
  if is_own:
    torch.manual_seed(0)
    network = parts.make_networks(
      policy=_Residual(random_data.A), value=_Residual(1)
    )
    assert isinstance(network.policy, _Residual)
  else:
    network = parts.make_networks()
  loop = toy.loop(environment, _REACHING, network=network)
  loop.run(runner.TrainingConfig(steps=50 * 16 * 32), mock.Mock(), mock.Mock())
  seen = environment.reset()
  actor = acting.BatchedActor(network, 0)
  error = np.abs(actor.select_action(seen) - _target(seen)).mean()
  assert error < 0.1  # It begins at 0.4, or elsewhere.


@pytest.mark.parametrize(
  ('initial_std', 'floor', 'start'),
  # What begins far below is held by the floor, what begins far above by the
  # ceiling: both are 0.4 at first.
  [(0.2, 0.4, -9.0), (0.4, 0.1, 9.0)],
)
def test_std_is_bounded_by_the_steps(
  initial_std: float, floor: float, start: float
) -> None:
  """Whatever the network's normaliser has seen in another training."""
  learner = _learner(
    initial_std=initial_std,
    std_floor=schedule.Schedule(floor, floor / 4, _STEPS, 3 * _STEPS),
  )
  learner.network.normaliser.count.fill_(1_000_000)
  learner.network.log_std.data.fill_(start)
  rollouts = random_data.rollouts(learner.network)
  found = [learner.step(rollouts, i * _STEPS)['std'] for i in range(4)]
  assert found == pytest.approx([0.4, 0.2, 0.1, 0.1], rel=5e-3)


def test_std_bounds_by_hand() -> None:
  config = ppo_config.PPOConfig(
    initial_std=0.4, std_floor=schedule.Schedule(0.1, 0.025, 100, 300)
  )
  steps = (0, 100, 200, 300, 1000)
  found = [config.std_bounds(n)[0] for n in steps]
  assert found == pytest.approx([0.1, 0.1, 0.05, 0.025, 0.025])
  found = [config.std_bounds(n)[1] for n in steps]
  assert found == pytest.approx([0.4, 0.4, 0.2, 0.1, 0.1])
  # Whoever begins below the floor stays on it.
  low = ppo_config.PPOConfig(initial_std=0.1, std_floor=schedule.constant(0.3))
  assert low.std_bounds(7) == (0.3, 0.3)


def test_bounds_of_the_learning_rate_fall_with_the_std() -> None:
  learner = _learner(
    learning_rate=1e-3,
    min_learning_rate=1e-3,
    target_kl=1e-12,
    std_floor=schedule.Schedule(0.4, 0.1, 0, 2 * _STEPS),
  )
  rollouts = random_data.rollouts(learner.network)
  found = [
    learner.step(rollouts, i * _STEPS)['learning_rate'] for i in range(3)
  ]
  # At a floor of 0.4 the least rate is 1e-3, at 0.2 half, at 0.1 a quarter.
  assert found == pytest.approx([1e-3, 1e-3 / 1.2, 1e-3 / 1.44])


@pytest.mark.parametrize(
  ('rate', 'expected'),
  [
    (1e-6, 1.2e-6),  # The policy hardly moves.
    (0.5, 0.5 / 1.2),  # It moves too far.
  ],
)
def test_learning_rate_follows_the_divergence(
  rate: float, expected: float
) -> None:
  learner = _learner(
    learning_rate=rate, min_learning_rate=1e-7, max_learning_rate=1.0
  )
  metrics = learner.step(random_data.rollouts(learner.network), 0)
  assert metrics['learning_rate'] == pytest.approx(expected)
  assert (metrics['kl'] > 2 * _CONFIG.target_kl) == (rate > 0.1)


def test_few_samples_do_not_decide_about_the_learning_rate(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  """Those of tumbling robots move a thousand times as far as the others."""

  def divergence(mean: torch.Tensor, *args: torch.Tensor) -> torch.Tensor:
    found = torch.full(mean.shape[:1], 0.03)
    found[: len(found) // 10 + 1] = 30.0
    return found

  monkeypatch.setattr(networks, 'kl_divergence', divergence)
  learner = _learner(learning_rate=0.001, target_kl=0.03)
  metrics = learner.step(random_data.rollouts(learner.network), 0)
  assert metrics['kl'] == pytest.approx(0.03)
  assert metrics['learning_rate'] == 0.001


def test_gradient_clipping() -> None:
  rollouts = random_data.rollouts(random_data.network())
  rollouts.rewards.mul_(1e4)
  learner = _learner(max_gradient_norm=1e-6, target_kl=0.0)
  before = learner.state()
  metrics = learner.step(rollouts, 0)
  assert metrics['gradient_norm/value'] > 1.0
  assert metrics['gradient_norm/policy'] > 1e-3
  # Adam's eps of 1e-5 outweighs such gradients.
  for name in ('network/policy.0.weight', 'network/value.0.weight'):
    difference = (learner.state()[name] - before[name]).abs().max()
    steps = _CONFIG.epochs * _CONFIG.minibatches
    assert 0 < difference < 0.2 * steps * _CONFIG.learning_rate


# What is not finite.


@pytest.mark.parametrize(
  'field',
  [name for name in rollouts_lib.Rollouts._fields if name != 'last'],
)
def test_rollouts_that_are_not_finite(field: str) -> None:
  learner = _learner()
  learner.step(random_data.rollouts(learner.network), 0)
  before = learner.state()
  rollouts = random_data.rollouts(learner.network, seed=1)
  getattr(rollouts, field)[2, 3] = math.nan
  with pytest.raises(FloatingPointError, match='checkpoint'):
    learner.step(rollouts, 0)
  assert _same(learner.state(), before)


# Policy and value side by side.


def test_side_by_side_the_same_is_learned() -> None:
  results = []
  for parallel in (False, True):
    learner = _learner(parallel)
    metrics = [
      learner.step(random_data.rollouts(learner.network, seed), 0)
      for seed in range(3)
    ]
    results.append((metrics, learner.state()))
  (metrics, state), (other_metrics, other_state) = results
  assert metrics == other_metrics
  assert _same(state, other_state)


@pytest.mark.parametrize('parallel', [False, True])
@pytest.mark.parametrize('part', ['policy', 'value'])
def test_failure_of_either_part_undoes_both(parallel: bool, part: str) -> None:
  learner, twin = _learner(parallel), _learner(parallel)
  for each in (learner, twin):
    each.step(random_data.rollouts(each.network), 0)
  rollouts = random_data.rollouts(learner.network, seed=1)
  before = learner.state()
  first = networks.linears_of(getattr(learner.network, part))[0]
  factors = iter([1.0, 1.0, math.nan])  # After some that went well.
  hook = first.weight.register_hook(lambda g: g * next(factors, math.nan))
  with pytest.raises(FloatingPointError, match='gradient'):
    learner.step(rollouts, 0)
  assert _same(learner.state(), before)
  hook.remove()
  assert learner.step(rollouts, 0) == twin.step(rollouts, 0)
  assert _same(learner.state(), twin.state())


# State.


def test_state_of_another_network() -> None:
  state = _learner().state()
  other = _learner(hidden_sizes=(8,))
  with pytest.raises(ValueError, match='another network') as error:
    other.restore(state)
  assert '\n' not in str(error.value)


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'max_learning_rate': 1e-5}, 'min_learning_rate'),
    ({'std_floor': 0.0}, 'a geometric schedule needs positive'),
    ({'deterministic_fraction': 1.0}, 'deterministic_fraction'),
    ({'hidden_sizes': ()}, 'hidden_sizes'),
    ({'symmetry': 'both'}, 'symmetry'),
    ({'advantages': 'world'}, 'advantages'),
    ({'activation': 'relu'}, 'activation'),
    ({'kickstarting_weight': -1.0}, 'kickstarting_weight'),
  ],
)
def test_config_rejects(changes: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    ppo_config.PPOConfig(**changes)
