"""Tests of dmc_multimode.planner.replanning, with a policy that can walk."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from dmc_multimode import planner
from dmc_multimode import pretrained
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import replanning
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.reaching import problem as reaching
from tests.planner import replay

# Time enough to stand there for a while, and to be pushed back.
_CONFIG = reaching.ReachingConfig((0.7, 0.0, 0.5), 11, 0.3)
_PUSHES = tuple(pushes_lib.Push(time, (-1.0, 0.0, 0.0)) for time in (1.2, 1.8))
_REST = 50  # Control steps.
_SHORT = reaching.ReachingConfig((0.4, 0.0, 0.5), 4, 0.3)


@pytest.fixture(scope='module')
def policy() -> pretrained.Policy:
  # A policy that observes where it is off walks back by itself.
  return pretrained.load('pi2_paper')


def test_solve_by_names() -> None:
  """Tells all that the plan's file does."""
  small = beam_search.BeamConfig(2, attempts=1)
  push = pushes_lib.Push(0.9, (0.1, 0.0, 0.0))
  found = planner.solve(
    *('quickstart', 'flat', 3, _SHORT, None, small),
    pushes=[push],
    num_threads=1,
    quiet=True,
  )
  assert found.success
  assert found.course == ('flat', {}, 0, (push,))
  assert found.goal == (0.4, 0.0, 0.5)
  assert found.origin == {
    'replan_every': 0,
    'planner': 'beam',
    'policy': 'quickstart',
  }


@pytest.mark.parametrize(
  ('arguments', 'message'),
  [
    ({'arena': 'moat'}, "Unknown arena 'moat'"),
    (
      {'planner': 'luck'},
      "Unknown planner 'luck'; there are beam, guided, q_learning",
    ),
    ({'replan_every': -1}, 'replan_every must not be negative'),
    ({'planner': 'selector', 'map_error': 0.1}, 'A selector has no map'),
    ({'pushes': [pushes_lib.Push(0.1, (1.0, 0.0, 0.0))]}, 'not at a knot'),
  ],
)
def test_solve_rejects(arguments: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    planner.solve('nobody', **arguments)


def test_solve_plans_for_another_robot_on_another_map() -> None:
  """The plan is the same for any robot, and its outcome is not."""
  small = beam_search.BeamConfig(2, attempts=1)

  def solve(arena: str, **lies: Any) -> plan_lib.PlanResult:
    return planner.solve(
      *('quickstart', arena, 3, _SHORT, None, small),
      num_threads=1,
      quiet=True,
      **lies,
    )

  nominal = solve('flat')
  loaded = solve('flat', disturbed=events.fixed(payload=3.0))
  assert loaded.plan == nominal.plan
  assert np.abs(loaded.path - nominal.path).max() > 0.01
  # On the map the block is in the way; in truth it is behind the goal.
  assert solve('block', map_error=0.6).plan != solve('block').plan


@pytest.mark.slow
def test_a_plan_survives_pushes(policy: pretrained.Policy) -> None:
  """Open loop the robot ends where it was pushed to; replanning it returns."""
  solver = solver_lib.Solver(
    policy, 'flat', _CONFIG, beam_search.BeamConfig(3, attempts=1), 1
  )
  lost = replanning.follow(solver, _PUSHES)
  reports: list[solver_lib.Status] = []
  found = replanning.follow(solver, _PUSHES, 2, reports.append)
  assert (lost.success, found.success) == (False, True)
  assert lost.final_position[0] < 0.45 < found.final_position[0]
  # Nobody knows of the pushes beforehand.
  assert found.plan.modes[:6] == lost.plan.modes[:6]
  assert found.plan.modes != lost.plan.modes
  begins = list(dict.fromkeys(status.search for status in reports))
  assert begins[0] == '3 beams from 0.00 s' and len(begins) > 1
  assert reports[-1].total < 11
  assert found.rollouts > lost.rollouts
  assert found.control_steps > lost.control_steps
  for each in (lost, found):
    assert each.path.shape == (110 + _REST, 3)
    again = replay.replay(policy, _CONFIG, each.plan, _PUSHES)
    np.testing.assert_array_equal(again.paths[0], each.path)
    assert again.returns[0] == pytest.approx(each.episode_return)
    assert again.success[0] == each.success


def test_without_pushes_the_first_plan_is_kept(
  policy: pretrained.Policy,
) -> None:
  solver = solver_lib.Solver(
    policy, 'flat', _SHORT, beam_search.BeamConfig(2, attempts=1), 1
  )
  open_loop, found = solver.solve(), replanning.follow(solver, every=1)
  assert found.success
  assert found.plan == open_loop.plan
  np.testing.assert_array_equal(found.path, open_loop.path)
  assert found.rollouts == open_loop.rollouts
  # It is tried again at three knots, each of 10 control steps.
  again = 10 * (3 + 2 + 1) + 3 * _REST
  assert found.control_steps == open_loop.control_steps + again
  for every in (0, 99):
    found = replanning.follow(solver, every=every)
    assert found.plan == open_loop.plan
    assert found.control_steps == open_loop.control_steps


def test_q_learning_replans(policy: pretrained.Policy) -> None:
  config = dataclasses.replace(_SHORT, goal=(5.0, 0.0, 0.5))
  solver = solver_lib.Solver(
    policy, 'flat', config, q_learning.QLearningConfig(2, 3), 1
  )
  reports: list[solver_lib.Status] = []
  found = replanning.follow(solver, every=3, report=reports.append)
  assert len(found.plan.modes) == 4
  searches = [status.search for status in reports]
  assert searches == ['2 trials from 0.00 s'] * 3 + ['2 trials from 0.90 s'] * 3


def test_for_a_fallen_robot_nothing_is_planned(
  policy: pretrained.Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
  solver = solver_lib.Solver(
    policy, 'flat', _CONFIG, beam_search.BeamConfig(1, attempts=1), 1
  )
  found = solver.solve()
  asked: list[int] = []

  def solve(report: Any, robot: Any, guess: Any) -> plan_lib.PlanResult:
    asked.append(robot.remaining)
    rest = found.plan.modes[: robot.remaining]
    plan = plan_lib.ModePlan(rest, found.plan.knot_duration)
    return dataclasses.replace(found, success=False, plan=plan, control_steps=1)

  monkeypatch.setattr(solver, 'solve', solve)
  shove = pushes_lib.Push(0.6, (0.0, 6.0, 0.0))
  fallen = replanning.follow(solver, [shove], 2)
  assert not fallen.success
  assert asked[:2] == [11, 9] and len(asked) < 5
  assert fallen.control_steps == len(asked)
  assert len(fallen.plan.modes) == 11
  assert (fallen.path[-30:] == fallen.path[-1]).all()
