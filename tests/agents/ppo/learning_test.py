"""Tests of dmc_multimode.agents.ppo.learning and symmetry."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from dmc_multimode.agents import pair
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import builder
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import symmetry
from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import symmetry as task_symmetry
from tests.agents import toy

pytestmark = pytest.mark.usefixtures('one_thread')

_T, _B, _D, _A = 4, 8, 3, 2
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
) -> learning.Rollouts:
  """Random observations and rewards, and the network's own actions."""
  generator = torch.Generator().manual_seed(seed)
  draw = lambda *shape: torch.randn(_T, _B, *shape, generator=generator)
  observations, noise = draw(_D), draw(_A)
  with torch.no_grad():
    means = network.act(observations)
    actions = means + network.std * noise
    log_probs = networks.log_prob(actions, means, network.std)
  last = torch.rand(_T, _B, generator=generator) < 0.3
  return learning.Rollouts(
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


def _reach(
  environment: toy.TargetEnvironment,
  config: ppo_config.PPOConfig,
  iterations: int,
  mirror: symmetry.Mirror | None = None,
) -> networks.ActorCritic:
  """Learns in the toy environment."""
  parts = builder.PPOBuilder(config, seed=0)
  network = parts.make_networks(
    environment.observation_spec(), environment.action_spec()
  )
  loop = runner.TrainingLoop(
    environment,
    parts.make_actor(network),
    parts.make_learner(network, mirror),
    config.rollout_length,
    ('reach',),
    dict,
  )
  for _ in range(iterations):
    loop._collect()
    loop._learner.step(loop._buffers)
  return network


# Learning.


def test_a_step_raises_the_surrogate_of_its_own_data() -> None:
  learner = _learner(
    epochs=8, minibatches=4, entropy_coefficient=0.0, target_kl=0.0
  )
  rollouts = _rollouts(learner.network)
  learner.step(rollouts)
  # Every sample once more: the policy has moved towards what paid.
  again = learner.step(rollouts)
  assert again['loss/policy'] < -0.02


def test_policy_learns_to_reach() -> None:
  target = lambda seen: np.stack([0.5 * seen[:, 0], 0.3 - seen[:, 1]], axis=1)
  draw = lambda rng, count: rng.uniform(-1, 1, (count, _D))
  environment = toy.TargetEnvironment(32, target, draw)
  network = _reach(
    environment,
    dataclasses.replace(
      _CONFIG,
      rollout_length=16,
      minibatches=2,
      learning_rate=2e-3,
      target_kl=0.03,
    ),
    iterations=50,
  )
  seen = environment.reset()
  actor = acting.BatchedActor(network, 0)
  error = np.abs(actor.select_action(seen) - target(seen)).mean()
  assert error < 0.1  # It begins at 0.4.


def test_learned_and_fixed_std() -> None:
  for learn in (True, False):
    learner = _learner(learn_std=learn)
    metrics = learner.step(_rollouts(learner.network))
    assert (metrics['std'] != pytest.approx(0.2, abs=1e-7)) == learn


def test_std_floor_falls_with_the_steps() -> None:
  floor: dict[str, Any] = {'min_std': 0.4, 'final_min_std': 0.1}
  config = ppo_config.PPOConfig(**floor, anneal_start=100, anneal_end=300)
  found = [config.std_bounds(steps)[0] for steps in (0, 100, 200, 300, 1000)]
  assert found == pytest.approx([0.4, 0.4, 0.2, 0.1, 0.1])
  assert ppo_config.PPOConfig(**floor).std_bounds(1000)[0] == 0.4

  learner = _learner(**floor, anneal_start=_T * _B, anneal_end=3 * _T * _B)
  learner.network.log_std.data.fill_(-9.0)
  rollouts = _rollouts(learner.network)
  found = [learner.step(rollouts)['std'] for _ in range(4)]
  assert found == pytest.approx([0.4, 0.2, 0.1, 0.1])
  other = _learner(**floor, anneal_start=_T * _B, anneal_end=3 * _T * _B)
  other.restore(learner.state())
  assert other.network.std.tolist() == pytest.approx([0.1] * _A)


def test_schedules_begin_with_the_training() -> None:
  """Whatever the network's normaliser has seen in another."""
  config = dataclasses.replace(
    _CONFIG,
    min_std=0.4,
    final_min_std=0.1,
    anneal_start=_T * _B,
    anneal_end=3 * _T * _B,
  )
  network = _network(config)
  network.normaliser.count.fill_(1e6)
  network.log_std.data.fill_(-9.0)
  learner = learning.PPOLearner(network, config, seed=1)
  rollouts = _rollouts(network)
  found = [learner.step(rollouts)['std'] for _ in range(4)]
  assert found == pytest.approx([0.4, 0.2, 0.1, 0.1])


def test_std_ceiling_falls_with_the_floor() -> None:
  bounds: dict[str, Any] = {
    'min_std': 0.1,
    'initial_std': 0.4,
    'final_min_std': 0.025,
  }
  config = ppo_config.PPOConfig(**bounds, anneal_start=100, anneal_end=300)
  found = [config.std_bounds(steps)[1] for steps in (0, 100, 200, 300, 1000)]
  assert found == pytest.approx([0.4, 0.4, 0.2, 0.1, 0.1])
  # Whoever begins below the floor stays on it.
  low = ppo_config.PPOConfig(min_std=0.3, initial_std=0.1)
  assert low.std_bounds(7) == (0.3, 0.3)

  learner = _learner(**bounds, anneal_start=_T * _B, anneal_end=3 * _T * _B)
  learner.network.log_std.data.fill_(9.0)
  rollouts = _rollouts(learner.network)
  found = [learner.step(rollouts)['std'] for _ in range(4)]
  assert found == pytest.approx([0.4, 0.2, 0.1, 0.1], rel=5e-3)


def test_bounded_std_leaves_its_bounds_by_the_gradient() -> None:
  learner = _learner(min_std=0.1, initial_std=0.4, entropy_coefficient=1.0)
  learner.network.log_std.data.fill_(-9.0)
  found = [learner.step(_rollouts(learner.network))['std'] for _ in range(2)]
  assert 0.1 <= found[0] < found[1] < 0.4


def test_bounds_of_the_learning_rate_fall_with_the_std() -> None:
  learner = _learner(
    learning_rate=1e-3,
    min_learning_rate=1e-3,
    target_kl=1e-12,
    min_std=0.4,
    final_min_std=0.1,
    anneal_start=0,
    anneal_end=2 * _T * _B,
  )
  rollouts = _rollouts(learner.network)
  found = [learner.step(rollouts)['learning_rate'] for _ in range(3)]
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
  metrics = learner.step(_rollouts(learner.network))
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
  metrics = learner.step(_rollouts(learner.network))
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
  learner.step(_rollouts(learner.network))
  assert learner.learning_rate == changes['learning_rate']


def test_adapted_learning_rate_reaches_the_optimiser() -> None:
  learner = _learner()
  state = learner.state()
  state['learning_rate'] = torch.tensor(1e-12, dtype=torch.float64)
  learner.restore(state)
  learner.step(_rollouts(learner.network))
  after = learner.state()
  for key, value in state.items():
    if key.startswith('network/') and 'normaliser' not in key:
      torch.testing.assert_close(after[key], value, atol=1e-9, rtol=1e-6)


def test_gradient_clipping() -> None:
  rollouts = _rollouts(_network())
  rollouts.rewards.mul_(1e4)
  learner = _learner(max_gradient_norm=1e-6, target_kl=0.0)
  before = learner.state()
  metrics = learner.step(rollouts)
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
  learner.step(rollouts)
  flat = rollouts.observations.flatten(0, 1)
  normaliser = learner.network.normaliser
  assert normaliser.count == _T * _B
  torch.testing.assert_close(normaliser.mean, flat.mean(dim=0))


# What is not finite.


@pytest.mark.parametrize(
  'field',
  [name for name in learning.Rollouts._fields if name != 'last'],
)
@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_rollouts_that_are_not_finite(field: str, value: float) -> None:
  learner = _learner()
  learner.step(_rollouts(learner.network))
  before = learner.state()
  rollouts = _rollouts(learner.network, seed=1)
  getattr(rollouts, field)[2, 3] = value
  with pytest.raises(FloatingPointError, match='checkpoint'):
    learner.step(rollouts)
  assert _same(learner.state(), before)


@pytest.mark.parametrize('warm', [False, True])
def test_update_that_is_not_finite_is_undone(warm: bool) -> None:
  learner, twin = _learner(minibatches=8), _learner(minibatches=8)
  if warm:
    learner.step(_rollouts(learner.network))
    twin.step(_rollouts(twin.network))
  before = learner.state()
  rollouts = _rollouts(learner.network, seed=1)
  # Overflows in the one minibatch that it falls into, after some others.
  rollouts.rewards[2, 3] = 1e38
  with pytest.raises(FloatingPointError, match='gradient'):
    learner.step(rollouts)
  assert _same(learner.state(), before)
  rollouts = _rollouts(learner.network, seed=2)
  assert learner.step(rollouts) == twin.step(rollouts)
  assert _same(learner.state(), twin.state())


# Policy and value side by side.


def test_side_by_side_the_same_is_learned() -> None:
  results = []
  for parallel in (False, True):
    learner = _learner(parallel)
    metrics = [
      learner.step(_rollouts(learner.network, seed)) for seed in range(3)
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
    rewarded.step(rollouts)
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
    learner.step(rollouts)
  assert _same(learner.state(), before)


# Ends of episodes. With one minibatch and one epoch, the value loss is that of
# the network before the update: the mean square of the advantages.


def _value_loss(
  network: networks.ActorCritic, data: learning.Rollouts
) -> float:
  config = dataclasses.replace(_CONFIG, epochs=1, minibatches=1)
  learner = learning.PPOLearner(network, config, seed=0)
  return learner.step(data)['loss/value']


@torch.no_grad()
def _expected_value_loss(
  network: networks.ActorCritic, data: learning.Rollouts
) -> float:
  """The same by a plain loop, in float64."""
  gamma, flow = _CONFIG.discount, _CONFIG.gae_lambda
  value = lambda seen: network.values(network.normaliser(seen)).item()
  total = 0.0
  for world in range(_B):
    running = 0.0
    for t in reversed(range(_T)):
      ended = bool(data.last[t, world])
      seen_next = (
        data.next_observations[t, world]
        if ended or t == _T - 1
        else data.observations[t + 1, world]
      )
      discount = gamma * data.discounts[t, world].item()
      delta = (
        (1 - gamma) * data.rewards[t, world].item()
        + discount * value(seen_next)
        - value(data.observations[t, world])
      )
      running = delta + discount * flow * (0.0 if ended else running)
      total += running**2
  return total / (_T * _B)


@pytest.mark.parametrize('privileged_size', [0, 1])
def test_timeouts_are_bootstrapped_from_what_was_seen_last(
  privileged_size: int,
) -> None:
  network = lambda: _network(privileged_size=privileged_size)
  data = _rollouts(network())
  timed_out = data.last & (data.discounts > 0)
  assert timed_out[:-1].any() and (data.last & ~timed_out).any()
  expected = _expected_value_loss(network(), data)
  assert _value_loss(network(), data) == pytest.approx(expected, rel=1e-4)

  def changed(where: torch.Tensor) -> bool:
    seen = data.next_observations.clone()
    seen[where] += 3.0
    seen[where, : _D - privileged_size] -= 3.0 * (privileged_size > 0)
    other = data._replace(next_observations=seen)
    return _value_loss(network(), other) != pytest.approx(expected, rel=1e-4)

  inner = torch.arange(_T)[:, None] < _T - 1
  assert changed(timed_out & inner)
  assert not changed(data.last & ~timed_out)
  assert not changed(~data.last & inner)  # There it is the next observation.


# An asymmetric critic: of three numbers the last is seen by the value alone.


def test_builder_divides_the_observation() -> None:
  environment = toy.TargetEnvironment(
    4, lambda seen: seen[:, :_A], lambda rng, count: rng.randn(count, _D)
  )
  network = builder.PPOBuilder(_CONFIG, seed=0).make_networks(
    environment.observation_spec(),
    environment.action_spec(),
    privileged_size=1,
  )
  assert (network.observation_size, network.privileged_size) == (_D - 1, 1)
  assert network.normaliser.mean.shape == (_D,)


def test_builder_takes_weights_over() -> None:
  environment = toy.TargetEnvironment(
    4, lambda seen: seen[:, :_A], lambda rng, count: rng.randn(count, _D)
  )
  expected = _network().state_dict()
  found = builder.PPOBuilder(_CONFIG, seed=5).make_networks(
    environment.observation_spec(),
    environment.action_spec(),
    weights=expected,
  )
  for key, value in found.state_dict().items():
    assert torch.equal(value, expected[key]), key


@pytest.mark.parametrize('activation', ppo_config.ACTIVATIONS)
def test_builder_passes_the_activation_on(activation: str) -> None:
  environment = toy.TargetEnvironment(
    4, lambda seen: seen[:, :_A], lambda rng, count: rng.randn(count, _D)
  )
  config = dataclasses.replace(_CONFIG, activation=activation)
  network = builder.PPOBuilder(config, seed=0).make_networks(
    environment.observation_spec(), environment.action_spec()
  )
  assert network.activation == activation


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
      metrics = learner.step(data)
    remaining[privileged_size] = metrics['loss/value']
  assert remaining[0] > 0.5  # The reward's variance is 1.
  assert remaining[1] < 0.1


# State.


def test_restored_learner_goes_on_exactly() -> None:
  learner = _learner()
  for seed in range(3):
    learner.step(_rollouts(learner.network, seed))
  state = learner.state()
  copied = {key: value.clone() for key, value in state.items()}
  other = _learner()
  other.step(_rollouts(other.network, seed=9))
  other.restore(state)
  assert _same(other.state(), copied)
  for seed in (4, 5):
    rollouts = _rollouts(learner.network, seed)
    assert learner.step(rollouts) == other.step(rollouts)
  assert _same(learner.state(), other.state())
  assert _same(state, copied)  # Neither of the two wrote into it.


def test_restored_actor_goes_on_exactly() -> None:
  network = _network()
  actor, other = (
    acting.BatchedActor(network, 0),
    acting.BatchedActor(network, 1),
  )
  seen = torch.ones(_B, _D)
  actor.sample(seen)
  other.restore(actor.state())
  assert all(map(torch.equal, actor.sample(seen), other.sample(seen)))


def test_state_of_another_network() -> None:
  state = _learner().state()
  other = _learner(hidden_sizes=(8,))
  with pytest.raises(ValueError, match='another network') as error:
    other.restore(state)
  assert '\n' not in str(error.value)


def test_acting() -> None:
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
    ({'anneal_start': -1}, 'anneal_start'),
    ({'anneal_start': 2, 'anneal_end': 1}, 'anneal_end'),
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


@pytest.mark.parametrize('kind', ['augment', 'alternate'])
def test_symmetry_needs_a_mirror(kind: str) -> None:
  with pytest.raises(ValueError, match='mirror'):
    _learner(symmetry=kind)


def test_advantages_by_mode_need_the_commands() -> None:
  with pytest.raises(ValueError, match='latents of the modes'):
    _learner(advantages='mode')


# Commands and advantages by mode.


@pytest.mark.parametrize('start', [0, 2])
def test_commands_by_hand(start: int) -> None:
  latents = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]], np.float32)
  commands = symmetry.Commands(latents, start)
  observations = torch.full((5, 6), 0.5)
  observations[:, start : start + 2] = torch.tensor(latents)[[2, 0, 0, 1, 2]]
  assert commands.modes(observations).tolist() == [2, 0, 0, 1, 2]
  assert commands.part == slice(start, start + 2)


def test_commands_of_the_observation_by_default() -> None:
  assert symmetry.Commands(np.eye(3, dtype=np.float32)).part == slice(2, 5)


def test_commands_of_close_latents() -> None:
  """The shipped latents are told apart in large batches too."""
  latents = library.codebook().latents
  modes = np.random.RandomState(0).randint(len(latents), size=3000)
  observations = torch.zeros(3000, 40)
  observations[:, 2 : 2 + latents.shape[1]] = torch.tensor(latents)[modes]
  found = symmetry.Commands(latents).modes(observations)
  np.testing.assert_array_equal(found, modes)


class _Recording(learning.PPOLearner):
  """Keeps the minibatches, and learns nothing from them."""

  def __init__(self, *args: Any, **kwargs: Any):
    super().__init__(*args, **kwargs)
    self.batches: list[Any] = []

  def _fit(self, samples: Any, batches: Any) -> list[learning.Metrics]:
    rows = lambda ids: type(samples)(*(field[ids] for field in samples))
    self.batches += [rows(ids) for ids in batches]
    return [{'loss/policy': torch.zeros(())}]


def _commanded_rollouts(
  network: networks.ActorCritic, count: int
) -> learning.Rollouts:
  """Rollouts of [clock, clock, latent, x] and one action, of one step each.

  Actions, log-probabilities and rewards are all different, x is positive.
  """
  rng = np.random.RandomState(0)
  seen = rng.uniform(0.5, 1.5, (1, count, 4)).astype(np.float32)
  seen[..., 2] = rng.choice([-1.0, 1.0, 0.0], count)
  numbers = torch.from_numpy(rng.uniform(1, 2, (4, 1, count)).astype('f4'))
  network.normaliser.update(torch.from_numpy(5.0 + 0.1 * seen[0]))
  return learning.Rollouts(
    observations=torch.from_numpy(seen),
    actions=numbers[0, ..., None],
    log_probs=-numbers[1],
    means=numbers[2, ..., None],
    rewards=numbers[3],
    discounts=torch.ones(1, count),
    last=torch.ones(1, count, dtype=torch.bool),
    next_observations=torch.from_numpy(seen),
  )


@pytest.mark.parametrize('kind', ppo_config.ADVANTAGES)
def test_advantages_are_normalised_over_all_or_by_mode(kind: str) -> None:
  config = dataclasses.replace(
    _CONFIG, advantages=kind, epochs=1, minibatches=1
  )
  network = networks.ActorCritic(4, 1, (8,))
  commands = symmetry.Commands(np.array([[-1.0], [1.0], [0.0]], np.float32))
  learner = _Recording(network, config, 0, commands=commands)
  data = _commanded_rollouts(network, 120)
  data.rewards[data.observations[..., 2] == 1.0] *= 100.0
  learner.step(data)
  (batch,) = learner.batches
  # By their log-probabilities, samples are known again in their new order.
  order = torch.argsort(data.log_probs[0])[
    torch.argsort(torch.argsort(batch.log_probs))
  ]
  modes = data.observations[0, order, 2]
  mine = [batch.advantages[modes == mode] for mode in (-1.0, 0.0, 1.0)]
  spread = torch.stack([advantages.std() for advantages in mine])
  shift = torch.stack([advantages.mean().abs() for advantages in mine])
  if kind == 'mode':
    torch.testing.assert_close(spread, torch.ones(3))
    torch.testing.assert_close(shift, torch.zeros(3), atol=1e-5, rtol=0.0)
  else:
    assert batch.advantages.std().item() == pytest.approx(1.0)
    assert spread[0] < 0.1 < spread[2]
    assert shift.max() > 0.5


# Symmetry.


def _toy_mirror() -> symmetry.Mirror:
  """Of [clock, clock, latent, x] and one action: x and the action change sign.

  The first two modes are each other's image, the third is its own.
  """
  image = task_symmetry.MirrorImage(
    observation_order=np.arange(4),
    observation_signs=np.array([1, 1, 1, -1], np.float32),
    action_order=np.zeros(1, int),
    action_signs=-np.ones(1, np.float32),
    mirrored_modes=np.array([1, 0, 2]),
    clock_signs=np.array([1, 1, -1], np.float32),
  )
  return symmetry.Mirror(image, np.array([[-1.0], [1.0], [0.0]], np.float32))


def test_toy_mirror_by_hand() -> None:
  mirror = _toy_mirror()
  seen = torch.tensor([[0.1, 0.2, -1.0, 3.0], [0.1, 0.2, 0.0, 3.0]])
  expected = [[0.1, 0.2, 1.0, -3.0], [-0.1, -0.2, 0.0, -3.0]]
  assert torch.equal(mirror.observations(seen), torch.tensor(expected))
  assert mirror.actions(torch.tensor([[2.0]])) == -2.0


def _recorded_passes(
  kind: str, epochs: int, count: int = 30
) -> list[np.ndarray]:
  """What each pass learns from: rows of [x, action, mean, ...], sorted."""
  config = dataclasses.replace(
    _CONFIG, symmetry=kind, epochs=epochs, minibatches=4
  )
  torch.manual_seed(0)
  network = networks.ActorCritic(4, 1, (8,))
  data = _commanded_rollouts(network, count)
  network.normaliser.load_state_dict(networks.Normaliser(4).state_dict())
  learner = _Recording(network, config, 0, _toy_mirror())
  learner.step(data)
  assert len(learner.batches) == 4 * epochs
  rows = [
    np.column_stack([field.reshape(len(b.targets), -1) for field in b])
    for b in learner.batches
  ]
  passes = [np.concatenate(rows[4 * i : 4 * i + 4]) for i in range(epochs)]
  # Rows of [clock, clock, latent, x, action, log-probability, mean, ...].
  return [each[np.lexsort((each[:, 3], each[:, 5]))] for each in passes]


@pytest.mark.parametrize('count', [30, 31])
def test_alternate_shows_each_sample_and_its_image_once(count: int) -> None:
  passes = _recorded_passes('alternate', 4, count)
  (everything,) = _recorded_passes('augment', 1, count)
  assert len(everything) == 2 * count
  sides = []
  for first, second in (passes[:2], passes[2:]):
    for each in (first, second):
      assert len(each) == count
      assert len(np.unique(each[:, 5])) == count  # No sample twice.
    both = np.concatenate([first, second])
    both = both[np.lexsort((both[:, 3], both[:, 5]))]
    np.testing.assert_array_equal(both, everything)
    # A pass has some samples as they are, and of others the image.
    sides.append(first[:, 3] > 0)
    assert 0.2 < sides[-1].mean() < 0.8
  assert (sides[0] != sides[1]).any()


def test_alternate_of_an_odd_number_of_passes() -> None:
  passes = _recorded_passes('alternate', 3)
  assert [len(each) for each in passes] == [30] * 3
  assert len(np.unique(passes[2][:, 5])) == 30


def test_images_by_hand() -> None:
  """Other than x, actions and the mode, an image is what its sample is."""
  (everything,) = _recorded_passes('augment', 1)
  images, samples = everything[::2], everything[1::2]
  signs = np.ones(everything.shape[1])
  signs[[3, 4, 6]] = -1.0  # x, action and mean.
  normalised = samples[:, 2].round(3)
  np.testing.assert_array_equal(np.unique(normalised), [-1.0, 0.0, 1.0])
  clock = np.where(normalised == 0.0, -1.0, 1.0)
  expected = samples * signs
  expected[:, :2] *= clock[:, None]
  expected[:, 2] *= -1.0
  np.testing.assert_allclose(images, expected, atol=1e-6)


def _only_left(rng: np.random.RandomState, count: int) -> np.ndarray:
  """The first mode alone, with positive x."""
  clock = rng.uniform(-1, 1, (count, 2))
  x = rng.uniform(0.5, 1.0, (count, 1))
  return np.concatenate([clock, -np.ones((count, 1)), x], axis=1)


@pytest.mark.parametrize('kind', ppo_config.SYMMETRIES)
def test_mirror_images_teach_the_other_side(kind: str) -> None:
  target = lambda seen: np.full((len(seen), 1), 0.4)
  environment = toy.TargetEnvironment(16, target, _only_left)
  mirror = _toy_mirror()
  config = dataclasses.replace(
    _CONFIG,
    rollout_length=16,
    minibatches=2,
    learning_rate=2e-3,
    target_kl=0.03,
    symmetry=kind,
    # The toy's symmetry is that of odd functions: tanh has it untaught.
    activation='elu',
  )
  network = _reach(environment, config, 40, mirror)
  seen = torch.from_numpy(environment.reset())
  with torch.no_grad():
    here = network.act(seen)
    there = mirror.actions(network.act(mirror.observations(seen)))
  assert (here - 0.4).abs().mean() < 0.15
  error = (there - 0.4).abs().mean()
  assert (error < 0.15) == (kind != 'none')


@pytest.mark.parametrize('kind', ['none', 'augment'])
def test_augmented_gradient_is_symmetric(kind: str) -> None:
  """A policy that is symmetric stays so, whatever it is taught."""
  mirror = _toy_mirror()
  config = dataclasses.replace(_CONFIG, symmetry=kind, minibatches=1, epochs=1)
  network = networks.ActorCritic(4, 1, (8,))
  first, second = networks.linears_of(network.policy)
  with torch.no_grad():
    # Units in pairs of opposite signs, and no biases: an odd function of x.
    first.weight.zero_()
    first.weight[:, 3] = torch.linspace(-1, 1, 8)
    second.weight[:] = torch.linspace(-1, 1, 8)
    second.bias.zero_()
  draw = lambda rng, count: _only_left(rng, count)
  environment = toy.TargetEnvironment(64, lambda seen: seen[:, 3:], draw)
  seen = torch.from_numpy(environment.reset())
  sample = acting.BatchedActor(network, 0).sample(seen)
  step = environment.step(sample.action.numpy())
  flags = torch.ones(1, 64, dtype=torch.bool)
  data = learning.Rollouts(
    seen[None],
    sample.action[None],
    sample.log_prob[None],
    sample.mean[None],
    torch.from_numpy(step.reward).float()[None],
    torch.ones(1, 64),
    flags,
    seen[None],
  )
  learning.PPOLearner(network, config, 0, mirror).step(data)
  # The running mean is that of the samples alone: it is not symmetric.
  identity = networks.Normaliser(4).state_dict()
  network.normaliser.load_state_dict(identity)
  with torch.no_grad():
    moved = network.act(seen) - sample.mean
    image = mirror.actions(network.act(mirror.observations(seen)))
  assert moved.abs().mean() > 1e-3
  difference = (network.act(seen) - image).abs().max().item()
  assert (difference < 1e-4) == (kind == 'augment')


# The biped. Worlds of the second half are mirror images of the first.


class _Mirrored:
  """Every mode of pi1, and its mirror image in a world of its own.

  After half a second the next mode is commanded, which the value knows.
  """

  def __init__(self) -> None:
    modes = library.mode_set('pi1')
    self.names = list(modes.names)
    count = len(modes)
    first = np.tile(np.arange(count), 2)
    plan = schedule.from_knots(np.stack([first, (first + 1) % count], 1), 0.5)
    task = multimode_biped.make_task(modes, episodes.ScheduledEpisodes(plan))
    self.environment = batched_env.BatchedImitation(
      task, 2 * count, 0, num_threads=1, auto_reset=False, privileged=True
    )
    self.ones, self.images = np.arange(2 * count).reshape(2, count)
    self.image = self.environment.mirror_image()
    self.mirror = symmetry.Mirror(self.image, task.mode_set.latents)
    self._random_state = np.random.RandomState(1)

  def actions(self, count: int) -> np.ndarray:
    noise = self._random_state.standard_normal((count, 10))
    return self.environment.standing_action() + 0.2 * noise

  def step(self) -> batched_env.BatchedTimeStep:
    """One step of both halves under mirrored actions."""
    actions = self.actions(len(self.ones))
    images = self.mirror.actions(torch.from_numpy(actions)).numpy()
    return self.environment.step(np.concatenate([actions, images]))

  def mirror_state(self) -> None:
    """Overwrites the second half by the mirror image of the first."""
    environment, ones, images = self.environment, self.ones, self.images
    tracked = environment.core.tracker.state
    tracked.mode[images] = self.image.mirrored_modes
    commanded = tracked.schedule_modes
    commanded[images] = self.image.mirrored_modes[commanded[ones]]
    environment.core.contact[images] = environment.core.contact[ones][:, ::-1]
    shift = np.where(self.image.clock_signs < 0, 0.5, 0.0)
    tracked.phase[images] = (tracked.phase[ones] + shift) % 1.0
    reference = environment.core.tracker.reference().position
    tracked.anchor[images] += reference[ones] * (1, -1, 1) - reference[images]
    legs = np.roll(np.arange(10), 5)
    qpos, qvel = environment.qpos, environment.qvel
    qpos[images] = qpos[ones]
    qpos[images, :7] *= (1, -1, 1, 1, -1, 1, -1)
    qpos[images, 7:] = qpos[ones, 7:][:, legs]
    qvel[images] = qvel[ones]
    qvel[images, :6] *= (1, -1, 1, -1, 1, -1)
    qvel[images, 6:] = qvel[ones, 6:][:, legs]


@pytest.fixture(scope='module')
def mirrored() -> _Mirrored:
  return _Mirrored()


def test_mirror_image_of_real_observations(mirrored: _Mirrored) -> None:
  seen = [mirrored.environment.reset()]
  for _ in range(5):
    step = mirrored.environment.step(mirrored.actions(2 * len(mirrored.ones)))
    seen.append(step.observation)
  modes = np.tile(np.arange(len(mirrored.names)), 2 * len(seen))
  observations = torch.from_numpy(np.concatenate(seen))
  image = mirrored.mirror.observations(observations)
  assert torch.equal(mirrored.mirror.observations(image), observations)
  assert not torch.equal(image, observations)
  actions = torch.from_numpy(mirrored.actions(4))
  twice = mirrored.mirror.actions(mirrored.mirror.actions(actions))
  assert torch.equal(twice, actions)

  latents = torch.tensor(mirrored.environment.mode_set.latents)
  exchanged = {'left': 'right', 'right': 'left'}
  for i, name in enumerate(mirrored.names):
    kind, _, side = name.partition('_')
    opposite = '_'.join(filter(None, (kind, exchanged.get(side, side))))
    mine = torch.from_numpy(modes == i)
    expected = latents[mirrored.names.index(opposite)]
    assert (image[mine, 2:6] == expected).all(), name
    sign = -1.0 if kind in ('walk', 'idle') else 1.0
    assert torch.equal(image[mine, :2], sign * observations[mine, :2]), name
    following = mirrored.names[(i + 1) % len(mirrored.names)]
    kind, _, side = following.partition('_')
    opposite = '_'.join(filter(None, (kind, exchanged.get(side, side))))
    expected = latents[mirrored.names.index(opposite)]
    assert (image[mine, 43:47] == expected).all(), following
  assert (image[:, 7] >= 0).all()  # Quaternions keep w >= 0.


def test_mirror_image_of_privileged_parts_by_hand(mirrored: _Mirrored) -> None:
  """Position error, contacts, countdown, next command and ground ahead."""
  latents = torch.tensor(mirrored.environment.mode_set.latents)
  left, right = (mirrored.names.index(f'walk_{s}') for s in ('left', 'right'))
  seen = torch.zeros(1, 50)
  seen[0, 2:6], seen[0, 43:47] = latents[0], latents[left]
  seen[0, 37:43] = torch.tensor([0.1, 0.2, 0.3, 1.0, 0.0, 0.6])
  seen[0, 47:] = torch.tensor([0.4, -0.1, 0.2])
  image = mirrored.mirror.observations(seen)
  expected = torch.tensor([0.1, -0.2, 0.3, 0.0, 1.0, 0.6])
  assert torch.equal(image[0, 37:43], expected)
  assert torch.equal(image[0, 43:47], latents[right])
  assert torch.equal(image[0, 47:], seen[0, 47:])
  assert torch.equal(image[0, 2:6], latents[0])


def test_mirror_image_without_privileged_parts(mirrored: _Mirrored) -> None:
  environment = mirrored.environment
  image = task_symmetry.mirror_image(environment.mode_set)
  assert image.commands == (2,)
  assert mirrored.image.commands == (2, 43)
  plain = symmetry.Mirror(image, environment.mode_set.latents)
  seen = torch.from_numpy(environment.reset())
  assert torch.equal(
    plain.observations(seen[:, :37]), mirrored.mirror.observations(seen)[:, :37]
  )


def test_mirrored_physics_are_the_same(mirrored: _Mirrored) -> None:
  mirrored.environment.reset()
  for _ in range(7):
    mirrored.environment.step(mirrored.actions(2 * len(mirrored.ones)))
  mirrored.mirror_state()
  feet = []
  for _ in range(6):
    step = mirrored.step()
    seen = torch.from_numpy(step.observation)
    torch.testing.assert_close(
      mirrored.mirror.observations(seen[mirrored.ones]),
      seen[mirrored.images],
      atol=1e-5,
      rtol=1e-5,
    )
    np.testing.assert_allclose(
      step.reward[mirrored.ones], step.reward[mirrored.images], atol=1e-9
    )
    feet.append(mirrored.environment.feet_contact())
    np.testing.assert_array_equal(
      feet[-1][mirrored.ones], feet[-1][mirrored.images][:, ::-1]
    )
  # The halves are not alike by being symmetric, each for itself.
  assert np.concatenate(feet).std() > 0
  assert not torch.allclose(seen[mirrored.ones], seen[mirrored.images])
  # What the value sees besides: errors to both sides, feet of both kinds.
  assert seen[:, 38].min() < -0.01 and seen[:, 38].max() > 0.01
  assert (seen[:, 40] != seen[:, 41]).any()


def test_set_without_a_mirror_image() -> None:
  modes = library.mode_set('idle,walk_left')
  with pytest.raises(ValueError, match='walk_right'):
    task_symmetry.mirror_image(modes)
