"""Tests of dmc_multimode.suite.reaching.worlds and sensing."""

import functools
from typing import Any

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode import suite
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.suite.reaching import worlds as worlds_lib

_IDLE, _WALK, _LEAP, _LAUNCH = range(4)
_PLAN = [_WALK] * 4 + [_LEAP] * 12 + [_LAUNCH] * 3
_load_policy = functools.cache(lambda: pretrained.load('pi2'))


def _worlds(
  num_worlds: int, seed: int, **kwargs: Any
) -> worlds_lib.ReachingWorlds:
  return worlds_lib.ReachingWorlds(
    _load_policy(), 'parkour', num_worlds, seed, 1, **kwargs
  )


def test_one_world_is_the_registered_task() -> None:
  env = suite.load(
    'multimode_biped',
    'reach_parkour',
    {'random': 5, 'policy': _load_policy()},
  )
  worlds = _worlds(1, 5)
  expected, seen = env.reset(), worlds.reset()
  for mode in _PLAN:
    flat = np.concatenate(list(expected.observation.values()))
    assert [
      (name, len(part)) for name, part in expected.observation.items()
    ] == list(worlds.layout)
    np.testing.assert_allclose(seen[0], flat, atol=1e-4)
    expected, step = env.step(mode), worlds.step([mode])
    seen = step.observation
    assert step.reward[0] == pytest.approx(expected.reward, abs=1e-4)
    assert step.discount[0] == expected.discount
    if expected.last():
      break


def test_worlds_have_tracks_and_goals_of_their_own_and_begin_anew() -> None:
  worlds = _worlds(8, 0)
  worlds.reset()
  goals, tops = worlds.goal.copy(), worlds.terrain.tops.copy()
  assert len(np.unique(goals[:, 0])) == len(np.unique(tops, axis=0)) == 8
  fell = np.zeros(8, dtype=bool)
  while not fell.any():  # Into a gap, sooner or later.
    before = worlds.goal.copy()
    step = worlds.step(np.full(8, _WALK))
    fell |= step.last
    anew = (worlds.goal != before).any(axis=1)
    np.testing.assert_array_equal(anew, step.last)
    np.testing.assert_array_equal(step.discount == 0, step.last)
  assert len(step.final_observation) == step.last.sum()
  goal, left = worlds.part('goal'), worlds.part('knots_left')
  began = step.observation[step.last]
  assert (began[:, left] == 1).all() and (began[:, goal][:, 0] > 1).all()
  assert not step.reached.any()


def test_without_resets_a_fallen_robot_stays() -> None:
  worlds = _worlds(4, 1, auto_reset=False)
  worlds.reset()
  over = np.zeros(4, dtype=bool)
  where = worlds.position
  for _ in range(40):
    step = worlds.step(np.full(4, _LEAP))
    np.testing.assert_array_equal(worlds.position[over], where[over])
    assert not step.reward[over].any() and not step.last[over].any()
    over |= step.last
    where = worlds.position
  assert over.any()


def test_only_who_stands_is_obeyed() -> None:
  worlds = _worlds(1, 0)
  worlds.reset()
  assert worlds.obeyed().all()
  seen = set()
  for _ in range(8):
    worlds.step([_LEAP])
    obeyed = worlds.obeyed()[0]
    assert obeyed[_LEAP] and obeyed.sum() in (1, 4)
    seen.add(int(obeyed.sum()))
  assert seen == {1, 4}  # In flight, and on the ground.


def test_restores_bit_for_bit() -> None:
  errors = sensing.ScanErrors(0.05, 0.05, 0.1)
  make = lambda: _worlds(
    4, 2, disturbed=events.fixed(push_speed=0.5), scan_errors=errors
  )
  first, second = make(), make()
  first.reset()
  for _ in range(3):
    first.step(np.full(4, _WALK))
  second.reset()
  seen = second.restore(first.state())
  np.testing.assert_array_equal(seen, first._observation)
  for _ in range(10):
    one, other = (w.step(np.full(4, _LEAP)) for w in (first, second))
    for mine, theirs in zip(one, other, strict=True):
      np.testing.assert_array_equal(mine, theirs)


def test_errors_of_the_scan() -> None:
  def ground(errors: sensing.ScanErrors) -> np.ndarray:
    worlds = _worlds(64, 0, scan_errors=errors)
    return worlds.reset()[:, worlds.part('ground')]

  exact = ground(sensing.EXACT)
  noisy = ground(sensing.ScanErrors(noise=0.05)) - exact
  assert noisy.std() == pytest.approx(0.05, rel=0.05)
  assert (ground(sensing.ScanErrors(dropouts=1.0)) == 0).all()
  # Edges, of which there are few, alone are elsewhere.
  moved = (ground(sensing.ScanErrors(shift=0.05)) != exact).mean()
  assert 0 < moved < 0.1
  # Heights are read every 5 cm: each is what was one place farther.
  nearer = ground(sensing.ScanErrors(nearer=0.05))
  np.testing.assert_array_equal(nearer[:, :-1], exact[:, 1:])
  assert (nearer != exact).any()


@pytest.mark.parametrize('modes', [[0], [0, 7], [0.5, 0], 'ab'])
def test_rejects_what_are_no_modes(modes: Any) -> None:
  worlds = _worlds(2, 0)
  worlds.reset()
  with pytest.raises(ValueError, match='modes'):
    worlds.step(modes)
