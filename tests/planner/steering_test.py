"""Tests of dmc_multimode.planner.steering, with the shipped selector of pi2."""

import pytest

import dmc_multimode as dmm
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import events


def test_the_shipped_selector_runs_a_track_that_it_has_never_seen() -> None:
  found = dmm.plan('pi2', 'parkour', seed=0, planner='selector', quiet=True)
  assert found.success
  assert {'launch', 'leap_forward'} < set(found.plan.modes)
  assert found.origin['decision_ms'] > 0
  ice = events.fixed(friction=0.1)
  found = dmm.plan(
    'pi2', 'parkour', seed=0, planner='selector', quiet=True, disturbed=ice
  )
  assert not found.success


def test_policies_without_a_selector() -> None:
  assert steering.is_beside('pi2') and not steering.is_beside('quickstart')
  with pytest.raises(FileNotFoundError, match='no selector beside it: train'):
    steering.load(steering.SteeringConfig(), 'quickstart')


def test_a_selector_of_another_policy_is_refused() -> None:
  selector = steering.load(steering.SteeringConfig(), 'pi2')
  steering.check(selector, selector.mode_names, selector.layout)
  for names, layout in (
    (selector.mode_names[::-1], selector.layout),
    (selector.mode_names, selector.layout[1:]),
  ):
    with pytest.raises(ValueError, match='made for the policy pi2'):
      steering.check(selector, names, layout)
