"""Tests of dmc_multimode.viewer.autopilot, in a session."""

import dataclasses

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import steering
from dmc_multimode.viewer import autopilot
from dmc_multimode.viewer import session as session_lib
from tests.viewer import stepping


@pytest.fixture(scope='module')
def selector() -> selector_lib.Selector:
  return steering.load(steering.SteeringConfig(), 'pi2')


@pytest.fixture
def session(selector: selector_lib.Selector) -> session_lib.LiveSession:
  return session_lib.LiveSession(
    pretrained.load('pi2'), session_lib.ENDLESS, selector=selector
  )


def test_it_goes_forwards_until_somebody_commands(
  session: session_lib.LiveSession,
) -> None:
  session.set_autopilot(True)
  state = stepping.run(session, 4.0, lambda state: state.down)
  assert not state.down
  assert state.step.position[0] > 1.0
  session.command('idle')
  assert not session.autopilot
  assert stepping.run(session, 1.0).running == 'idle'


def test_it_chooses_once_a_knot(
  session: session_lib.LiveSession, selector: selector_lib.Selector
) -> None:
  pilot = autopilot.Autopilot(
    selector, pretrained.load('pi2'), session.robot, goal=(2.0, 0.0, 0.5)
  )
  knot = round(selector.knot_duration / session.robot.task.control_timestep)
  chosen = [pilot.choose() is not None for _ in range(3 * knot)]
  assert np.flatnonzero(chosen).tolist() == [0, knot, 2 * knot]


def test_a_blend_is_left_first(session: session_lib.LiveSession) -> None:
  session.blend('idle', 'walk_forward', 0.5)
  session.step()
  assert session.robot.task.mode not in session.modes
  session.set_autopilot(True)
  session.step()
  assert session.robot.task.mode == session.modes[0]


def test_a_foreign_selector_is_refused(
  selector: selector_lib.Selector,
) -> None:
  with pytest.raises(ValueError, match='for the policy'):
    session_lib.LiveSession(
      pretrained.load('pi2'),
      selector=dataclasses.replace(selector, mode_names=('idle', 'hop')),
    )


def test_without_a_selector_there_is_none() -> None:
  session = session_lib.LiveSession(pretrained.load('pi2'))
  assert not session.has_selector
  with pytest.raises(ValueError, match='no selector'):
    session.set_autopilot(True)
