"""Tests of dmc_multimode.modes.library."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest

from dmc_multimode.modes import files
from dmc_multimode.modes import library
from dmc_multimode.modes import reference
from dmc_multimode.utils import constants


@pytest.mark.parametrize('name', [*library.modes()])
def test_starts_nominal_stays_sane_and_has_a_mirror_image(name: str) -> None:
  motion = library.modes()[name]
  assert motion.name == name
  np.testing.assert_allclose(motion.positions[0], [0, 0, 0.5])
  bank = reference.ReferenceBank([motion])
  phases = np.linspace(0, 1, 101)
  modes = np.zeros(101, dtype=np.int64)
  speed = np.linalg.norm(bank.velocity(modes, phases), axis=-1)
  assert speed.max() < 3.0
  height = bank.sample(modes, phases).position[:, 2]
  lowest = min(motion.ledge.height, 0.0) if motion.ledge else 0.0
  assert height.min() - lowest >= 0.4
  mirror = library.modes()[motion.mirror]
  assert mirror.mirror == name
  np.testing.assert_allclose(mirror.positions, motion.positions * [1, -1, 1])
  assert motion.contacts is not None and mirror.contacts is not None
  if not motion.half_cycle_symmetric:
    np.testing.assert_array_equal(mirror.contacts, motion.contacts[:, ::-1])


@pytest.mark.parametrize(
  ('name', 'velocity', 'turn'),
  [
    ('idle', [0, 0, 0], 0),
    ('walk_forward', [0.6, 0, 0], 0),
    ('walk_backward', [-0.4, 0, 0], 0),
    ('walk_left', [0, 0.3, 0], 0),
    ('leap_forward', [0.5, 0, 0], 0),
    ('leap_left', [0, 0.25, 0], 0),
    ('hop_forward', [0.6, 0, 0], 0),
    ('launch', [0, 0, 0], 0),
    ('turn_left', [0, 0, 0], 0.35),
    ('turn_right', [0, 0, 0], -0.35),
  ],
)
def test_mean_velocity(name: str, velocity: list[float], turn: float) -> None:
  """Metres per second, and radians a cycle."""
  bank = reference.ReferenceBank([library.modes()[name]])
  speed = bank.displacements[0] / bank.durations[0]
  np.testing.assert_allclose(speed, velocity, atol=1e-12)
  assert bank.turns[0] == pytest.approx(turn, abs=1e-7)
  assert bank.gaits[0] == name.startswith(('walk', 'turn'))


def test_leap_flies_about_as_gravity_allows() -> None:
  motion = library.modes()['leap_forward']
  heights = motion.positions[:, 2]
  assert heights.max() - heights[0] == pytest.approx(0.18, abs=1e-7)
  assert motion.contacts is not None
  takeoff = int(np.flatnonzero(motion.contacts[:, 0] == 0)[0])
  landing = int(np.flatnonzero(motion.contacts[:, 0] == 0)[-1]) + 1
  flight = motion.duration * (motion.phases[landing] - motion.phases[takeoff])
  rise = constants.GRAVITY * flight**2 / 8
  assert rise == pytest.approx(heights.max() - heights[takeoff], abs=0.05)


def test_hop_differs_from_walk_in_contacts_alone() -> None:
  walk, hop = library.resolve('walk_forward,hop_forward')
  phases = np.linspace(0, 1, 31)
  one, other = (reference.sample(m, phases) for m in (walk, hop))
  np.testing.assert_allclose(one.position, other.position, atol=1e-12)
  assert not np.array_equal(one.contact, other.contact)
  np.testing.assert_array_equal(other.contact[:, 0], other.contact[:, 1])


@pytest.mark.parametrize(
  ('name', 'height'), [('launch', 0.4), ('step_down', -0.4)]
)
def test_jumps_end_behind_their_edge(name: str, height: float) -> None:
  jump = library.modes()[name]
  assert jump.ledge is not None
  assert jump.ledge.height == height
  x, _, z = jump.positions[-1]
  assert z == pytest.approx(constants.STAND_HEIGHT + height, abs=1e-7)
  assert x > jump.ledge.edge
  assert jump.takeoff > 0


def test_step_down_falls_as_gravity_has_it() -> None:
  jump = library.modes()['step_down']
  index = int(np.searchsorted(jump.phases, jump.takeoff))
  takeoff, middle, touchdown = jump.positions[index : index + 3, 2]
  times = jump.duration * np.diff(jump.phases[index : index + 3])
  fall = times.sum()
  climb = (touchdown - takeoff) / fall + constants.GRAVITY * fall / 2
  expected = takeoff + times[0] * (climb - constants.GRAVITY * times[0] / 2)
  assert middle == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(
  ('name', 'size'),
  [('pi1', 9), ('pi2', 4), ('pi3', 4), ('pi_all', 14), ('pi_parkour', 6)],
)
def test_sets(name: str, size: int) -> None:
  motions = library.resolve(name)
  assert len(motions) == size
  assert [m.name for m in motions] == list(library.SETS[name])


def test_resolve() -> None:
  by_text = library.resolve('launch, idle')
  assert [m.name for m in by_text] == ['launch', 'idle']
  assert library.resolve(['launch', 'idle']) == by_text
  own = dataclasses.replace(library.modes()['idle'], duration=9.0)
  assert library.resolve('idle', [own])[0].duration == 9.0
  assert library.resolve('idle')[0].duration == 0.6
  with pytest.raises(ValueError, match="'fly'.*walk_forward.*pi1"):
    library.resolve('idle,fly')


def test_modes_of_four_feet() -> None:
  motions = {m.name: m for m in library.resolve('quadruped')}
  assert list(motions) == ['stand', 'trot_forward', 'pronk_forward']
  known = library.four_footed_modes()
  for motion in known.values():
    assert motion.num_feet == 4 and motion.mirror == motion.name
  # Diagonal feet, feet of a side, and front or hind feet move together.
  for name, (one, other) in {
    'trot_forward': (0, 3),
    'pace_forward': (0, 2),
    'bound_forward': (0, 1),
  }.items():
    contacts = known[name].contacts
    assert contacts is not None
    np.testing.assert_array_equal(contacts[:, one], contacts[:, other])
    assert (contacts.min(axis=1) < contacts.max(axis=1)).any()
  mode_set = library.mode_set('quadruped')
  np.testing.assert_array_equal(mode_set.latents, np.eye(3))


def test_motions_of_a_robot_of_another_height() -> None:
  """Lengths in heights h, times in sqrt(h / g): the Froude number is kept."""
  same = library.resolve(list(library.modes()))
  for one, other in zip(same, library.modes().values(), strict=True):
    assert one is library.modes()[one.name]
    assert other.name in library.modes()
  walk, launch = library.resolve(
    'walk_forward,launch', stand_height=constants.STAND_HEIGHT / 4
  )
  known = library.modes()
  np.testing.assert_array_equal(
    walk.positions, known['walk_forward'].positions / 4
  )
  assert walk.duration == known['walk_forward'].duration / 2
  ledge, expected = launch.ledge, known['launch'].ledge
  assert ledge and expected
  assert (ledge.edge, ledge.height) == (expected.edge / 4, expected.height / 4)
  np.testing.assert_array_equal(launch.contacts, known['launch'].contacts)


def test_a_mode_file_in_the_place_of_names(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'mine.JSON'
  walk = files.motion_to_dict(library.modes()['walk_forward'])
  two = [{**walk, 'name': name, 'mirror': name} for name in ('one', 'other')]
  path.write_text(json.dumps({'modes': two}))
  for given in (path, str(path)):
    found = library.mode_set(given)
    assert found.names == ('one', 'other')
    np.testing.assert_array_equal(found.latents, np.eye(2))
  with pytest.raises(ValueError, match='absent.yaml: cannot be read'):
    library.mode_set('absent.yaml')
