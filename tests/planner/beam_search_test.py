"""Tests of dmc_multimode.planner.beam_search and q_learning, on a toy."""

import itertools
from typing import Any

import numpy as np
import pytest

from dmc_multimode.planner import beam_search
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.suite.reaching import problem as reaching
from tests.planner import toy as toy_lib


def _optimum(knots: int) -> float:
  """The best return of all plans that reach the goal."""
  plans = np.array(list(itertools.product(range(3), repeat=knots)))
  toy = toy_lib.Toy(len(plans), knots)
  progress = [toy.run_knot(modes) for modes in plans.T]
  returns = np.sum([p.reward for p in progress], axis=0)
  return float(returns[toy.rest().reached].max())


@pytest.mark.parametrize('beams', [6, 24])
def test_beam_search_finds_the_best_plan(beams: int) -> None:
  toy: Any = toy_lib.Toy(3 * beams)
  reports: list[tuple[int, float, float]] = []
  found = beam_search.beam_search(
    toy, beam_search.BeamConfig(beams), lambda *row: reports.append(row)
  )
  assert found.success[0]
  assert found.returns[0] == pytest.approx(_optimum(6))
  assert toy_lib.return_of(found.plans[0]) == pytest.approx(found.returns[0])
  # Those that succeed come first, each part by return.
  assert (np.diff(found.success.astype(int)) <= 0).all()
  kept = found.returns[found.success]
  assert (np.diff(kept) <= 0).all()
  assert len({tuple(plan) for plan in found.plans}) == len(found.plans)
  assert [row[0] for row in reports] == [1, 2, 3, 4, 5, 6]
  assert reports[-1][2] == pytest.approx(0.0, abs=1e-9)


def test_a_single_beam_is_greedy_and_goes_too_far() -> None:
  toy: Any = toy_lib.Toy(3)
  found = beam_search.beam_search(toy, beam_search.BeamConfig(1))
  assert not found.success.any()
  assert toy_lib.return_of(found.plans[0]) == pytest.approx(found.returns[0])


def test_beam_search_where_all_fall() -> None:
  toy: Any = toy_lib.Toy(9)
  fall = toy.run_knot

  def run_knot(modes: np.ndarray) -> problem_lib.Progress:
    progress = fall(modes)
    if toy.control_steps > 9:
      progress.alive[:] = toy.alive[:] = False
      progress.reward[:] = 0.0
    return progress

  toy.run_knot = run_knot
  found = beam_search.beam_search(toy, beam_search.BeamConfig(3))
  assert not found.success.any()
  assert found.plans.shape[1] == 6


@pytest.mark.parametrize('last', [1, 3, 6])
def test_a_search_that_is_stopped(last: int) -> None:
  """The plans of the last front go on with rest."""
  toy: Any = toy_lib.Toy(9)
  toy.rest_mode = 2
  ahead: list[float] = []

  def stop(seconds: float) -> bool:
    ahead.append(seconds)
    return len(ahead) == last

  found = beam_search.beam_search(toy, beam_search.BeamConfig(3), stop=stop)
  # A knot and a rest, or the rest alone.
  assert ahead == pytest.approx([1.8] * min(last, 5) + [1.5] * (last == 6))
  assert found.episodes == 9 * last
  assert found.plans.shape[1] == 6
  assert (found.plans[:, last:] == 2).all()
  returns = [toy_lib.return_of(plan[:last]) for plan in found.plans]
  assert found.returns == pytest.approx(returns)
  # Those that have not fallen come first, each part by return; they alone rest.
  alive = [toy_lib.is_alive(plan[:last]) for plan in found.plans]
  assert alive == sorted(alive, reverse=True)
  kept = found.returns[alive]
  assert (np.diff(kept) <= 0).all()
  assert toy.control_steps == 9 * last + 5 * len(kept)


def test_who_falls_in_the_rest_comes_after_those_who_stand() -> None:
  """However far the jump was in the middle of which the search was stopped."""
  toy: Any = toy_lib.Toy(9)
  rest = toy.rest

  def fall_where_far(moved: np.ndarray) -> problem_lib.Rest:
    ended: problem_lib.Rest = rest(moved)
    stands = ended.alive & (toy.x < 0.6)
    return ended._replace(alive=stands, reached=np.zeros_like(stands))

  toy.rest = fall_where_far
  calls = iter([False, True])
  found = beam_search.beam_search(
    toy, beam_search.BeamConfig(3), stop=lambda ahead: next(calls)
  )
  ends = toy_lib.STRIDES[found.plans].sum(axis=1)
  assert ends[0] == 0.5 and ends.max() == 1.0
  stands = ends < 0.6
  assert stands.tolist() == sorted(stands, reverse=True)


def test_where_a_search_is_stopped_few_rest(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  """The best of every place, so that work is little where worlds are many."""
  monkeypatch.setattr(beam_search, '_RESTED', 3)
  toy: Any = toy_lib.Toy(18)
  calls = iter([False, True])
  found = beam_search.beam_search(
    toy, beam_search.BeamConfig(6), stop=lambda ahead: next(calls)
  )
  assert toy.control_steps == 18 * 2 + 3 * 5
  ends = toy_lib.STRIDES[found.plans[:3]].sum(axis=1)
  assert ends == pytest.approx([1.0, 0.5, 0.4])
  work = beam_search.least_work
  assert work(0.3, 3) == pytest.approx(0.3 + 1.5)
  assert work(0.3, 6) == pytest.approx(0.3 + 1.5 * (0.25 + 0.75 / 2))


def test_who_is_never_stopped_finds_the_same() -> None:
  config = beam_search.BeamConfig(6)
  toys: list[Any] = [toy_lib.Toy(18), toy_lib.Toy(18)]
  found = beam_search.beam_search(toys[0], config)
  again = beam_search.beam_search(toys[1], config, stop=lambda ahead: False)
  for mine, theirs in zip(found, again, strict=True):
    np.testing.assert_array_equal(mine, theirs)
  assert toys[0].control_steps == toys[1].control_steps


def test_beams_double() -> None:
  """As often as they may, and then until they no longer fit into memory."""
  config = beam_search.BeamConfig(24, attempts=3)
  assert [each.beams for each in config.escalation()] == [24, 48, 96]
  doubling = list(config.doubling())
  assert doubling[:3] == config.escalation()
  assert [each.beams for each in doubling] == [24 << i for i in range(8)]
  many = beam_search.BeamConfig(5000)
  assert [each.beams for each in many.doubling()] == [5000]


def test_the_best_of_each_cell_are_kept_first() -> None:
  """States that differ in phase alone are not crowded out by better ones."""
  place = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
  mode = np.zeros(6)
  phase = np.array([0.0, 0.0, 0.0, 3.0, 3.0, 0.0])
  returns = np.array([9.0, 8.0, 7.0, 2.0, 1.0, 0.0])
  worth = np.array([True, True, True, True, True, True])
  cells = np.stack([place, mode, phase])
  select = lambda count: beam_search._select(
    cells, returns, worth, count
  ).tolist()
  assert select(1) == [0]
  assert select(3) == [0, 3, 5]
  assert select(9) == [0, 3, 5, 1, 4, 2]
  worth[3] = False
  assert select(3) == [0, 4, 5]


def test_plans_are_as_long_as_the_problem() -> None:
  """Which is shorter where the plan begins on the way."""
  toy: Any = toy_lib.Toy(9)
  toy.config = reaching.ReachingConfig((1.6, 0.0, 0.5), 11)
  found = beam_search.beam_search(toy, beam_search.BeamConfig(3))
  assert found.plans.shape[1] == 6
  learned = q_learning.q_learning(toy, q_learning.QLearningConfig(9, 2))
  assert learned.plans.shape == (18, 6)


@pytest.mark.parametrize('seed', range(3))
def test_q_learning_finds_a_plan(seed: int) -> None:
  toy: Any = toy_lib.Toy(5)
  toy.config = reaching.ReachingConfig((1.6, 0.0, 0.5), 6, seed=seed)
  reports: list[tuple[int, float, float]] = []
  found = q_learning.q_learning(
    toy, q_learning.QLearningConfig(), lambda *row: reports.append(row)
  )
  assert found.success[0]
  assert found.returns[0] > 0.9 * _optimum(6)
  assert toy_lib.return_of(found.plans[0]) == pytest.approx(found.returns[0])
  assert found.episodes == len(found.plans) == 500
  assert toy.control_steps == 500 * toy.plan_steps
  assert [row[0] for row in reports] == list(range(1, 101))


def test_q_tables_by_hand() -> None:
  config = q_learning.QLearningConfig(learning_rate=0.5, discount=0.9)
  tables = q_learning.QTables(2, 2, 2, config)
  plans, rewards = (
    np.array([[0, 1], [1, 0]]),
    np.array([[1.0, 2.0], [0.0, 4.0]]),
  )
  tables.update(plans, rewards)
  # Last knots: half of 2 and of 4. First: half of 1 + 0.9 x 1, of 0.9 x 2.
  np.testing.assert_allclose(
    tables.values, [[[0.95, 0.0], [0.0, 1.0]], [[0.0, 0.9], [2.0, 0.0]]]
  )
  tables.update(plans[:, ::-1], np.zeros((2, 2)))
  # First: half of 0 + 0.9 x 1 for a new mode, of 0 + 0.9 x 2.
  np.testing.assert_allclose(
    tables.values, [[[0.95, 0.45], [0.0, 1.0]], [[0.9, 0.9], [2.0, 0.0]]]
  )


def test_epsilon_greedy() -> None:
  config = q_learning.QLearningConfig(4000, 11, initial_epsilon=1.0)
  tables = q_learning.QTables(4000, 1, 4, config)
  tables.values[:, 0, 2] = 1.0
  assert [config.epsilon(i) for i in (0, 5, 10)] == pytest.approx(
    [1.0, 0.525, 0.05]
  )
  state = np.random.RandomState(0)
  for epsilon, share in ((0.0, 1.0), (0.4, 0.7), (1.0, 0.25)):
    found = tables.act(0, epsilon, state)
    assert np.mean(found == 2) == pytest.approx(share, abs=0.03)
  tables.values[:] = 0.0  # Ties.
  counts = np.bincount(tables.act(0, 0.0, state), minlength=4)
  np.testing.assert_allclose(counts / 4000, 0.25, atol=0.03)


@pytest.mark.parametrize(
  ('time', 'stays'),
  # What is drawn anew is the same mode in one of four cases.
  [(0.0, 0.25), (0.3, 0.25), (0.6, 0.5 + 0.5 / 4), (1.2, 0.75 + 0.25 / 4)],
)
def test_exploration_lasts(time: float, stays: float) -> None:
  config = q_learning.QLearningConfig(exploration_time=time)
  tables = q_learning.QTables(4000, 3, 4, config, knot_duration=0.3)
  state = np.random.RandomState(0)
  plan = [tables.act(knot, 1.0, state) for knot in range(3)]
  for before, after in zip(plan[:-1], plan[1:], strict=True):
    assert np.mean(before == after) == pytest.approx(stays, abs=0.03)
  # A new episode begins anew, and greedy knots are greedy.
  again = tables.act(0, 1.0, state)
  assert np.mean(plan[-1] == again) == pytest.approx(0.25, abs=0.03)
  tables.values[:, :, 1] = 1.0
  assert (tables.act(0, 0.0, state) == 1).all()


def test_planners_reject_other_numbers_of_worlds() -> None:
  toy: Any = toy_lib.Toy(7)
  with pytest.raises(ValueError, match='6 worlds, the problem has 7'):
    beam_search.beam_search(toy, beam_search.BeamConfig(2))
  with pytest.raises(ValueError, match='as many worlds, not 7'):
    q_learning.q_learning(toy, q_learning.QLearningConfig())
