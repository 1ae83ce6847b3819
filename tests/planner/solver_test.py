"""Tests of dmc_multimode.planner.solver, with a policy that can walk."""

import dataclasses
from typing import Any

from dm_control import composer
import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.agents.ppo import acting
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.reaching import problem as reaching
from tests.planner import replay

_REST = 50  # Control steps.
_CONFIG = reaching.ReachingConfig((0.8, 0.0, 0.5), 5, 0.3)
_PLANNERS = (
  beam_search.BeamConfig(beams=3),
  q_learning.QLearningConfig(trials=4, episodes=6),
)


@pytest.fixture(scope='module')
def policy() -> pretrained.Policy:
  return pretrained.load('quickstart')


@pytest.mark.parametrize('planner', _PLANNERS)
def test_solve(
  policy: pretrained.Policy, planner: solver_lib.SearchConfig
) -> None:
  reports: list[solver_lib.Status] = []
  solver = solver_lib.Solver(policy, 'flat', _CONFIG, planner, num_threads=1)
  found = solver.solve(reports.append)
  assert found.success
  assert found.final_position[0] == pytest.approx(0.8, abs=0.3)
  assert found.path.shape == (50 + _REST, 3)
  assert found.seconds == pytest.approx(3.0)
  assert found.final_speed < 0.15
  distances = np.linalg.norm(found.path[:50] - [0.8, 0.0, 0.5], axis=1)
  assert found.episode_return == pytest.approx(np.exp(-distances).sum())
  assert found.control_steps >= 50 * planner.num_worlds(3)
  assert found.solve_seconds > 0
  total = 5 if isinstance(planner, beam_search.BeamConfig) else 6
  assert [row.done for row in reports] == list(range(1, total + 1))
  assert {row.total for row in reports} == {total}
  assert {row.search.split(' ', 1)[1] for row in reports} <= {
    'beams from 0.00 s',
    'trials from 0.00 s',
  }
  replayed = replay.replay(policy, _CONFIG, found.plan)
  np.testing.assert_array_equal(replayed.paths[0], found.path)
  np.testing.assert_array_equal(_in_composer(policy, found), found.path[:50])
  again = solver.solve()
  assert again.plan == found.plan
  assert again.control_steps == found.control_steps


def _in_composer(
  policy: pretrained.Policy, found: plan_lib.PlanResult
) -> np.ndarray:
  """Returns the path of the plan in a Composer environment."""
  config = task_config.evaluated(policy.config, time_limit=found.plan.duration)
  task = multimode_biped.make_task(
    policy.mode_set,
    episodes.ScheduledEpisodes(found.plan.schedule(policy.mode_set)),
    config=config,
  )
  environment: composer.Environment = multimode_biped.make_environment(
    task, random=_CONFIG.seed
  )
  actor = acting.FeedForwardActor(policy.network)
  timestep, path = environment.reset(), []
  while not timestep.last():
    action = actor.select_action(timestep.observation)
    timestep = environment.step(action)
    path.append(environment.physics.data.qpos[:3].copy())
  return np.array(path)


@pytest.mark.slow
@pytest.mark.parametrize('name', reaching.PROBLEMS)
def test_pi2_crosses_the_papers_tracks(name: str) -> None:
  """Table III, with the first two of the beam's attempts."""
  solver = solver_lib.Solver(
    pretrained.load('pi2'),
    name,
    reaching.PROBLEMS[name].config(0),
    beam_search.BeamConfig(attempts=2),
  )
  found = solver.solve()
  assert found.success
  assert found.final_position[0] > 1.7
  # Seconds on two idle cores, where the paper's takes three minutes.
  assert found.control_steps <= 80_000
  assert found.solve_seconds > 0


@pytest.mark.slow
def test_what_cannot_be_reached(policy: pretrained.Policy) -> None:
  """Twice the beams are no use, and the best plan counts, which is alive."""
  config = dataclasses.replace(_CONFIG, goal=(5.0, 0.0, 0.5))
  planner = beam_search.BeamConfig(2, attempts=2)
  solver = solver_lib.Solver(policy, 'flat', config, planner, num_threads=1)
  reports: list[solver_lib.Status] = []
  found = solver.solve(reports.append)
  assert not found.success
  assert found.final_position[0] > 0.4  # As far as it gets.
  assert [row.search for row in reports] == (
    ['2 beams from 0.00 s'] * 5 + ['4 beams from 0.00 s'] * 5
  )
  worlds, alone = 3 * (2 + 4), 6 + 10  # At first there are 6 plans in all.
  assert found.rollouts == 5 * worlds
  assert found.control_steps <= 50 * (worlds + alone) + _REST * alone
  replayed = replay.replay(policy, config, found.plan)
  np.testing.assert_array_equal(replayed.paths[0], found.path)


@pytest.mark.slow
def test_more_beams_find_what_fewer_do_not(
  policy: pretrained.Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
  """And those that do are kept for the next time."""
  walk, idle = [1] * 5, [0] * 5

  def given_plans(
    problem: problem_lib.ReachingProblem,
    config: beam_search.BeamConfig,
    report: Any,
    stop: Any,
  ) -> beam_search.Solution:
    assert problem.num_worlds == 3 * config.beams
    plans = [idle, walk] if config.beams == 4 else [idle, idle]
    asked.append((config.beams, id(problem)))
    report(5, 1.0, 0.0)
    return beam_search.Solution(
      np.array(plans), np.ones(2), np.ones(2, bool), 7
    )

  monkeypatch.setattr(beam_search, 'beam_search', given_plans)
  asked: list[tuple[int, int]] = []
  solver = solver_lib.Solver(
    policy, 'flat', _CONFIG, beam_search.BeamConfig(1), 1
  )
  for _ in range(2):
    found = solver.solve()
    assert found.success
    assert found.plan.modes == ('walk_forward',) * 5
    assert found.rollouts == 3 * 7
    assert found.control_steps == (50 + _REST) * 6
  assert [beams for beams, _ in asked] == [1, 2, 4] * 2
  assert asked[:3] == asked[3:]


def test_every_search_has_the_map(policy: pretrained.Policy) -> None:
  config = reaching.ReachingConfig((0.4, 0.0, 0.5), 2, 0.3)
  solver = solver_lib.Solver(
    policy, 'block', config, beam_search.BeamConfig(1, 1), 1, map_error=0.05
  )
  solver.solve()
  for problem in (solver._alone, *solver._problems.values()):
    np.testing.assert_allclose(problem.terrain.starts[:, 1], 0.75)
  np.testing.assert_allclose(solver.make_robot().terrain.starts[:, 1], 0.8)


def test_from_where_a_robot_is(policy: pretrained.Policy) -> None:
  """The plan is of the knots that are left, and a good guess is kept."""
  solver = solver_lib.Solver(
    policy, 'flat', _CONFIG, beam_search.BeamConfig(3, 1), 1
  )
  robot = solver.make_robot()
  for _ in range(3):
    robot.run_knot(np.array([1]))
  found = solver.solve(robot=robot)
  assert found.success
  assert found.path.shape == (20 + _REST, 3)
  indices = found.plan.indices(robot.mode_set)
  assert len(indices) == 2
  guessed = solver.solve(robot=robot, guess=indices)
  assert guessed.plan == found.plan
  assert (guessed.rollouts, guessed.control_steps) == (0, 20 + _REST)
  knots = [robot.run_knot(mode[None]) for mode in indices]
  trial = problem_lib.trials(knots, robot.rest())
  np.testing.assert_array_equal(trial.paths[0], found.path)
