"""Tests of dmc_multimode.viewer.session: sessions, without any page."""

import functools
import time

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.planner import beam_search
from dmc_multimode.suite.imitation import events
from dmc_multimode.viewer import disturbing
from dmc_multimode.viewer import session as session_lib
from tests.viewer import stepping

_PATIENCE = 120.0  # Seconds for a search.


@pytest.fixture(scope='module')
def session() -> session_lib.LiveSession:
  return session_lib.LiveSession(pretrained.load('pi2'))


def _runs(running: str, state: session_lib.LiveState) -> bool:
  return state.running == running


def test_launch_lands_on_the_block(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  state = stepping.run(session, 0.6)
  assert (state.step.mode, state.down, state.notice) == ('idle', False, '')
  assert state.step.position[2] == pytest.approx(0.5, abs=0.06)
  assert 0.5 < state.step.reward <= 1
  session.command('launch')
  state = stepping.run(session, 2.1)
  assert (state.step.mode, state.down) == ('launch', False)
  assert state.step.position[2] == pytest.approx(0.9, abs=0.06)
  assert state.step.height == pytest.approx(0.5, abs=0.06)
  session.reset()
  state = stepping.run(session, 0.3)
  assert state.step.mode == 'idle'
  assert state.step.position[2] == pytest.approx(0.5, abs=0.06)


def test_the_clock_rate_lasts(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  session.command('walk_forward')
  phase = session.robot.task.core.tracker.state.phase
  gone = []
  for rate in (0.5, 1.0):
    session.set_clock_rate(rate)
    before = phase[0]
    session.step()
    gone.append(phase[0] - before)
  assert gone[1] == pytest.approx(2 * gone[0])
  session.set_clock_rate(1.25)
  session.reset()
  assert session.robot.task.core.tracker.state.clock_rate[0] == 1.25
  session.set_clock_rate(1.0)


def test_pushes_move_and_are_seen(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  stepping.run(session, 0.3)
  before = session.robot.task.observation['velocity'][0].copy()
  session.push((0.0, 0.5))
  seen = session.robot.task.observation['velocity'][0] - before
  assert np.linalg.norm(seen) == pytest.approx(0.5, abs=1e-6)
  assert stepping.run(session, 0.15).step.position[1] > 0.01


def test_a_fall_is_told_and_undone(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  for _ in range(3):
    session.push((0.0, 3.0))
  state = stepping.run(session, 3.0, lambda state: state.down)
  assert state.step.cause == 'base_height'
  assert state.notice == 'It has fallen.'
  state = stepping.run(session, 3.0, lambda state: not state.down)
  assert 'put back to the start' in state.notice
  assert not session.step().down
  assert abs(session.robot.position[1]) < 0.05
  session.command('walk_forward')
  assert 'put back to the start' in session.step().notice
  session.dismiss()
  assert session.step().notice == ''


def test_a_robot_that_falls_on_the_endless_track_starts_on_new_ground(
  session: session_lib.LiveSession,
) -> None:
  session.set_arena(session_lib.ENDLESS)
  starts = session.robot.task.root_entity.terrain.starts.copy()
  for _ in range(3):
    session.push((0.0, 3.0))
  stepping.run(session, 3.0, lambda state: state.down)
  state = stepping.run(session, 3.0, lambda state: not state.down)
  assert 'on new ground' in state.notice
  terrain = session.robot.task.root_entity.terrain
  assert not np.array_equal(terrain.starts, starts)
  session.reset()
  again = session.robot.task.root_entity.terrain.starts
  np.testing.assert_array_equal(again, starts)


def test_a_state_that_is_not_finite_is_told_and_undone(
  session: session_lib.LiveSession,
) -> None:
  session.set_arena('parkour', seed=4)
  starts = session.robot.task.root_entity.terrain.starts
  session.step()
  session.robot.physics.data.qvel[:] = np.nan
  state = session.step()
  assert (state.down, state.step.cause) == (True, 'non_finite')
  assert 'not finite' in state.notice
  state = stepping.run(session, 3.0, lambda state: not state.down)
  assert 'put back to the start' in state.notice
  assert np.isfinite(session.robot.physics.data.qpos).all()
  assert session.step().step.cause == 'none'
  # On the same track.
  assert (session.arena, session.seed) == ('parkour', 4)
  again = session.robot.task.root_entity.terrain.starts
  np.testing.assert_array_equal(again, starts)


def test_plan_and_replay() -> None:
  session = session_lib.LiveSession(
    pretrained.load('quickstart'), planner=beam_search.BeamConfig(2, 1)
  )
  with pytest.raises(ValueError, match='no plan for this track'):
    session.replay()
  session.set_clock_rate(0.8)
  session.plan()
  with pytest.raises(ValueError, match='already'):
    session.plan()
  begun = time.monotonic()
  while (state := session.step()).searching:
    assert time.monotonic() - begun < _PATIENCE
    time.sleep(0.002)  # The planner has one interpreter with us.
  assert state.plan is not None
  assert 'A plan that' in state.notice
  session.replay()
  assert session.clock_rate == 1.0
  duration = state.plan.plan.duration
  state = stepping.run(session, duration)
  assert state.replaying and state.plan
  # One world of a batch and Composer's physics part by rounding alone.
  np.testing.assert_allclose(
    state.step.position,
    state.plan.path[round(duration / 0.03) - 1],
    atol=0.05,
  )
  state = session.step()
  assert (state.replaying, state.notice) == (False, 'The plan is done.')
  session.replay()
  session.step()
  session.command('walk_forward')
  assert not session.step().replaying
  session.plan()
  session.set_arena('gap')
  state = session.step()
  assert (state.searching, state.plan) == (None, None)
  session.close()


def test_a_climbing_mode_keeps_its_clock_rate(
  session: session_lib.LiveSession,
) -> None:
  session.set_arena('flat')
  session.set_clock_rate(3.0)
  session.command('launch')
  assert session.step().notice == 'launch keeps its own clock rate.'
  assert session.robot.task.core.tracker.state.clock_rate[0] == 1.0


def test_speed_of_gaits(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  session.set_speed(0.5)
  session.command('walk_forward')
  state = session.step()
  assert state.step.mode == 'walk_forward'
  task = session.robot.task
  assert task.mode == 'walk_forward*0.5+idle*0.5'
  bank, running = task.mode_set.bank, task.core.tracker.state.mode
  np.testing.assert_allclose(bank.displacements[running, 0], 0.18)
  session.set_speed(1.0)
  session.step()
  assert task.mode == 'walk_forward'
  session.command('leap_forward')  # It has no slower one.
  session.set_speed(0.3)
  assert stepping.run(session, 3.0, lambda s: s.step.mode == 'leap_forward')
  session.set_speed(1.0)


def test_blends(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  assert session.blends.pairs == (
    ('walk_forward', 'idle'),
    ('leap_forward', 'idle'),
  )
  for first, second, share, running, main in (
    ('walk_forward', 'idle', 0.9, 'walk_forward*0.1+idle*0.9', 'walk_forward'),
    ('idle', 'leap_forward', 0.7, 'leap_forward*0.7+idle*0.3', 'leap_forward'),
    ('idle', 'leap_forward', 0.0, 'idle', 'idle'),
    ('idle', 'walk_forward', 1.0, 'walk_forward', 'walk_forward'),
  ):
    session.blend(first, second, share)
    blended = functools.partial(_runs, running)
    state = stepping.run(session, 3.0, blended)
    assert (state.running, state.step.mode) == (running, main)


def test_disturbances_change_where_the_robot_is() -> None:
  session = session_lib.LiveSession(pretrained.load('pi2'))
  session.command('walk_forward')
  stepping.run(session, 1.0)
  x = session.robot.position[0]
  model = session.robot.physics.model
  before = {
    name: getattr(model, name).copy()
    for name in ('body_mass', 'geom_friction', 'actuator_gainprm', 'dof_M0')
  }
  values = {
    'payload': 2.0,
    'friction': 0.3,
    'motor_strength': 0.8,
    'action_delay': 0.06,
  }
  for name, value in values.items():
    session.disturb(**{name: value})
    assert session.disturbance(name) == value
  assert model.body_mass.sum() == pytest.approx(
    before['body_mass'].sum() + 2.0, abs=1e-6
  )
  np.testing.assert_allclose(model.geom_friction[:, 0], 0.3)
  np.testing.assert_allclose(
    model.actuator_gainprm[:, 0], 0.8 * before['actuator_gainprm'][:, 0]
  )
  assert session.robot.task.core.disturbances['action_delay'] == 0.06
  assert session.robot.position[0] == x
  session.reset()  # They stay.
  np.testing.assert_allclose(model.geom_friction[:, 0], 0.3)
  with pytest.raises(ValueError, match='at most 0.06 s'):
    session.disturb(action_delay=0.1)
  with pytest.raises(ValueError, match='none of action_delay'):
    session.disturb(mood=1.0)
  session.disturb(**disturbing.NOMINAL)
  for name, value in before.items():
    np.testing.assert_allclose(getattr(model, name), value, err_msg=name)


def test_survival_is_counted() -> None:
  session = session_lib.LiveSession(pretrained.load('quickstart'))
  assert stepping.run(session, 0.9).survival == pytest.approx((0.9, 0, 0.9))
  for _ in range(3):
    session.push((0.0, 3.0))
  state = stepping.run(session, 3.0, lambda state: state.down)
  assert (state.survival.up, state.survival.falls) == (0, 1)
  state = stepping.run(session, 3.0, lambda state: not state.down)
  state = stepping.run(session, 0.3)
  assert 0.3 <= state.survival.up < 0.4
  assert state.survival.falls_per_minute == pytest.approx(
    60 / state.survival.seconds
  )
  session.disturb(friction=0.5)  # Another robot.
  assert session.step().survival.falls == 0
  # It is not what the survival depends on alone: random pushes do come.
  session.disturb(push_speed=2.0)
  assert stepping.run(session, 30.0, lambda state: state.down).down


def test_next_and_previous_modes(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  session.command_next(1)
  assert session.step().step.mode == 'walk_forward'
  session.command_next(-1)
  assert session.step().step.mode == 'idle'


def test_disturbances_are_the_robots() -> None:
  session = session_lib.LiveSession(
    pretrained.load('pi2'),
    disturbed=events.fixed(payload=2.0, action_delay=0.01, push_speed=1.0),
  )
  for name in ('flat', 'gap'):
    session.set_arena(name)
    model = session.robot.physics.model
    trunk = model.name2id('walker/trunk', 'body')
    assert model.body_subtreemass[trunk] == pytest.approx(16.05, abs=0.1)


def test_bad_input(session: session_lib.LiveSession) -> None:
  session.set_arena('flat')
  for what, message in (
    (lambda: session.command('fly'), "Unknown mode 'fly'"),
    (lambda: session.push((3.0, 1.0)), 'at most 3'),
    (lambda: session.set_clock_rate(np.nan), 'within 0.5 and 3'),
    (lambda: session.set_speed(0.55), 'one of 0.1, 0.2, ... 1'),
    (lambda: session.blend('idle', 'launch', 0.5), 'cannot be blended'),
    (lambda: session.blend('idle', 'walk_forward', 0.55), '0, 0.1, ... 1'),
    (lambda: session.set_arena('moat'), "Unknown arena 'moat'"),
    (lambda: session.set_arena('flat', -1), 'seed must be within 0 and'),
  ):
    with pytest.raises(ValueError, match=message):
      what()
  assert session.step().step.mode == 'idle'
