"""Tests of dmc_multimode.agents.ppo.rollouts."""

import dataclasses

import numpy as np
import pytest
import torch

from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import rollouts as rollouts_lib
from tests.agents.ppo import random_data

pytestmark = pytest.mark.usefixtures('one_thread')

_CONFIG = random_data.CONFIG
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


# Ends of episodes: targets are values plus advantages.


@torch.no_grad()
def _expected_advantages(
  network: networks.ActorCritic, data: rollouts_lib.Rollouts
) -> np.ndarray:
  """Generalised advantages by a plain loop, in float64, [T, B]."""
  gamma, flow = _CONFIG.discount, _CONFIG.gae_lambda
  value = lambda seen: network.values(network.normaliser(seen)).item()
  found = np.empty((random_data.T, random_data.B))
  for world in range(random_data.B):
    running = 0.0
    for t in reversed(range(random_data.T)):
      ended = bool(data.last[t, world])
      seen_next = (
        data.next_observations[t, world]
        if ended or t == random_data.T - 1
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
  return (samples.targets - network.values(samples.observations)).view(
    random_data.T, random_data.B
  )


@pytest.mark.parametrize('privileged_size', [0, 1])
def test_timeouts_are_bootstrapped_from_what_was_seen_last(
  privileged_size: int,
) -> None:
  network = random_data.network(privileged_size=privileged_size)
  data = random_data.rollouts(network)
  timed_out = data.last & (data.discounts > 0)
  assert timed_out[:-1].any() and (data.last & ~timed_out).any()
  expected = _expected_advantages(network, data)
  found = _advantages(network, data)
  np.testing.assert_allclose(found, expected, atol=1e-5)

  def changed(where: torch.Tensor) -> bool:
    seen = data.next_observations.clone()
    seen[where] += 3.0
    seen[where, : random_data.D - privileged_size] -= 3.0 * (
      privileged_size > 0
    )
    other = _advantages(network, data._replace(next_observations=seen))
    return not torch.equal(other, found)

  inner = torch.arange(random_data.T)[:, None] < random_data.T - 1
  assert changed(timed_out & inner)
  assert not changed(data.last & ~timed_out)
  assert not changed(~data.last & inner)  # There it is the next observation.


@pytest.mark.parametrize('is_deterministic', [True, False])
def test_policy_learns_nothing_from_actions_that_were_not_drawn(
  is_deterministic: bool,
) -> None:
  config = dataclasses.replace(_CONFIG, entropy_coefficient=0.0)
  network = random_data.network()
  data = random_data.rollouts(network)
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


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'symmetry': 'augment'}, 'mirror'),
    ({'symmetry': 'alternate'}, 'mirror'),
    ({'advantages': 'mode'}, 'latents of the modes'),
  ],
)
def test_mirror_and_modes_are_needed(
  changes: dict[str, str], message: str
) -> None:
  config = dataclasses.replace(_CONFIG, **changes)  # type: ignore[arg-type]
  with pytest.raises(ValueError, match=message):
    rollouts_lib.SampleMaker(random_data.network(), config)


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
