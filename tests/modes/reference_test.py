"""Tests of dmc_multimode.modes.reference."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import reference

_HALF = np.sqrt(0.5)


def _motion(**changes: Any) -> motion_lib.ReferenceMotion:
  """A step forward and up, then a quarter turn to the left, in 2 s."""
  fields: dict[str, Any] = {
    'name': 'test',
    'kind': motion_lib.PERIODIC,
    'duration': 2.0,
    'phases': [0.0, 0.25, 1.0],
    'positions': [[0, 0, 0.5], [0.4, 0, 0.7], [1.0, 0.3, 0.5]],
    'orientations': [[1, 0, 0, 0], [1, 0, 0, 0], [_HALF, 0, 0, _HALF]],
    'contacts': [[1, 0], [0, 1], [0, 1]],
  }
  return motion_lib.ReferenceMotion(**{**fields, **changes})


def _still(name: str = 'still') -> motion_lib.ReferenceMotion:
  return motion_lib.ReferenceMotion(
    name=name,
    kind=motion_lib.STEADY,
    duration=1.0,
    phases=np.array([0.0, 1.0]),
    positions=np.array([[0, 0, 0.5], [0, 0, 0.5]]),
    orientations=np.array([[1, 0, 0, 0], [1, 0, 0, 0]]),
  )


@pytest.mark.parametrize(
  ('phase', 'position', 'degrees', 'contact'),
  [
    (0.0, [0, 0, 0.5], 0, [1, 0]),
    (0.125, [0.2, 0, 0.6], 0, [1, 0]),
    (0.25, [0.4, 0, 0.7], 0, [0, 1]),  # Contacts hold until a keyframe.
    (0.5, [0.6, 0.1, 0.7 - 0.2 / 3], 30, [0, 1]),
    (0.75, [0.8, 0.2, 0.7 - 0.4 / 3], 60, [0, 1]),
    (1.0, [1.0, 0.3, 0.5], 90, [0, 1]),
  ],
)
def test_sample_by_hand(
  phase: float, position: list[float], degrees: float, contact: list[int]
) -> None:
  found = reference.sample(_motion(), np.array([phase]))
  np.testing.assert_allclose(found.position, [position], atol=1e-12)
  half = np.radians(degrees) / 2
  expected = [np.cos(half), 0, 0, np.sin(half)]
  np.testing.assert_allclose(found.orientation, [expected], atol=1e-12)
  np.testing.assert_allclose(
    motion_lib.yaw(found.orientation), np.radians([degrees]), atol=1e-12
  )
  np.testing.assert_array_equal(found.contact, [contact])
  np.testing.assert_array_equal(found.has_contact, [True])


def test_slerp_takes_the_short_way() -> None:
  flipped = [[1, 0, 0, 0], [-1, 0, 0, 0], [-_HALF, 0, 0, -_HALF]]
  phases = np.linspace(0, 1, 21)
  one = reference.sample(_motion(), phases).orientation
  other = reference.sample(_motion(orientations=flipped), phases).orientation
  alike = np.abs(np.sum(one * other, axis=-1))
  np.testing.assert_allclose(alike, 1.0, atol=1e-12)


def test_orientations_are_normalised_once() -> None:
  motion = _motion(
    kind=motion_lib.TRANSIENT,
    orientations=[[2, 0, 0, 0], [0, 3, 0, 0], [1, 2, 3, 4]],
  )
  norms = np.linalg.norm(motion.orientations, axis=-1)
  np.testing.assert_allclose(norms, 1.0, atol=1e-15)
  again = dataclasses.replace(motion)
  np.testing.assert_array_equal(again.orientations, motion.orientations)
  # And a mode is its own mirror image by default.
  assert (motion.mirror, _motion(mirror='other').mirror) == ('test', 'other')


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'kind': 'sometimes'}, 'kind'),
    ({'duration': 0.0}, 'duration'),
    ({'duration': float('nan')}, 'duration'),
    ({'phases': [0.1, 0.25, 1.0]}, 'from 0 to 1'),
    ({'phases': [0.0, 1.0, 1.0]}, 'rise'),
    ({'phases': [0.0, 1.0]}, 'positions'),
    ({'positions': np.zeros((3, 2))}, 'positions'),
    ({'positions': np.full((3, 3), np.nan)}, 'finite'),
    ({'orientations': np.zeros((3, 4))}, 'non-zero'),
    ({'orientations': np.ones(4)}, r'\[K, 4\]'),
    ({'contacts': np.full((3, 2), 0.5)}, 'contacts'),
    ({'takeoff': 1.5}, 'takeoff'),
    ({'kind': motion_lib.STEADY}, 'steady'),
    # Cycles that do not close: the reference would jump back.
    (
      {'kind': motion_lib.STEADY, 'positions': np.full((3, 3), 0.5)},
      'steady .* 1.57 rad from it',
    ),
    (
      {'positions': [[0, 0, 0.5], [0.4, 0, 0.7], [1.0, 0.3, 0.6]]},
      r'ends \+0.1 m from it',
    ),
    (
      {'orientations': [[1, 0, 0, 0], [1, 0, 0, 0], [0.8, 0.36, 0, 0.48]]},
      'but for yaw',
    ),
  ],
)
def test_rejects(changes: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message) as caught:
    _motion(**changes)
  assert '\n' not in str(caught.value)


def test_batch_equals_each_motion_alone() -> None:
  motions = (_motion(), _still())
  bank = reference.ReferenceBank(motions)
  rng = np.random.default_rng(0)
  modes, phases = rng.integers(0, 2, 200), rng.random(200)
  phases[:4] = (0.0, 0.0, 1.0, 1.0)
  together = bank.sample(modes, phases)
  for i, motion in enumerate(motions):
    alone = reference.sample(motion, phases[modes == i])
    for field, values in zip(alone._fields, alone, strict=True):
      batched = getattr(together, field)[modes == i]
      np.testing.assert_allclose(batched, values, atol=1e-12)


def test_periodic_modes_alone_move_on() -> None:
  transient = _motion(name='once', kind=motion_lib.TRANSIENT)
  bank = reference.ReferenceBank([_motion(), transient, _still()])
  expected = np.array([[1.0, 0.3, 0.0], [0, 0, 0], [0, 0, 0]])
  np.testing.assert_allclose(bank.displacements, expected, atol=1e-12)
  np.testing.assert_allclose(bank.turns, [np.pi / 2, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
  ('phase', 'expected'),
  [
    (0.1, [0.8, 0.0, 0.4]),
    (0.0, [0.8, 0.0, 0.4]),
    (0.5, [0.4, 0.2, -0.4 / 3]),
    (1.0, [0.4, 0.2, -0.4 / 3]),
  ],
)
def test_velocity_is_the_slope(phase: float, expected: list[float]) -> None:
  bank = reference.ReferenceBank([_still(), _motion()])
  velocity = bank.velocity(np.array([1, 0]), np.array([phase, phase]))
  np.testing.assert_allclose(velocity[0], expected, atol=1e-9)
  np.testing.assert_allclose(velocity[1], [0, 0, 0], atol=1e-9)


@pytest.mark.parametrize('phase', [0.25, 0.4, 0.6, 0.74])
def test_free_flight_lands_where_the_reference_does(phase: float) -> None:
  """In the air from a quarter to three quarters of 2 s, then a contact."""
  motion = _motion(
    phases=[0.0, 0.25, 0.5, 0.75, 1.0],
    positions=[
      [0, 0, 0.5],
      [0.4, 0, 0.7],
      [0.6, 0.1, 1.0],
      [1.0, 0.3, 0.8],
      [1.2, 0.3, 0.5],
    ],
    orientations=[[1, 0, 0, 0]] * 5,
    contacts=[[1, 1], [0, 0], [0, 0], [0, 1], [1, 1]],
  )
  bank = reference.ReferenceBank([_still(), motion])
  modes, phases = np.array([1]), np.array([phase])
  velocity = bank.start_velocity(modes, phases)[0]
  # Too short a rest of the flight is taken for a 20th of a second.
  start = min(phase, 0.75 - 0.025)
  position = bank.sample(modes, np.array([start])).position[0]
  time = (0.75 - start) * 2.0
  landed = position + velocity * time - [0, 0, 0.5 * 9.81 * time**2]
  np.testing.assert_allclose(landed, [1.0, 0.3, 0.8], atol=1e-9)


def test_the_ground_accelerates_up_to_the_take_off() -> None:
  motion = _motion(
    kind=motion_lib.TRANSIENT,
    positions=[[0, 0, 0.5], [0, 0, 0.6], [0, 0, 0.8]],
    orientations=[[1, 0, 0, 0]] * 3,
    contacts=[[1, 1], [0, 0], [1, 1]],
  )
  bank = reference.ReferenceBank([motion])
  phases = np.array([0.0, 0.125, 0.25 - 1e-9])
  velocity = bank.start_velocity(np.zeros(3, int), phases)
  # 1.5 s of flight: 0.2 m up and down again.
  takeoff = 0.2 / 1.5 + 0.5 * 9.81 * 1.5
  slope = 0.1 / 0.5
  expected = [slope, (slope + takeoff) / 2, takeoff]
  np.testing.assert_allclose(velocity[:, 2], expected, rtol=1e-6)
  np.testing.assert_array_equal(velocity[:, :2], 0.0)
  # Flight past the last keyframe ends with the cycle: half of it, 1 s, from
  # (0.6, 0.1, 0.6333) to (1, 0.3, 0.5).
  bank = reference.ReferenceBank([_motion(contacts=[[1, 0], [0, 0], [0, 0]])])
  velocity = bank.start_velocity(np.array([0]), np.array([0.5]))
  rise = 0.5 - (0.7 - 0.2 / 3) + 0.5 * 9.81
  np.testing.assert_allclose(velocity, [[0.4, 0.2, rise]], atol=1e-9)


@pytest.mark.parametrize(
  ('takeoff', 'contacts', 'expected'),
  [
    (0.25, [[1, 1], [0, 0], [1, 1]], 1.0),  # Up at 0.25, down at the end.
    (0.5, [[1, 1], [0, 0], [0, 1]], 1.0),
    (0.1, [[1, 1], [0, 0], [1, 1]], 0.1),  # Still on the ground there.
    (0.25, None, 0.25),  # Nobody knows.
    (0.0, [[0, 0], [0, 0], [1, 1]], 0.0),  # Not a jump.
  ],
)
def test_touch_down_after_the_take_off(
  takeoff: float, contacts: list[list[int]] | None, expected: float
) -> None:
  motion = _motion(takeoff=takeoff, contacts=contacts)
  bank = reference.ReferenceBank([motion])
  np.testing.assert_array_equal(bank.touchdowns, [expected])


@pytest.mark.parametrize(
  ('push_off', 'expected'), [(0.0, 0.1), (0.29, 0.1), (0.31, 1.0)]
)
def test_flights_count_from_the_push_off_on(
  push_off: float, expected: float
) -> None:
  # Of 2 s: takes off at 0.5 s, which is 0.3 s later, lands at the end.
  motion = _motion(contacts=[[1, 1], [0, 0], [1, 1]])
  bank = reference.ReferenceBank([motion])
  phases = bank.grounded(np.array([0]), np.array([0.1]), push_off)
  np.testing.assert_array_equal(phases, [expected])


def test_steps_of_one_foot() -> None:
  """Keyframes within a step do not cut it; flight and stance are no step."""
  motion = _motion(
    phases=[0.0, 0.1, 0.4, 0.5, 0.75, 1.0],
    positions=np.zeros((6, 3)),
    orientations=np.tile([1.0, 0.0, 0.0, 0.0], (6, 1)),
    contacts=[[1, 0], [1, 0], [0, 0], [0, 1], [1, 1], [1, 1]],
  )
  bank = reference.ReferenceBank([_still(), motion])
  phases = np.array([0.0, 0.05, 0.3, 0.45, 0.5, 0.6, 0.8, 0.3])
  modes = np.array([1, 1, 1, 1, 1, 1, 1, 0])
  swinging, time, length = bank.swing_timing(modes, phases)
  np.testing.assert_array_equal(
    swinging,
    np.array([[0, 0, 0, 0, 1, 1, 0, 0], [1, 1, 1, 0, 0, 0, 0, 0]], bool).T,
  )
  # From 0 to 0.4 and from 0.5 to 0.75 of 2 s.
  moving = swinging.any(axis=1)
  np.testing.assert_allclose(length[moving], [0.8, 0.8, 0.8, 0.5, 0.5])
  np.testing.assert_allclose(time[moving], [-0.4, -0.3, 0.2, -0.25, -0.05])
  # Up to the end of the cycle.
  bank = reference.ReferenceBank([_motion(), _still()])
  swinging, time, length = bank.swing_timing(np.array([0]), np.array([0.9]))
  np.testing.assert_array_equal(swinging, [[True, False]])
  np.testing.assert_allclose((time[0], length[0]), (2 * (0.9 - 0.625), 1.5))


def test_gaits() -> None:
  """Periodic, and on one foot at times."""
  in_sync = [[1, 1], [0, 0], [1, 1]]
  motions = [
    _motion(name='walk'),
    _motion(name='jump', kind=motion_lib.TRANSIENT),
    _motion(name='hop', contacts=in_sync),
    _motion(name='free', contacts=None),
    _still(),
  ]
  bank = reference.ReferenceBank(motions)
  np.testing.assert_array_equal(bank.gaits, [True, False, False, False, False])


def test_fastest_walks() -> None:
  bank = library.mode_set('walk_forward,leap_forward,idle,turn_left').bank
  # A Froude number of a half at 0.5 m: sqrt(0.5 * 9.81 * 0.5) m/s, of 0.6.
  np.testing.assert_allclose(
    bank.fastest_rates, [1.5660 / 0.6, np.inf, np.inf, np.inf], rtol=1e-4
  )


@pytest.mark.parametrize('modes', ['walk_forward', 'pi_all'])
def test_kinds_of_modes_do_not_depend_on_the_set(modes: str) -> None:
  bank = library.mode_set(modes).bank  # Of modes with 2 to 7 keyframes.
  found = {
    name: (level, flies)
    for name, level, flies in zip(
      bank.names, bank.level, bank.flies, strict=True
    )
  }
  expected = {
    'walk_forward': (True, False),
    'leap_forward': (False, True),
    'hop_forward': (False, True),
    'launch': (False, False),
    'turn_left': (False, False),
  }
  for name in expected.keys() & found.keys():
    assert found[name] == expected[name], name
