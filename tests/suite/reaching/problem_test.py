"""Tests of dmc_multimode.suite.reaching, on numbers worked out by hand."""

import contextlib
import math
from typing import Any

import numpy as np
import pytest

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.suite.reaching import problem as reaching

_GOAL = np.array([2.0, 0.0, 0.5])


def _terrain(*segments: tuple[float, float, float]) -> terrain_lib.Terrain:
  """A batch of one: (start, end, top) of each segment, metres."""
  starts, ends, tops = np.array(segments).T[:, None]
  return terrain_lib.Terrain(starts, ends, tops)


_STEPPED = _terrain((-1.0, 0.5, 0.0), (0.8, 1.2, 0.3), (1.2, 9.0, 0.1))


def _qpos(x: float, z: float, roll: float = 0.0) -> np.ndarray:
  """One robot, the trunk tilted by `roll` radians."""
  turned = [math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0]
  return np.array([[x, 0.0, z, *turned, *np.zeros(10)]])


def test_rewards() -> None:
  position = np.array([[2.0, 0.0, 0.5], [-1.0, 0.0, 4.5], [2.0, 1.0, 0.5]])
  expected = [1.0, math.exp(-5.0), math.exp(-1.0)]
  np.testing.assert_allclose(reaching.rewards(position, _GOAL), expected)


@pytest.mark.parametrize(
  ('goal', 'qpos', 'expected'),
  [
    (_GOAL, _qpos(2.0, 0.5), True),
    (_GOAL, _qpos(1.76, 0.5), True),
    (_GOAL, _qpos(1.74, 0.5), False),
    (_GOAL, _qpos(2.26, 0.5), False),  # Past it.
    ((2.0, 0.19, 0.5), _qpos(2.0, 0.5), True),
    ((2.0, 0.21, 0.5), _qpos(2.0, 0.5), False),
    (_GOAL, _qpos(2.0, 0.61), True),
    (_GOAL, _qpos(2.0, 0.63), False),
    (_GOAL, _qpos(2.0, 0.37), False),
    (_GOAL, _qpos(2.0, 0.5, roll=0.44), True),  # cos 0.44 = 0.905.
    (_GOAL, _qpos(2.0, 0.5, roll=0.46), False),  # cos 0.46 = 0.896.
    (_GOAL, _qpos(2.0, 0.5, roll=math.pi), False),
    # Near one on the middle segment, but over the last.
    ((1.1, 0.0, 0.7), _qpos(1.3, 0.7), False),
  ],
)
def test_reached(goal: Any, qpos: np.ndarray, expected: bool) -> None:
  two = terrain_lib.Terrain(*(np.repeat(f, 2, axis=0) for f in _STEPPED))
  qpos = np.concatenate([qpos, _qpos(9.0, -1.0)])  # The second one fell.
  qvel = np.zeros((2, 16))
  for speed, slow in ((0.0, True), (0.14, True), (0.16, False)):
    qvel[:, 1] = speed
    found = reaching.reached(qpos, qvel, two, np.array(goal))
    np.testing.assert_array_equal(found, [expected and slow, False])


@pytest.mark.parametrize(
  ('duration', 'expected'),
  [(0.3, 10), (0.03, 1), (0.15, 5), (0.31, None), (0.01, None), (0.295, None)],
)
def test_knot_steps(duration: float, expected: int | None) -> None:
  """They are whole control steps."""
  config = reaching.ReachingConfig(knot_duration=duration)
  if expected:
    assert reaching.knot_steps(config, 0.03) == expected
    return
  with pytest.raises(ValueError, match='no multiple of the control step, 0.03'):
    reaching.knot_steps(config, 0.03)


@pytest.mark.parametrize(
  ('goal', 'message'),
  [
    ((0.5, 0.0, 0.5), ''),  # The very edge counts.
    ((1.2, 4.0, 0.9), ''),  # Of two tops at one place the higher one does.
    ((1.2, 0.0, 0.25), 'stands over the ground at 0.3 m'),
    ((0.7, 0.0, 0.5), 'x = 0.7 m, is not over the .* runs from -1 to 9 m'),
    ((-0.1, 0.0, 0.5), 'x = -0.1 m, is behind the start'),
    ((9.1, 0.0, 0.5), 'not over the track'),
    ((0.0, -4.1, 0.5), 'y = -4.1 m, is not over the track'),
    ((0.0, 0.0, 0.9), 'z = 0.9 m, is not where .* that is 0.37 to 0.67 m'),
    ((0.0, 0.0, 0.68), 'z = 0.68 m, is not where'),
    ((0.0, 0.0, 0.36), 'z = 0.36 m, is not where'),
  ],
)
def test_check_goal(goal: tuple[float, ...], message: str) -> None:
  refused = pytest.raises(ValueError, match=message or None)
  with refused if message else contextlib.nullcontext():
    reaching.check_goal(goal, _STEPPED)


def test_ground_ahead() -> None:
  """Seen every 5 cm from x = 0.22: the first is at 0.27, the 30th at 1.72."""
  terrain = terrain_lib.Terrain(*(np.repeat(f, 3, axis=0) for f in _STEPPED))
  seen = reaching.ground_ahead(terrain, np.array([0.22, 1.0, 0.62]))
  gap = reaching.GAP
  expected = [0.0] * 5 + [gap] * 6 + [0.3] * 8 + [0.1] * 11
  np.testing.assert_allclose(seen[0], expected)
  # From the plateau it goes down.
  np.testing.assert_allclose(seen[1, :3], 0.0, atol=1e-12)
  np.testing.assert_allclose(seen[1, 4:], -0.2)
  # In a gap the support plane is still the one before it.
  np.testing.assert_allclose(seen[2, :5], [gap] * 3 + [0.3] * 2)
  # It ends with the track.
  terrain = _terrain((-1.0, 1.02, 0.2), (np.inf, np.inf, 0.0))
  seen = reaching.ground_ahead(terrain, np.array([0.0]))
  np.testing.assert_array_equal(seen[0], [0.0] * 20 + [gap] * 10)


@pytest.mark.parametrize('name', reaching.TRACKS)
def test_problems_are_on_their_tracks(name: str) -> None:
  for seed in range(5):
    terrain = track.make(name).generate(np.random.RandomState(seed))
    config = reaching.problem(name, terrain, seed)
    reaching.check_goal(config.goal, terrain)
    assert config.seed == seed
    assert reaching.knot_steps(config, 0.03) in (5, 10)


def test_every_track_but_level_ground_has_a_problem() -> None:
  assert {*reaching.TRACKS} == {*layouts.NAMES} - {'flat'}


def test_goals_are_on_the_ground_of_their_track() -> None:
  arena = track.make('gap_block', sizes={'height': 0.2})
  terrain = arena.generate(np.random.RandomState(0))
  assert reaching.problem('gap_block', terrain).goal == (2.0, 0.0, 0.7)


def test_random_problem() -> None:
  """The goal is 0.4 m behind the last edge; there is time for 0.3 m/s."""
  config = reaching.problem(reaching.RANDOM_TRACK, _STEPPED)
  np.testing.assert_allclose(config.goal, (1.6, 0.0, 0.6))
  assert (config.knots, config.knot_duration) == (36, 0.15)  # 5.33 s.
  terrain = track.make('parkour').generate(np.random.RandomState(4))
  assert reaching.random_problem(4) == reaching.problem('parkour', terrain, 4)
  assert reaching.random_problem(4) != reaching.random_problem(5)


def test_problem_of_a_track_of_other_sizes() -> None:
  """Knots suffice for 0.3 m/s, 0.15 s each."""
  sizes = {'difficulty': 0.5, 'length': 9.0}
  config = reaching.random_problem(4, 'obstacle_course', sizes)
  assert 8.0 < config.goal[0] <= 9.4
  assert config.knots == round(config.goal[0] / 0.3 / 0.15)
  config = reaching.random_problem(4, 'block_down', {'distance': 1.0})
  np.testing.assert_allclose(config.goal, (1.4, 0.0, 0.1))
  # The paper's goal, x = 2 m, would be before the gap, or over it.
  for distance in (1.8, 3.0):
    sizes = {'distance': distance, 'width': 0.4}
    config = reaching.random_problem(4, 'gap', sizes)
    np.testing.assert_allclose(config.goal, (distance + 0.8, 0.0, 0.5))
    assert config.knots == round(config.goal[0] / 0.3 / 0.15)


@pytest.mark.parametrize(
  ('time_limit', 'knots'),
  [
    (None, 11),
    (0.3, 1),
    (0.59, 1),
    (0.9, 3),
    (0.29, 0),
    (math.nan, 0),
    (math.inf, 0),
  ],
)
def test_within(time_limit: float | None, knots: int) -> None:
  config = reaching.ReachingConfig(seed=3)
  if knots:
    found = reaching.within(config, time_limit)
    assert found == reaching.ReachingConfig(knots=knots, seed=3)
    return
  with pytest.raises(
    ValueError, match='time_limit must be finite here and have room'
  ):
    reaching.within(config, time_limit)
