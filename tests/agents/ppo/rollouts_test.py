"""Tests of dmc_multimode.agents.ppo.rollouts."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
import torch

from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import rollouts as rollouts_lib
from tests.agents import toy

pytestmark = pytest.mark.usefixtures('one_thread')

_T, _B, _D, _A = 4, 8, 3, 2
_CONFIG = ppo_config.PPOConfig(hidden_sizes=(16,), rollout_length=_T)
_LATENTS = torch.tensor([-1.0, 1.0, 0.0])


def _mode_of(raw: torch.Tensor) -> torch.Tensor:
  """Modes by one-dimensional latents."""
  return (raw[:, 2:3] - _LATENTS).abs().argmin(dim=1)


def _mirror(
  raw: torch.Tensor, actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
  """Of [clock, clock, latent, x] and one action: x and the action change sign.

  The first two modes are each other's image; the third is its own, half a cycle
  later.
  """
  image = raw * torch.tensor([1.0, 1.0, -1.0, -1.0])
  image[raw[:, 2] == 0, :2] *= -1.0
  return image, -actions


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


# Ends of episodes: targets are values plus advantages.


@torch.no_grad()
def _expected_advantages(
  network: networks.ActorCritic, data: rollouts_lib.Rollouts
) -> np.ndarray:
  """Generalised advantages by a plain loop, in float64, [T, B]."""
  gamma, flow = _CONFIG.discount, _CONFIG.gae_lambda
  value = lambda seen: network.values(network.normaliser(seen)).item()
  found = np.empty((_T, _B))
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
      found[t, world] = running
  return found


@torch.no_grad()
def _advantages(
  network: networks.ActorCritic, data: rollouts_lib.Rollouts
) -> torch.Tensor:
  samples = rollouts_lib.SampleMaker(network, _CONFIG).make(data)
  return (samples.targets - network.values(samples.observations)).view(_T, _B)


@pytest.mark.parametrize('privileged_size', [0, 1])
def test_timeouts_are_bootstrapped_from_what_was_seen_last(
  privileged_size: int,
) -> None:
  network = _network(privileged_size=privileged_size)
  data = _rollouts(network)
  timed_out = data.last & (data.discounts > 0)
  assert timed_out[:-1].any() and (data.last & ~timed_out).any()
  expected = _expected_advantages(network, data)
  found = _advantages(network, data)
  np.testing.assert_allclose(found, expected, atol=1e-5)

  def changed(where: torch.Tensor) -> bool:
    seen = data.next_observations.clone()
    seen[where] += 3.0
    seen[where, : _D - privileged_size] -= 3.0 * (privileged_size > 0)
    other = _advantages(network, data._replace(next_observations=seen))
    return not torch.equal(other, found)

  inner = torch.arange(_T)[:, None] < _T - 1
  assert changed(timed_out & inner)
  assert not changed(data.last & ~timed_out)
  assert not changed(~data.last & inner)  # There it is the next observation.


@pytest.mark.parametrize('is_deterministic', [True, False])
def test_policy_learns_nothing_from_actions_that_were_not_drawn(
  is_deterministic: bool,
) -> None:
  config = dataclasses.replace(_CONFIG, entropy_coefficient=0.0)
  network = _network()
  data = _rollouts(network)
  if is_deterministic:
    data = data._replace(actions=data.means)
  policy, value = (
    [p.detach().clone() for p in part.parameters()]
    for part in (network.policy, network.value)
  )
  learning.PPOLearner(network, config, 0).step(data, 0)
  moved = lambda before, part: (
    not all(map(torch.equal, before, part.parameters()))
  )
  assert moved(policy, network.policy) != is_deterministic
  assert moved(value, network.value)


# Modes and mirror images.


@pytest.mark.parametrize('kind', ['augment', 'alternate'])
def test_symmetry_needs_a_mirror(kind: str) -> None:
  config = dataclasses.replace(_CONFIG, symmetry=kind)
  with pytest.raises(ValueError, match='mirror'):
    rollouts_lib.SampleMaker(_network(), config)


def test_advantages_by_mode_need_the_modes() -> None:
  config = dataclasses.replace(_CONFIG, advantages='mode')
  with pytest.raises(ValueError, match='latents of the modes'):
    rollouts_lib.SampleMaker(_network(), config)


def _commanded_rollouts(
  network: networks.ActorCritic, count: int
) -> rollouts_lib.Rollouts:
  """Rollouts of [clock, clock, latent, x] and one action, of one step each.

  Actions, log-probabilities and rewards are all different, x is positive.
  """
  rng = np.random.RandomState(0)
  seen = rng.uniform(0.5, 1.5, (1, count, 4)).astype(np.float32)
  seen[..., 2] = rng.choice([-1.0, 1.0, 0.0], count)
  numbers = torch.from_numpy(rng.uniform(1, 2, (4, 1, count)).astype('f4'))
  network.normaliser.update(torch.from_numpy(5.0 + 0.1 * seen[0]))
  return rollouts_lib.Rollouts(
    observations=torch.from_numpy(seen),
    actions=numbers[0, ..., None],
    log_probs=-numbers[1],
    means=numbers[2, ..., None],
    rewards=numbers[3],
    discounts=torch.ones(1, count),
    last=torch.ones(1, count, dtype=torch.bool),
    next_observations=torch.from_numpy(seen),
  )


def _samples(count: int, **changes: str) -> rollouts_lib.Samples:
  """Of `_commanded_rollouts`, whose rewards are large in mode 1."""
  torch.manual_seed(0)
  network = networks.ActorCritic(4, 1, (8,))
  data = _commanded_rollouts(network, count)
  network.normaliser.load_state_dict(networks.Normaliser(4).state_dict())
  data.rewards[data.observations[..., 2] == 1.0] *= 100.0
  config = dataclasses.replace(_CONFIG, **changes)  # type: ignore[arg-type]
  maker = rollouts_lib.SampleMaker(network, config, _mirror, _mode_of)
  return maker.make(data)


@pytest.mark.parametrize('kind', ppo_config.ADVANTAGES)
def test_advantages_are_normalised_over_all_or_by_mode(kind: str) -> None:
  samples = _samples(120, advantages=kind)
  modes = samples.observations[:, 2].round()
  mine = [samples.advantages[modes == mode] for mode in (-1.0, 0.0, 1.0)]
  spread = torch.stack([advantages.std() for advantages in mine])
  shift = torch.stack([advantages.mean().abs() for advantages in mine])
  if kind == 'mode':
    torch.testing.assert_close(spread, torch.ones(3))
    torch.testing.assert_close(shift, torch.zeros(3), atol=1e-5, rtol=0.0)
  else:
    assert samples.advantages.std().item() == pytest.approx(1.0)
    assert spread[0] < 0.1 < spread[2]
    assert shift.max() > 0.5


def test_images_by_hand() -> None:
  """Other than x, actions and the mode, an image is what its sample is."""
  samples = _samples(30, symmetry='augment')
  ones, images = (
    rollouts_lib.Samples(*parts)
    for parts in zip(*(field.chunk(2) for field in samples), strict=True)
  )
  expected = ones.observations * torch.tensor([1.0, 1.0, -1.0, -1.0])
  expected[ones.observations[:, 2].abs() < 0.5, :2] *= -1.0
  torch.testing.assert_close(images.observations, expected)
  assert torch.equal(images.actions, -ones.actions)
  assert torch.equal(images.means, -ones.means)
  for name in ('log_probs', 'advantages', 'targets'):
    assert torch.equal(getattr(images, name), getattr(ones, name)), name
  without = _samples(30)
  assert all(map(torch.equal, ones, without))


def _passes(kind: str, epochs: int, count: int) -> list[np.ndarray]:
  config = dataclasses.replace(_CONFIG, symmetry=kind, epochs=epochs)
  generator = torch.Generator().manual_seed(0)
  return [p.numpy() for p in rollouts_lib.passes(count, config, generator)]


@pytest.mark.parametrize('count', [30, 31])
def test_alternate_shows_each_sample_and_its_image_once(count: int) -> None:
  passes = _passes('alternate', 5, 2 * count)
  sides = []
  for first, second in (passes[:2], passes[2:4]):
    both = np.concatenate([first, second])
    np.testing.assert_array_equal(np.sort(both), np.arange(2 * count))
    # A pass has some samples as they are, and of others the image.
    for each in (first, second):
      np.testing.assert_array_equal(np.sort(each % count), np.arange(count))
    sides.append(np.sort(first) < count)
    assert 0.2 < sides[-1].mean() < 0.8
  assert set(passes[0]) != set(passes[2])
  assert len(set(passes[4] % count)) == count  # Of an odd number of passes.


@pytest.mark.parametrize('kind', ['none', 'augment'])
def test_other_passes_show_everything(kind: str) -> None:
  first, second = _passes(kind, 2, 30)
  for each in (first, second):
    np.testing.assert_array_equal(np.sort(each), np.arange(30))
  assert (first != second).any()


def _only_left(rng: np.random.RandomState, count: int) -> np.ndarray:
  """The first mode alone, with positive x."""
  clock = rng.uniform(-1, 1, (count, 2))
  x = rng.uniform(0.5, 1.0, (count, 1))
  return np.concatenate([clock, -np.ones((count, 1)), x], axis=1)


@pytest.mark.parametrize('kind', ppo_config.SYMMETRIES)
def test_mirror_images_teach_the_other_side(kind: str) -> None:
  target = lambda seen: np.full((len(seen), 1), 0.4)
  environment = toy.TargetEnvironment(16, target, _only_left)
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
  loop = toy.loop(environment, config, _mirror)
  loop.run(runner.TrainingConfig(steps=40 * 16 * 16), mock.Mock(), mock.Mock())
  network = loop.network
  seen = torch.from_numpy(environment.reset())
  with torch.no_grad():
    here = network.act(seen)
    image, _ = _mirror(seen, here)
    there = -network.act(image)
  assert (here - 0.4).abs().mean() < 0.15
  error = (there - 0.4).abs().mean()
  assert (error < 0.15) == (kind != 'none')


@pytest.mark.parametrize('kind', ['none', 'augment'])
def test_augmented_gradient_is_symmetric(kind: str) -> None:
  """A policy that is symmetric stays so, whatever it is taught."""
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
  data = rollouts_lib.Rollouts(
    seen[None],
    sample.action[None],
    sample.log_prob[None],
    sample.mean[None],
    torch.from_numpy(step.reward).float()[None],
    torch.ones(1, 64),
    flags,
    seen[None],
  )
  learning.PPOLearner(network, config, 0, _mirror).step(data, 0)
  # The running mean is that of the samples alone: it is not symmetric.
  identity = networks.Normaliser(4).state_dict()
  network.normaliser.load_state_dict(identity)
  with torch.no_grad():
    moved = network.act(seen) - sample.mean
    image = -network.act(_mirror(seen, sample.mean)[0])
  assert moved.abs().mean() > 1e-3
  difference = (network.act(seen) - image).abs().max().item()
  assert (difference < 1e-4) == (kind == 'augment')
