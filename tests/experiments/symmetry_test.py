"""Tests of dmc_multimode.experiments.symmetry, on the biped too."""

import numpy as np
import pytest
import torch

from dmc_multimode.experiments import symmetry
from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import symmetry as task_symmetry


@pytest.mark.parametrize('start', [0, 2])
def test_mode_of_by_hand(start: int) -> None:
  latents = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]], np.float32)
  mode_of = symmetry.ModeOf(latents, start)
  observations = torch.full((5, 6), 0.5)
  observations[:, start : start + 2] = torch.tensor(latents)[[2, 0, 0, 1, 2]]
  assert mode_of(observations).tolist() == [2, 0, 0, 1, 2]
  assert mode_of.part == slice(start, start + 2)


def test_mode_of_of_close_latents() -> None:
  """The shipped latents are told apart in large batches too."""
  latents = library.codebook().latents
  modes = np.random.RandomState(0).randint(len(latents), size=3000)
  observations = torch.zeros(3000, 40)
  observations[:, 2 : 2 + latents.shape[1]] = torch.tensor(latents)[modes]
  found = symmetry.ModeOf(latents)(observations)
  np.testing.assert_array_equal(found, modes)


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
  image, actions = mirror(seen, torch.tensor([[[2.0], [3.0]]] * 2))
  assert torch.equal(image, torch.tensor(expected))
  assert actions.tolist() == [[[-2.0], [-3.0]]] * 2


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
    tracked.pace[:] = 1.0  # A ramp is not the same half a cycle later.
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
