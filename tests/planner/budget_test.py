"""Tests of a planning's budget of seconds, on a toy whose clock they move."""

import functools
import math
from typing import Any

import numpy as np
import pytest

from dmc_multimode import planner
from dmc_multimode import pretrained
from dmc_multimode.modes import library
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import replanning
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.reaching import problem as reaching
from tests.planner import toy as toy_lib

_COMPILATION = 1000.0  # Seconds.
_REPLAY = 6 + 5.0  # Seconds of a single world.
_KNOT = 3.0  # Seconds of a beam of three modes.
_REST = 5.0  # Seconds of the rest of a world.
_NOWHERE = 9.9  # Metres: a goal that no plan reaches.
_MODE_SET = library.mode_set(['idle', 'walk_forward', 'leap_forward'])


class _Policy:
  """All of a policy that a solver asks for."""

  mode_set = _MODE_SET


class _Toy(toy_lib.Toy):
  """A toy that a solver compiles, which takes time."""

  mode_set = _MODE_SET

  def __init__(self, clock: toy_lib.Clock, *args: Any, **others: Any):
    config, num_worlds = args[2:4]
    assert set(others.values()) <= {events.NONE}
    super().__init__(num_worlds, config.knots, config.goal[0], clock)
    self.config = config
    clock.now += _COMPILATION


class _Search:
  """A solver of a toy, and what it reports.

  Attributes:
    clock: moved by the work of the toys.
    solver: plans with one beam at first.
    rows: beams and knot of every report.
  """

  def __init__(
    self,
    monkeypatch: pytest.MonkeyPatch,
    seconds: float | None,
    goal: float = _NOWHERE,
    attempts: int = 3,
  ):
    self.clock = toy_lib.Clock()
    monkeypatch.setattr(
      problem_lib, 'ReachingProblem', functools.partial(_Toy, self.clock)
    )
    policy: Any = _Policy()
    self.solver = solver_lib.Solver(
      policy,
      'flat',
      reaching.ReachingConfig((goal, 0.0, 0.5), 6),
      beam_search.BeamConfig(1, attempts),
      seconds=seconds,
      clock=self.clock,
    )
    self.rows: list[tuple[int, int]] = []

  def report(self, status: solver_lib.Status) -> None:
    self.rows.append((int(status.search.split()[0]), status.done))

  def solve(self) -> plan_lib.PlanResult:
    return self.solver.solve(self.report)

  def knots(self) -> dict[int, int]:
    """Returns the number of knots of the searches by their beams."""
    return dict(self.rows)


def test_without_a_budget_attempts_end_it(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  search = _Search(monkeypatch, None)
  found = search.solve()
  assert search.knots() == {1: 6, 2: 6, 4: 6}
  assert not found.success
  # All that it does counts, compilations of more beams too.
  assert found.solve_seconds == found.control_steps + 2 * _COMPILATION


@pytest.mark.parametrize('seconds', [30.0, 100.0, 500.0, 3000.0, 20_000.0])
def test_a_budget_is_kept(
  seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
  """With more beams whenever a search fails, and without compilations."""
  search = _Search(monkeypatch, seconds, attempts=1)
  found = search.solve()
  assert not found.success
  assert len(found.plan.modes) == 6
  assert found.solve_seconds == found.control_steps
  knots = search.knots()
  beams = list(knots)
  assert beams == [1 << i for i in range(len(beams))]
  assert found.solve_seconds <= seconds
  # And it is not much earlier than it must be.
  assert found.solve_seconds > seconds - 1.25 * _REPLAY - 12 * beams[-1] * _KNOT


def test_a_search_ends_at_the_knot_before_it_would_be_late(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  """In time for a last replay."""
  reserved = 3 * _REST + 1.25 * _REPLAY
  for knots in (1, 2, 3, 5):
    # The knot at first measures the pace of a single world.
    seconds = 1 + (knots + 1) * _KNOT + reserved - 0.1
    search = _Search(monkeypatch, seconds)
    found = search.solve()
    assert search.knots() == {1: knots}
    assert found.rollouts == 3 * knots
    assert found.solve_seconds == found.control_steps <= seconds
    assert found.plan.modes[knots:] == ('idle',) * (6 - knots)
    assert found.plan.modes[0] != 'idle'


def test_one_plan_is_tried_in_any_case(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  search = _Search(monkeypatch, 1e-9)
  found = search.solve()
  assert search.knots() == {1: 1}
  assert found.solve_seconds == 1 + _KNOT + 3 * _REST + _REPLAY
  # The plan of the knot, the farthest of those alive, and rest.
  assert found.plan.modes == ('leap_forward', *['idle'] * 5)
  assert found.final_position[0] == 0.5


def test_within_its_budget_a_search_finds_the_same(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  search = _Search(monkeypatch, None, 1.6, attempts=4)
  found = search.solve()
  assert found.success and len(search.knots()) > 1
  limited = _Search(monkeypatch, 1e6, 1.6, attempts=1)
  same = limited.solve()
  assert limited.rows == search.rows
  assert same.plan == found.plan
  assert same.rollouts == found.rollouts
  np.testing.assert_array_equal(same.path, found.path)


def test_a_plan_that_rests_at_the_goal_succeeds(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  """A search that is stopped ends all, if its plan goes on well."""
  search = _Search(monkeypatch, 1e-9, 0.5)
  found = search.solve()
  assert found.success
  assert search.knots() == {1: 1}


@pytest.mark.parametrize('best', [0, 1, 2])
def test_the_best_so_far_is_returned(
  best: int, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Whichever search it was found by."""
  plans = np.array([[1, 1, 0, 0, 0, 0]] * 3)
  plans[best] = [1, 1, 2, 0, 0, 0]
  left = plans.tolist()

  def given_plan(
    problem: Any, config: beam_search.BeamConfig, report: Any, stop: Any
  ) -> beam_search.Solution:
    plan = np.array([left.pop(0)])
    clock.now += 40.0
    return beam_search.Solution(plan, np.ones(1), np.zeros(1, bool), 7)

  monkeypatch.setattr(beam_search, 'beam_search', given_plan)
  search = _Search(monkeypatch, 3 * (40.0 + _REPLAY), attempts=1)
  clock = search.clock
  found = search.solve()
  assert not left
  assert found.plan.indices(_MODE_SET).tolist() == plans[best].tolist()
  assert found.rollouts == 3 * 7


@pytest.mark.parametrize(('seconds', 'tried'), [(1.0, 1), (40.0, 3), (1e3, 4)])
def test_as_many_plans_are_tried_as_are_in_time(
  seconds: float, tried: int, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Until one succeeds."""
  plans = np.array([[1] * 6] * 3 + [[2, 2, 1, 1, 1, 0]] * 7)

  def given_plans(*args: Any) -> beam_search.Solution:
    return beam_search.Solution(plans, np.ones(10), np.zeros(10, bool), 1)

  monkeypatch.setattr(beam_search, 'beam_search', given_plans)
  found = _Search(monkeypatch, seconds, 1.6).solve()
  assert found.solve_seconds == 1 + tried * _REPLAY
  assert found.success == (tried == 4)


def test_every_planning_has_its_own_budget(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  seconds = 100.0
  search = _Search(monkeypatch, seconds)
  solve, spent = search.solver.solve, []

  def timed(*args: Any) -> plan_lib.PlanResult:
    found = solve(*args)
    spent.append(found.solve_seconds)
    return found

  monkeypatch.setattr(search.solver, 'solve', timed)
  found = replanning.follow(search.solver, every=2)
  assert len(found.plan.modes) == 6
  assert len(spent) == 3
  assert all(seconds / 2 < each <= seconds for each in spent)
  assert found.solve_seconds == sum(spent)


def test_a_planning_in_no_time_still_goes_on(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  """The rest of the former plan is tried before all, and may be all."""
  search = _Search(monkeypatch, 1e-9)
  found = replanning.follow(search.solver, (), 1, search.report)
  assert search.rows == [(1, 1)]
  assert found.plan.modes == ('leap_forward', *['idle'] * 5)


@pytest.mark.parametrize(
  'seconds', [0, -1.0, math.inf, math.nan, True, '2', 10**400]
)
def test_no_budgets(seconds: Any) -> None:
  """Rejected before the policy is looked for."""
  with pytest.raises(ValueError, match='^seconds: Input should be .*got '):
    planner.solve('nobody', seconds=seconds)
  policy: Any = None
  with pytest.raises(ValueError, match='^seconds: '):
    solver_lib.Solver(
      *(policy, 'flat', reaching.ReachingConfig()),
      beam_search.BeamConfig(),
      seconds=seconds,
    )


def test_a_budget_is_of_the_beam_search() -> None:
  for given in ('q_learning', q_learning.QLearningConfig()):
    with pytest.raises(ValueError, match='^seconds is a budget of the beam'):
      planner.solve('nobody', planner=given, seconds=2.0)


def test_a_robots_plan_in_no_time() -> None:
  """Real worlds, real time: a knot of search, and then rest."""
  found = planner.solve(
    pretrained.load('quickstart'),
    'flat',
    problem=reaching.ReachingConfig((0.8, 0.0, 0.5), 5, 0.3),
    planner=beam_search.BeamConfig(2),
    num_threads=1,
    quiet=True,
    seconds=np.float64(1e-9),
  )
  assert not found.success
  assert found.plan.modes[1:] == ('idle',) * 4
  assert found.path.shape[0] == 50 + 50  # Control steps.
  assert found.rollouts == 6
  assert 0 < found.solve_seconds < 30
  assert 'seconds' not in found.origin
