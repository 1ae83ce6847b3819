"""Tests of dmc_multimode.planner.beam_search and q_learning, on a toy."""

import itertools
from typing import Any

import numpy as np
import pytest

from dmc_multimode.planner import beam_search
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.suite.reaching import problem as reaching

# Metres that the modes move: none, a step, a jump.
_STRIDES = np.array([0.0, 0.2, 0.5])
_HOLE = (0.55, 0.85)  # Who is here at a knot has fallen.


class _Toy:
  """A point that steps and jumps along x; stands in for ReachingProblem."""

  def __init__(self, num_worlds: int, knots: int = 6, goal: float = 1.6):
    self.config = reaching.ReachingConfig((goal, 0.0, 0.5), knots)
    self.num_worlds, self.num_modes = num_worlds, len(_STRIDES)
    self.knots = knots
    self.control_steps = 0
    self.reset()

  def reset(self) -> None:
    self.x = np.zeros(self.num_worlds)
    self.alive = np.ones(self.num_worlds, dtype=bool)

  @property
  def phase(self) -> np.ndarray:
    return np.zeros(self.num_worlds)

  def copy_state(self, sources: np.ndarray) -> None:
    self.x, self.alive = self.x[sources], self.alive[sources]

  def run_knot(self, modes: np.ndarray) -> problem_lib.Progress:
    self.x = self.x + _STRIDES[modes]
    self.alive &= ~((self.x > _HOLE[0]) & (self.x < _HOLE[1]))
    self.control_steps += self.num_worlds
    distance = np.abs(self.config.goal[0] - self.x)
    path = np.zeros((1, self.num_worlds, 3))
    path[0, :, 0] = self.x
    return problem_lib.Progress(
      np.where(self.alive, np.exp(-distance), 0.0),
      path,
      self.alive.copy(),
    )

  def rest(self) -> problem_lib.Rest:
    return problem_lib.Rest(
      np.zeros((1, self.num_worlds, 3)),
      np.zeros(self.num_worlds),
      self.alive.copy(),
      self.alive & (np.abs(self.config.goal[0] - self.x) < 0.05),
    )


def _optimum(knots: int) -> float:
  """The best return of all plans that reach the goal."""
  plans = np.array(list(itertools.product(range(3), repeat=knots)))
  toy = _Toy(len(plans), knots)
  progress = [toy.run_knot(modes) for modes in plans.T]
  returns = np.sum([p.reward for p in progress], axis=0)
  return float(returns[toy.rest().reached].max())


def _return_of(plan: np.ndarray) -> float:
  toy = _Toy(1, len(plan))
  return float(sum(toy.run_knot(mode[None]).reward[0] for mode in plan))


@pytest.mark.parametrize('beams', [6, 24])
def test_beam_search_finds_the_best_plan(beams: int) -> None:
  toy: Any = _Toy(3 * beams)
  reports: list[tuple[int, float, float]] = []
  found = beam_search.beam_search(
    toy, beam_search.BeamConfig(beams), lambda *row: reports.append(row)
  )
  assert found.success[0]
  assert found.returns[0] == pytest.approx(_optimum(6))
  assert _return_of(found.plans[0]) == pytest.approx(found.returns[0])
  # Those that succeed come first, each part by return.
  assert (np.diff(found.success.astype(int)) <= 0).all()
  kept = found.returns[found.success]
  assert (np.diff(kept) <= 0).all()
  assert len({tuple(plan) for plan in found.plans}) == len(found.plans)
  assert [row[0] for row in reports] == [1, 2, 3, 4, 5, 6]
  assert reports[-1][2] == pytest.approx(0.0, abs=1e-9)


def test_a_single_beam_is_greedy_and_goes_too_far() -> None:
  toy: Any = _Toy(3)
  found = beam_search.beam_search(toy, beam_search.BeamConfig(1))
  assert not found.success.any()
  assert _return_of(found.plans[0]) == pytest.approx(found.returns[0])


def test_beam_search_where_all_fall() -> None:
  toy: Any = _Toy(9)
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
  toy: Any = _Toy(9)
  toy.config = reaching.ReachingConfig((1.6, 0.0, 0.5), 11)
  found = beam_search.beam_search(toy, beam_search.BeamConfig(3))
  assert found.plans.shape[1] == 6
  learned = q_learning.q_learning(toy, q_learning.QLearningConfig(9, 2))
  assert learned.plans.shape == (18, 6)


@pytest.mark.parametrize('seed', range(3))
def test_q_learning_finds_a_plan(seed: int) -> None:
  toy: Any = _Toy(5)
  toy.config = reaching.ReachingConfig((1.6, 0.0, 0.5), 6, seed=seed)
  reports: list[tuple[int, float, float]] = []
  found = q_learning.q_learning(
    toy, q_learning.QLearningConfig(), lambda *row: reports.append(row)
  )
  assert found.success[0]
  assert found.returns[0] > 0.9 * _optimum(6)
  assert _return_of(found.plans[0]) == pytest.approx(found.returns[0])
  assert found.episodes == len(found.plans) == 500
  assert toy.control_steps == 500 * 6
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
  toy: Any = _Toy(7)
  with pytest.raises(ValueError, match='6 worlds, the problem has 7'):
    beam_search.beam_search(toy, beam_search.BeamConfig(2))
  with pytest.raises(ValueError, match='as many worlds, not 7'):
    q_learning.q_learning(toy, q_learning.QLearningConfig())
