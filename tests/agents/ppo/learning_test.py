"""Tests of dmc_multimode.agents.ppo.learning."""

import dataclasses
import math
import shutil
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

pytestmark = pytest.mark.usefixtures('one_thread')

_T, _B, _D, _A = 4, 8, 3, 2
_STEPS = _T * _B  # Of an iteration.
_CONFIG = ppo_config.PPOConfig(hidden_sizes=(16,), rollout_length=_T)


def _network(
  config: ppo_config.PPOConfig = _CONFIG, privileged_size: int = 0
) -> networks.ActorCritic:
  """Of observations of _D numbers, of which the last may be privileged."""
  torch.manual_seed(0)
  return networks.ActorCritic(
    _D - privileged_size,
    _A,
    config.hidden_sizes,
    config.initial_std,
    privileged_size=privileged_size,
    activation=config.activation,
  )


def _learner(parallel: bool = False, **changes: Any) -> learning.PPOLearner:
  config = dataclasses.replace(_CONFIG, **changes)
  network = _network(config)
  return learning.PPOLearner(network, config, 1, threads=pair.Pair(parallel))


def _rollouts(
  network: networks.ActorCritic, seed: int = 0
) -> rollouts_lib.Rollouts:
  """Random observations and rewards, and the network's own actions."""
  generator = torch.Generator().manual_seed(seed)
  draw = lambda *shape: torch.randn(_T, _B, *shape, generator=generator)
  observations, noise = draw(_D), draw(_A)
  with torch.no_grad():
    means = network.act(observations)
    actions = means + network.std * noise
    log_probs = networks.log_prob(actions, means, network.std)
  last = torch.rand(_T, _B, generator=generator) < 0.3
  return rollouts_lib.Rollouts(
    observations=observations,
    actions=actions,
    log_probs=log_probs,
    means=means,
    rewards=draw(),
    discounts=1.0 - (last & (draw() > 0)).float(),
    last=last,
    next_observations=draw(_D),
  )


def _same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
  return one.keys() == other.keys() and all(
    torch.equal(one[key], other[key]) for key in one
  )


def test_a_step_raises_the_surrogate_of_its_own_data() -> None:
  learner = _learner(
    epochs=8, minibatches=4, entropy_coefficient=0.0, target_kl=0.0
  )
  rollouts = _rollouts(learner.network)
  learner.step(rollouts, 0)
  # Every sample once more: the policy has moved towards what paid.
  again = learner.step(rollouts, 0)
  assert again['loss/policy'] < -0.02


_draw = lambda rng, count: rng.uniform(-1, 1, (count, _D))
_REACHING = dataclasses.replace(
  _CONFIG, rollout_length=16, minibatches=2, learning_rate=2e-3
)


def _target(seen: np.ndarray) -> np.ndarray:
  return np.stack([0.5 * seen[:, 0], 0.3 - seen[:, 1]], axis=1)


class _Residual(nn.Module):
  """A network of a user's own, with layers that no perceptron has."""

  def __init__(self, outputs: int):
    super().__init__()
    self.linear, self.norm = nn.Linear(_D, 8), nn.LayerNorm(8)
    self.output, self.skip = nn.Linear(8, outputs), nn.Linear(_D, outputs)

  def forward(self, seen: torch.Tensor) -> torch.Tensor:
    hidden = torch.relu(self.norm(self.linear(seen)))
    return 0.1 * self.output(hidden) + self.skip(seen)


@pytest.mark.parametrize('is_own', [False, True])
def test_policy_learns_to_reach(is_own: bool) -> None:
  environment = toy.TargetEnvironment(32, _target, _draw)
  parts = builder.PPOBuilder(_REACHING, environment.description(), seed=0)
  if is_own:
    torch.manual_seed(0)
    network = parts.make_networks(policy=_Residual(_A), value=_Residual(1))
    assert isinstance(network.policy, _Residual)
  else:
    network = parts.make_networks()
  loop = toy.loop(environment, _REACHING, network=network)
  loop.run(runner.TrainingConfig(steps=50 * 16 * 32), mock.Mock(), mock.Mock())
  seen = environment.reset()
  actor = acting.BatchedActor(network, 0)
  error = np.abs(actor.select_action(seen) - _target(seen)).mean()
  assert error < 0.1  # It begins at 0.4, or elsewhere.


def test_learned_and_fixed_std() -> None:
  for learn in (True, False):
    learner = _learner(learn_std=learn)
    metrics = learner.step(_rollouts(learner.network), 0)
    assert (metrics['std'] != pytest.approx(0.2, abs=1e-7)) == learn


@pytest.mark.parametrize(
  ('initial_std', 'floor', 'start'),
  # What begins far below is held by the floor, what begins far above by the
  # ceiling: both are 0.4 at first.
  [(0.2, 0.4, -9.0), (0.4, 0.1, 9.0)],
)
@pytest.mark.parametrize('seen', [0, 1_000_000])
def test_std_is_bounded_by_the_steps(
  initial_std: float, floor: float, start: float, seen: int
) -> None:
  """Whatever the network's normaliser has seen in another training."""
  learner = _learner(
    initial_std=initial_std,
    std_floor=schedule.Schedule(floor, floor / 4, _STEPS, 3 * _STEPS),
  )
  learner.network.normaliser.count.fill_(seen)
  learner.network.log_std.data.fill_(start)
  rollouts = _rollouts(learner.network)
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


def test_bounded_std_leaves_its_bounds_by_the_gradient() -> None:
  learner = _learner(std_floor=0.1, initial_std=0.4, entropy_coefficient=1.0)
  learner.network.log_std.data.fill_(-9.0)
  found = [learner.step(_rollouts(learner.network), 0)['std'] for _ in range(2)]
  assert 0.1 <= found[0] < found[1] < 0.4


def test_bounds_of_the_learning_rate_fall_with_the_std() -> None:
  learner = _learner(
    learning_rate=1e-3,
    min_learning_rate=1e-3,
    target_kl=1e-12,
    std_floor=schedule.Schedule(0.4, 0.1, 0, 2 * _STEPS),
  )
  rollouts = _rollouts(learner.network)
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
  metrics = learner.step(_rollouts(learner.network), 0)
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
  metrics = learner.step(_rollouts(learner.network), 0)
  assert metrics['kl'] == pytest.approx(0.03)
  assert metrics['learning_rate'] == 0.001


@pytest.mark.parametrize(
  'changes',
  [
    {'learning_rate': 1e-6, 'max_learning_rate': 1e-6},
    {'learning_rate': 0.5, 'min_learning_rate': 0.5},
    {'learning_rate': 0.5, 'target_kl': 0.0},
    {'learning_rate': 1e-6, 'target_kl': 0.0},
  ],
)
def test_learning_rate_stays(changes: dict[str, Any]) -> None:
  bounds = {'min_learning_rate': 1e-7, 'max_learning_rate': 1.0}
  learner = _learner(**{**bounds, **changes})
  learner.step(_rollouts(learner.network), 0)
  assert learner.learning_rate == changes['learning_rate']


def test_adapted_learning_rate_reaches_the_optimiser() -> None:
  learner = _learner()
  state = learner.state()
  state['learning_rate'] = torch.tensor(1e-12, dtype=torch.float64)
  learner.restore(state)
  learner.step(_rollouts(learner.network), 0)
  after = learner.state()
  for key, value in state.items():
    if key.startswith('network/') and 'normaliser' not in key:
      torch.testing.assert_close(after[key], value, atol=1e-9, rtol=1e-6)


def test_gradient_clipping() -> None:
  rollouts = _rollouts(_network())
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


def test_normaliser_takes_in_every_step_once() -> None:
  learner = _learner()
  rollouts = _rollouts(learner.network)
  learner.step(rollouts, 0)
  flat = rollouts.observations.flatten(0, 1)
  normaliser = learner.network.normaliser
  assert normaliser.count == _T * _B
  torch.testing.assert_close(normaliser.mean, flat.mean(dim=0))


# What is not finite.


@pytest.mark.parametrize(
  'field',
  [name for name in rollouts_lib.Rollouts._fields if name != 'last'],
)
@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_rollouts_that_are_not_finite(field: str, value: float) -> None:
  learner = _learner()
  learner.step(_rollouts(learner.network), 0)
  before = learner.state()
  rollouts = _rollouts(learner.network, seed=1)
  getattr(rollouts, field)[2, 3] = value
  with pytest.raises(FloatingPointError, match='checkpoint'):
    learner.step(rollouts, 0)
  assert _same(learner.state(), before)


@pytest.mark.parametrize('warm', [False, True])
def test_update_that_is_not_finite_is_undone(warm: bool) -> None:
  learner, twin = _learner(minibatches=8), _learner(minibatches=8)
  if warm:
    learner.step(_rollouts(learner.network), 0)
    twin.step(_rollouts(twin.network), 0)
  before = learner.state()
  rollouts = _rollouts(learner.network, seed=1)
  # Overflows in the one minibatch that it falls into, after some others.
  rollouts.rewards[2, 3] = 1e38
  with pytest.raises(FloatingPointError, match='gradient'):
    learner.step(rollouts, 0)
  assert _same(learner.state(), before)
  rollouts = _rollouts(learner.network, seed=2)
  assert learner.step(rollouts, 0) == twin.step(rollouts, 0)
  assert _same(learner.state(), twin.state())


# Policy and value side by side.


def test_side_by_side_the_same_is_learned() -> None:
  results = []
  for parallel in (False, True):
    learner = _learner(parallel)
    metrics = [
      learner.step(_rollouts(learner.network, seed), 0) for seed in range(3)
    ]
    results.append((metrics, learner.state()))
  (metrics, state), (other_metrics, other_state) = results
  assert metrics == other_metrics
  assert _same(state, other_state)


def test_policy_learns_nothing_from_the_value_s_error() -> None:
  learner, other = _learner(), _learner()
  # With values of 0, normalised advantages do not tell scales apart.
  for rewarded, scale in ((learner, 1.0), (other, 100.0)):
    last = networks.linears_of(rewarded.network.value)[-1]
    torch.nn.init.zeros_(last.weight)
    rollouts = _rollouts(rewarded.network)
    rollouts.rewards.mul_(scale)
    rewarded.step(rollouts, 0)
  mine, theirs = learner.state(), other.state()
  for key in mine:
    if key.startswith('network/policy'):
      torch.testing.assert_close(mine[key], theirs[key])
  key = 'network/value.0.weight'
  assert not torch.allclose(mine[key], theirs[key], atol=1e-5)


@pytest.mark.parametrize('parallel', [False, True])
@pytest.mark.parametrize('part', ['policy', 'value'])
def test_failure_of_either_part_undoes_both(parallel: bool, part: str) -> None:
  learner = _learner(parallel)
  rollouts = _rollouts(learner.network)
  before = learner.state()
  first = networks.linears_of(getattr(learner.network, part))[0]
  first.weight.register_hook(lambda gradient: gradient * math.nan)
  with pytest.raises(FloatingPointError, match='gradient'):
    learner.step(rollouts, 0)
  assert _same(learner.state(), before)


def test_asymmetric_critic_explains_what_the_policy_does_not_see() -> None:
  """The reward depends on the last number, and not on any action."""
  remaining = {}
  for privileged_size in (0, 1):
    network = _network(privileged_size=privileged_size)
    if not privileged_size:
      network = networks.ActorCritic(_D - 1, _A, (16,))
    config = dataclasses.replace(
      _CONFIG, discount=0.0, learning_rate=1e-2, target_kl=0.0, minibatches=1
    )
    learner = learning.PPOLearner(network, config, seed=0)
    for seed in range(60):
      data = _rollouts(_network(privileged_size=1), seed)
      data = data._replace(rewards=data.observations[..., -1])
      if not privileged_size:
        data = data._replace(
          observations=data.observations[..., :-1],
          next_observations=data.next_observations[..., :-1],
        )
      metrics = learner.step(data, 0)
    remaining[privileged_size] = metrics['loss/value']
  assert remaining[0] > 0.5  # The reward's variance is 1.
  assert remaining[1] < 0.1


# Compiled passes.


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which('g++'), reason='there is no compiler')
def test_compiled_passes_teach_the_same() -> None:
  learner, compiled = _learner(), _learner(True, compile=True)
  for seed in range(2):
    rollouts = _rollouts(learner.network, seed)
    learner.step(rollouts, 0)
    compiled.step(rollouts, 0)
  for found, expected in zip(
    compiled.network.parameters(), learner.network.parameters(), strict=True
  ):
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-5)


def test_there_is_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setenv('CXX', 'no-such-compiler')
  with pytest.raises(ValueError, match='--ppo_compile .* no-such-compiler'):
    _learner(compile=True)


# State.


def test_restored_learner_goes_on_exactly() -> None:
  learner = _learner()
  for seed in range(3):
    learner.step(_rollouts(learner.network, seed), 0)
  state = learner.state()
  copied = {key: value.clone() for key, value in state.items()}
  other = _learner()
  other.step(_rollouts(other.network, seed=9), 0)
  other.restore(state)
  assert _same(other.state(), copied)
  for seed in (4, 5):
    rollouts = _rollouts(learner.network, seed)
    assert learner.step(rollouts, 0) == other.step(rollouts, 0)
  assert _same(learner.state(), other.state())
  assert _same(state, copied)  # Neither of the two wrote into it.


def test_state_of_another_network() -> None:
  state = _learner().state()
  other = _learner(hidden_sizes=(8,))
  with pytest.raises(ValueError, match='another network') as error:
    other.restore(state)
  assert '\n' not in str(error.value)


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'rollout_length': 0}, 'rollout_length'),
    ({'clip': -0.2}, 'clip'),
    ({'learning_rate': math.nan}, 'learning_rate'),
    ({'initial_std': math.inf}, 'initial_std'),
    ({'discount': 1.0}, 'discount'),
    ({'discount': math.nan}, 'discount'),
    ({'gae_lambda': 1.1}, 'gae_lambda'),
    ({'entropy_coefficient': -0.1}, 'entropy_coefficient'),
    ({'entropy_coefficient': math.nan}, 'entropy_coefficient'),
    ({'max_learning_rate': 1e-5}, 'min_learning_rate'),
    ({'target_kl': -0.01}, 'target_kl'),
    ({'std_floor': 0.0}, 'a geometric schedule needs positive'),
    ({'std_floor': '0.2:0.1@2:1'}, 'cannot end'),
    ({'deterministic_fraction': 1.0}, 'deterministic_fraction'),
    ({'deterministic_fraction': -0.1}, 'deterministic_fraction'),
    ({'deterministic_steps': 0}, 'deterministic_steps'),
    ({'hidden_sizes': ()}, 'hidden_sizes'),
    ({'hidden_sizes': (16, 0)}, 'hidden_sizes'),
    ({'symmetry': 'both'}, 'symmetry'),
    ({'advantages': 'world'}, 'advantages'),
    ({'activation': 'relu'}, 'activation'),
  ],
)
def test_config_rejects(changes: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    ppo_config.PPOConfig(**changes)
