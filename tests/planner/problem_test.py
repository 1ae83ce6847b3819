"""Tests of dmc_multimode.planner.problem, with a policy that can walk."""

import functools
from typing import Any, Mapping, Sequence

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.reaching import problem as reaching

_IDLE, _WALK, _LEAP = range(3)
_REST = 50  # Control steps.


@functools.cache
def _policy() -> pretrained.Policy:
  return pretrained.load('quickstart')


def _problem(
  num_worlds: int,
  arena: str = 'flat',
  pushes: Sequence[pushes_lib.Push] = (),
  disturbed: events.TrainingEvents = events.NONE,
  sizes: Mapping[str, float] | None = None,
  **changes: Any,
) -> problem_lib.ReachingProblem:
  config = reaching.ReachingConfig(
    **{'goal': (0.5, 0.0, 0.5), 'knots': 4, 'knot_duration': 0.3, **changes}
  )
  return problem_lib.ReachingProblem(
    _policy(),
    track.make(arena, sizes=sizes),
    config,
    num_worlds,
    1,
    pushes,
    disturbed=disturbed,
  )


def test_rollout() -> None:
  problem = _problem(3)
  plans = np.array([[_WALK] * 4, [_IDLE] * 4, [_WALK] * 4])
  found = problem.rollout(plans)
  assert found.paths.shape == (3, 40 + _REST, 3)
  np.testing.assert_array_equal(found.position, found.paths[:, -1])
  assert 0.3 < found.position[0, 0] < 0.8
  assert abs(found.position[1, 0]) < 0.1
  np.testing.assert_array_equal(found.success, [True, False, True])
  distances = np.linalg.norm(found.paths[:, :40] - [0.5, 0.0, 0.5], axis=-1)
  np.testing.assert_allclose(found.returns, np.exp(-distances).sum(axis=1))
  assert found.speed.max() < 0.15
  assert problem.control_steps == 3 * (40 + _REST)
  # All begin alike, and again.
  np.testing.assert_array_equal(found.paths[0], found.paths[2])
  np.testing.assert_array_equal(problem.rollout(plans).paths, found.paths)


def test_a_world_does_not_depend_on_the_others() -> None:
  plan = np.array([_IDLE, _WALK, _IDLE, _WALK])
  few = _problem(2).rollout(np.stack([plan, plan[::-1]]))
  others = np.random.RandomState(0).randint(3, size=(37, 4))
  others[21] = plan
  together = _problem(37).rollout(others)
  np.testing.assert_array_equal(together.paths[21], few.paths[0])
  # One by itself is rounded as a Composer environment's actions are.
  alone = _problem(1).rollout(plan[None])
  np.testing.assert_allclose(alone.paths[0], few.paths[0], atol=5e-3)


def test_seeds_are_starts() -> None:
  """And the same ones for any number of worlds."""
  plan = np.full((1, 4), _WALK)
  one, other = (_problem(1, seed=seed).rollout(plan) for seed in (1, 2))
  assert np.abs(one.paths[0, 0] - other.paths[0, 0]).max() > 1e-4
  many = _problem(5, seed=2).rollout(np.repeat(plan, 5, axis=0))
  for path in many.paths:
    np.testing.assert_allclose(path[:5], other.paths[0, :5], atol=1e-4)


def test_take() -> None:
  """Worlds that take after another one go on as it does."""
  problem = _problem(3)
  problem.reset()
  problem.run_knot(np.array([_WALK, _IDLE, 2]))
  problem.copy_state(np.array([0, 0, 2]))
  branched = problem.run_knot(np.array([_WALK, _IDLE, 2]))
  whole = _problem(3).rollout(
    np.array([[_WALK, _WALK], [_WALK, _IDLE], [2, 2]])
  )
  np.testing.assert_array_equal(
    branched.path.swapaxes(0, 1), whole.paths[:, 10:20]
  )


def _run(
  problem: problem_lib.ReachingProblem, plan: Sequence[int]
) -> np.ndarray:
  """Runs all worlds under one plan; returns their paths, [B, T, 3]."""
  knots = [problem.run_knot(np.full(problem.num_worlds, mode)) for mode in plan]
  return np.concatenate([knot.path for knot in knots]).swapaxes(0, 1)


def test_begin_at() -> None:
  """All worlds go on as the other one would, now and after every reset."""
  robot, problem = _problem(1, 'block'), _problem(3, 'block')
  whole = _run(robot, [_WALK, _LEAP, _LEAP, _WALK])
  robot.reset()
  _run(robot, [_WALK, _LEAP])
  assert (robot.knots, robot.remaining) == (4, 2)
  problem.begin_at(robot)
  assert (problem.knots, problem.remaining) == (2, 2)
  rest = _run(problem, [_LEAP, _WALK])
  np.testing.assert_array_equal(rest[0], rest[2])
  np.testing.assert_allclose(rest[0], whole[0, 20:], atol=5e-3)
  again = problem.rollout(np.full((3, 2), [_LEAP, _WALK]))
  np.testing.assert_array_equal(again.paths[:, :20], rest)
  # One world by itself is the same bit for bit, and did not notice.
  alone = _problem(1, 'block')
  alone.begin_at(robot)
  rest = alone.rollout(np.array([[_LEAP, _WALK]])).paths
  np.testing.assert_array_equal(rest[0, :20], whole[0, 20:])
  np.testing.assert_array_equal(_run(robot, [_LEAP, _WALK])[0], whole[0, 20:])
  robot.reset()
  problem.begin_at(robot)
  assert problem.knots == 4
  other = problem_lib.ReachingProblem(
    _policy(), track.make('flat', 9), reaching.ReachingConfig(), 1, 1
  )
  with pytest.raises(ValueError, match='worlds of the same task'):
    problem.begin_at(other)


def test_who_begins_at_a_disturbed_robot_is_nominal() -> None:
  plan = [_WALK] * 4
  nominal = _problem(1)
  alone = _run(nominal, plan)
  for rows in ({'payload': 2.0}, {'friction': 0.3}, {'action_delay': 0.03}):
    robot = _problem(1, disturbed=events.fixed(**rows))
    nominal.begin_at(robot)  # The same start,
    np.testing.assert_array_equal(_run(nominal, plan), alone)
    moved = _run(robot, plan)  # and another way.
    assert np.abs(moved - alone).max() > 1e-3, rows
    nominal.begin_at(robot)
    np.testing.assert_array_equal(
      nominal._worlds.qpos[0], robot._worlds.qpos[0]
    )


def test_a_wrong_map() -> None:
  """Whoever has it meets the edges where they are on it."""
  robot, problem = _problem(1, 'block', knots=6), _problem(2, 'block', knots=6)
  there = _problem(2, 'block', sizes={'distance': 0.65}, knots=6)
  plans = np.full((2, 6), _WALK)
  exact = problem.rollout(plans).paths
  for _ in range(2):  # Beginning again is not twice as wrong.
    problem.begin_at(robot, 0.15)
    # The block is 0.8 m ahead, and 0.4 m high.
    np.testing.assert_allclose(problem.terrain.starts[:, 1], 0.65)
    np.testing.assert_allclose(problem.terrain.tops[:, 1], 0.4)
  met = problem.rollout(plans).paths
  np.testing.assert_allclose(met, there.rollout(plans).paths, atol=5e-3)
  assert exact[0, :, 0].max() > met[0, :, 0].max() + 0.05
  np.testing.assert_allclose(robot.terrain.starts[:, 1], 0.8)


def test_pushes() -> None:
  """They come at their knots, for all worlds, and after every reset."""
  pushes = (
    pushes_lib.Push(0.3, (0.5, -0.3, 0.1)),
    pushes_lib.Push(0.9, (-0.4, 0.0, 0.0)),
  )
  plans = np.array([[_WALK] * 4, [_IDLE] * 4])
  plain, once = (
    _problem(2, pushes=pushes[:count]).rollout(plans).paths for count in (0, 1)
  )
  np.testing.assert_array_equal(once[:, :10], plain[:, :10])
  change = (once - plain)[:, 10] / 0.03
  # The feet hold back a part of it within the first step.
  assert (np.sign(change[:, :2]) == [1, -1]).all()
  assert (np.abs(change[:, :2]) > [0.2, 0.1]).all()
  assert (np.abs(change[:, :2]) < [0.6, 0.4]).all()
  pushed = _problem(2, pushes=pushes)
  twice = pushed.rollout(plans).paths
  np.testing.assert_array_equal(twice[:, :30], once[:, :30])
  assert ((twice - once)[:, 30, 0] < -0.003).all()
  np.testing.assert_array_equal(pushed.rollout(plans).paths, twice)


def test_those_that_fell_stay_where_they_fell() -> None:
  """And cost nothing more."""
  problem = _problem(2, 'gap', knots=8, goal=(2.0, 0.0, 0.5))
  modes = np.array([_WALK, _IDLE])
  knots = [problem.run_knot(modes) for _ in range(8)]
  # The gap is where 8 knots of a walk lead to.
  assert knots[-1].position[0, 0] > 0.8
  assert knots[-1].position[0, 2] < 0.3
  alive = np.array([knot.alive for knot in knots])
  assert alive[:, 1].all() and alive[0, 0] and not alive[-1, 0]
  assert (np.diff(alive[:, 0].astype(int)) <= 0).all()
  assert knots[-1].reward[0] == 0.0
  path = np.concatenate([knot.path for knot in knots])
  still = np.flatnonzero((np.diff(path[:, 0], axis=0) == 0).all(axis=1))
  assert 10 < len(still) and (np.diff(still) == 1).all()
  assert still[-1] == len(path) - 2
  assert problem.control_steps == 2 * len(path) - len(still)
  assert (np.diff(path[:, 1], axis=0) != 0).any(axis=1).all()
  # Who takes after a fallen robot has fallen.
  problem.copy_state(np.array([1, 0]))
  fallen = problem.run_knot(np.array([_IDLE, _IDLE]))
  np.testing.assert_array_equal(fallen.alive, [True, False])
  assert not problem.rest().reached.any()
  problem.reset()
  assert problem.run_knot(modes).alive.all()


def test_state_that_is_not_finite_is_not_alive(
  capfd: pytest.CaptureFixture[str],
) -> None:
  problem = _problem(1)
  _run(problem, [_IDLE])
  problem._worlds.qvel[0, 8] = np.inf
  progress = problem.run_knot(np.array([_IDLE]))
  assert not progress.alive[0]
  assert np.isfinite(progress.path).all()
  assert 'nan' not in capfd.readouterr().err.lower()


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'knots': 0}, '^knots: '),
    ({'knot_duration': 0.0}, '^knot_duration: '),
    ({'seed': -1}, 'seed'),
    ({'goal': (1.0, 0.5)}, '^goal.2: '),
    ({'goal': (1.0, 0.0, 0.5), 'arena': 'gap'}, 'not over the track'),
  ],
)
def test_rejects(changes: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    _problem(1, **changes)
