"""Tests of dmc_multimode.planner.guided_search, with pi2 and its selector."""

import numpy as np
import pytest
import torch

import dmc_multimode as dmm
from dmc_multimode import planner
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import guided_search
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.reaching import environment
from dmc_multimode.suite.reaching import problem as reaching
from tests.planner import replay


def test_the_default_of_a_policy_with_a_selector_solves_a_random_track() -> (
  None
):
  found = dmm.plan('pi2', 'parkour', seed=1, quiet=True)
  assert found.origin['planner'] == 'guided' and found.success
  assert found.plan.knot_duration == pytest.approx(0.15)
  samples = guided_search.GuidedConfig().samples
  # It ends where the first robot stands, and the plan rests from there on.
  knots = found.rollouts // samples
  assert found.rollouts == samples * knots and knots < len(found.plan.modes)
  assert set(found.plan.modes[knots:]) == {'idle'}
  policy = environment.load_policy('pi2')
  again = replay.replay(
    policy,
    reaching.random_problem(1, 'parkour'),
    found.plan,
    arena='parkour',
  )
  np.testing.assert_array_equal(again.paths[0], found.path)


def test_other_policies_have_a_beam_search() -> None:
  assert solver_lib.default_name('quickstart') == 'beam'
  with pytest.raises(FileNotFoundError, match='no selector beside it'):
    dmm.plan('quickstart', 'gap', planner='guided')
  with pytest.raises(ValueError, match='needs a selector'):
    solver_lib.Solver(
      environment.load_policy('quickstart'),
      'gap',
      reaching.PROBLEMS['gap'].config(0),
      planner.GuidedConfig(),
    )


def test_beams_follow_where_samples_fail() -> None:
  kinds = [
    (type(config), getattr(config, 'samples', 0))
    for config in guided_search.GuidedConfig(8, attempts=2).escalation()
  ]
  beams = [(beam_search.BeamConfig, 0)] * beam_search.BeamConfig().attempts
  guided = guided_search.GuidedConfig
  assert kinds == [(guided, 8), (guided, 16), *beams]
  endless = [
    config.samples for config in guided_search.GuidedConfig().doubling()
  ]
  assert endless == [32, 64, 128, 256, 512, 1024, 2048, 4096]


def test_robots_draw_at_rising_temperatures() -> None:
  selector = steering.load(steering.SteeringConfig(), 'pi2')
  seen = np.zeros(sum(size for _, size in selector.layout), dtype=np.float32)
  obeyed = np.array([True, True, False, True])
  scores = selector.network(
    torch.from_numpy(seen[None]), torch.from_numpy(obeyed[None])
  )[0]
  random_state = np.random.RandomState(0)
  drawn = np.array(
    [
      selector.sample(
        np.tile(seen, (3, 1)), np.tile(obeyed, (3, 1)), random_state, 9.0
      )
      for _ in range(4000)
    ]
  )
  assert set(drawn[:, 0]) == {int(scores.argmax())}
  for world, temperature in ((1, 3.0), (2, 9.0)):
    wanted = torch.softmax(scores / temperature, 0).detach().numpy()
    found = np.bincount(drawn[:, world], minlength=4) / len(drawn)
    np.testing.assert_allclose(found, wanted, atol=0.03)


def test_fallen_robots_go_on_from_those_with_the_best_prospects() -> None:
  alive = np.array([False, True, False, True, True, False, False])
  values = np.array([9.0, 0.1, 9.0, 0.3, 0.2, 9.0, 9.0])
  sources = guided_search._resampled(alive, values)
  assert sources.tolist() == [3, 1, 4, 3, 4, 1, 3]


def test_a_budget_ends_it_in_mid_search() -> None:
  found = dmm.plan('pi2', 'parkour', seed=1, quiet=True, seconds=0.2)
  assert found.origin['planner'] == 'guided'
  knots = reaching.random_problem(1, 'parkour').knots
  assert found.rollouts < knots * guided_search.GuidedConfig().samples / 2
  assert len(found.plan.modes) == knots
