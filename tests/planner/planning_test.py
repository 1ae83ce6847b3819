"""Tests of dmc_multimode.planner.planning, with a policy that can walk."""

import dataclasses

from dm_control import composer
import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.agents.ppo import acting
from dmc_multimode.arenas import track
from dmc_multimode.modes import reference
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import planning
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import search
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite import reaching

_CONFIG = reaching.ReachingConfig((0.8, 0.0, 0.5), 5, 0.3)
_PLANNERS = (
  search.BeamConfig(beams=3),
  q_learning.QLearningConfig(trials=4, episodes=6),
)


@pytest.fixture(scope='module')
def policy() -> pretrained.Policy:
  return pretrained.load('quickstart')


@pytest.mark.parametrize('planner', _PLANNERS)
def test_solve_and_replay(
  policy: pretrained.Policy, planner: planning.PlannerConfig
) -> None:
  reports: list[tuple[int, float, float]] = []
  solver = planning.Solver(
    policy, lambda: track.make('flat'), _CONFIG, planner, num_threads=1
  )
  found = solver.solve(lambda *row: reports.append(row))
  assert found.success
  assert found.final_position[0] == pytest.approx(0.8, abs=0.3)
  assert found.path.shape == (50, 3)
  distances = np.linalg.norm(found.path - [0.8, 0.0, 0.5], axis=1)
  assert found.episode_return == pytest.approx(np.exp(-distances).sum())
  assert found.control_steps >= 50 * planning.num_worlds(planner, 3)
  assert found.solve_seconds > 0
  assert reports
  replayed = planning.replay(policy, track.make('flat'), _CONFIG, found.plan)
  np.testing.assert_array_equal(replayed.paths[0], found.path)
  np.testing.assert_array_equal(_in_composer(policy, found), found.path)


def _in_composer(
  policy: pretrained.Policy, found: planning.Found
) -> np.ndarray:
  """Returns the path of the plan in a Composer environment."""
  config = dataclasses.replace(
    config_lib.for_evaluation(policy.config),
    time_limit=found.plan.duration,
  )
  motions = policy.motions
  bank = reference.ReferenceBank(motions)
  task = multimode_biped.make_task(
    motions,
    policy.codebook,
    episodes.ScheduledEpisodes(found.plan.schedule(bank)),
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


def test_replay_rejects_another_plan(policy: pretrained.Policy) -> None:
  plan = plan_lib.ModePlan(('idle',) * 4, 0.3)
  with pytest.raises(ValueError, match='other knots'):
    planning.replay(policy, track.make('flat'), _CONFIG, plan)
  plan = plan_lib.ModePlan(('idle',) * 4 + ('launch',), 0.3)
  with pytest.raises(ValueError, match="'launch', which the policy does not"):
    planning.replay(policy, track.make('flat'), _CONFIG, plan)


def test_what_cannot_be_reached(policy: pretrained.Policy) -> None:
  config = dataclasses.replace(_CONFIG, goal=(5.0, 0.0, 0.5))
  solver = planning.Solver(
    policy, lambda: track.make('flat'), config, _PLANNERS[0], num_threads=1
  )
  found = solver.solve()
  assert not found.success
  assert found.final_position[0] > 0.4  # As far as it gets.
