"""Tests of dmc_multimode.suite.imitation.commands."""

import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import schedule
from dmc_multimode.suite.imitation import commands

_TIMESTEP = 0.25  # Seconds; exact in binary, as are all durations here.
_GO, _STAND, _JUMP, _TURN = range(4)
_FIRST = np.array([0])
_LIBRARY = mode_set.one_hot(tuple(library.modes().values()))


def _motion(
  name: str, kind: str, end: tuple[float, float, float], yaw: float = 0.0
) -> motion_lib.ReferenceMotion:
  """One second from (0, 0, 0.5) to `end`, turning by `yaw` radians."""
  turned = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
  return motion_lib.ReferenceMotion(
    name=name,
    kind=kind,
    duration=1.0,
    phases=np.array([0.0, 1.0]),
    positions=np.array([[0.0, 0.0, 0.5], end]),
    orientations=np.array([[1.0, 0.0, 0.0, 0.0], turned]),
  )


_MODE_SET = mode_set.one_hot(
  (
    _motion('go', motion_lib.PERIODIC, (2.0, 0.0, 0.5)),
    _motion('stand', motion_lib.STEADY, (0.0, 0.0, 0.5)),
    _motion('jump', motion_lib.TRANSIENT, (1.0, 0.0, 0.9)),
    _motion('turn', motion_lib.PERIODIC, (1.0, 0.0, 0.5), yaw=np.pi / 2),
  )
)


def _tracker(num_worlds: int = 1, max_knots: int = 3) -> commands.ModeTracker:
  return commands.ModeTracker(_MODE_SET, _TIMESTEP, num_worlds, max_knots)


def _started(
  modes: list[int],
  starts: list[float] | None = None,
  phase: float = 0.0,
  support: float = 0.0,
  clock_rate: float = 1.0,
) -> commands.ModeTracker:
  """One world that has just been reset to a schedule."""
  tracker = _tracker()
  plan = schedule.ModeSchedule(
    np.array([modes]), np.array([starts or [0.0]]), np.array([clock_rate])
  )
  tracker.reset(_FIRST, plan, np.array([phase]), np.array([support]))
  return tracker


def _restart(
  tracker: commands.ModeTracker, world: int, mode: int, support: float = 0.0
) -> None:
  """Begins another episode in one world."""
  plan = schedule.single(np.array([mode]))
  tracker.reset(np.array([world]), plan, np.zeros(1), np.array([support]))


def _run(
  tracker: commands.ModeTracker, steps: int, gated: bool = False
) -> list[int]:
  """Steps with robots at (5, 6, 0.4) on a support of 0.2; the new modes."""
  taken = []
  for _ in range(steps):
    tracker.advance()
    tracker.take_due_commands()
    ids, modes = tracker.pop_pending(gated)
    taken += modes.tolist()
    position = np.tile([5.0, 6.0, 0.4], (len(ids), 1))
    tracker.command(ids, modes, position, 0.2 + 0.0 * ids, 0.0 * position)
  return taken


# --- Clocks.


@pytest.mark.parametrize(
  ('mode', 'rate', 'phases'),
  [
    (_GO, 1.0, [0.25, 0.5, 0.75, 0.0, 0.25]),
    (_GO, 0.5, [0.125, 0.25]),
    (_STAND, 2.0, [0.5, 0.0, 0.5]),
    (_JUMP, 2.0, [0.5, 1.0, 1.0]),
  ],
)
def test_phase_runs_with_the_duration(
  mode: int, rate: float, phases: list[float]
) -> None:
  tracker, seen = _started([mode], clock_rate=rate), []
  for _ in phases:
    tracker.advance()
    seen.append(tracker.state.phase[0])
  assert seen == phases


@pytest.mark.parametrize(
  ('mode', 'steps', 'position', 'heading'),
  [
    # A periodic mode goes on where its cycle ended; only z is its support's.
    *((_GO, steps, (0.5 * steps, 0.0, 0.8), 0.0) for steps in range(9)),
    (_STAND, 6, (0.0, 0.0, 0.8), 0.0),
    (_JUMP, 9, (1.0, 0.0, 1.2), 0.0),  # Holds its end.
    # One metre along x, then one along y.
    (_TURN, 4, (1.0, 0.0, 0.8), np.pi / 2),
    (_TURN, 8, (1.0, 1.0, 0.8), np.pi),
  ],
)
def test_reference_by_hand(
  mode: int, steps: int, position: tuple[float, ...], heading: float
) -> None:
  tracker = _started([mode], support=0.3)
  for _ in range(steps):
    tracker.advance()
  np.testing.assert_allclose(
    tracker.reference().position, [position], atol=1e-12
  )
  np.testing.assert_allclose(tracker.state.heading, [heading])


@pytest.mark.parametrize(('rate', 'message'), [(4.0, ''), (4.1, 'at most 4')])
def test_a_cycle_lasts_at_least_a_control_step(
  rate: float, message: str
) -> None:
  """Beyond, a single step would go through several cycles."""
  if message:
    with pytest.raises(ValueError, match=f'go: its cycle of 1 s.*{message}'):
      _started([_JUMP], clock_rate=rate)
    return
  tracker = _started([_GO], clock_rate=rate)
  for _ in range(3):
    tracker.advance()
  np.testing.assert_allclose(tracker.reference().position, [[6.0, 0.0, 0.5]])


# --- Commands.


def test_reference_is_anchored_where_the_robot_is() -> None:
  tracker = _started([_GO, _JUMP], [0.0, 0.75])
  assert _run(tracker, 2) == []
  np.testing.assert_allclose(tracker.reference().position, [[1.0, 0.0, 0.5]])
  np.testing.assert_array_equal(tracker.commands(), np.eye(4)[[_GO]])
  assert _run(tracker, 1) == [_JUMP]
  assert tracker.state.phase[0] == 0.0
  np.testing.assert_allclose(tracker.reference().position, [[5.0, 6.0, 0.7]])
  np.testing.assert_array_equal(tracker.commands(), np.eye(4)[[_JUMP]])


def test_equal_command_lets_the_mode_continue_and_the_last_one_stays() -> None:
  tracker = _started([_GO, _GO, _STAND], [0.0, 0.5, 1.5])
  assert _run(tracker, 5) == []
  assert tracker.state.phase[0] == 0.25
  np.testing.assert_allclose(tracker.reference().position, [[2.5, 0.0, 0.5]])
  assert _run(tracker, 20) == [_STAND]


def test_heading_is_the_commanded_one() -> None:
  tracker = _started([_TURN, _GO], [0.0, 0.5])
  _run(tracker, 2)
  # Half a cycle of a quarter turn.
  np.testing.assert_allclose(tracker.state.heading, [np.pi / 4])
  _run(tracker, 1)
  step = 0.5 * np.sqrt(0.5)
  np.testing.assert_allclose(
    tracker.reference().position, [[5.0 + step, 6.0 + step, 0.7]]
  )


@pytest.mark.parametrize(
  ('phase', 'clock_rate', 'held'),
  [
    # Steps of 0.1 s. A leap flies from phase 0.42 to 0.70, that is from 0.504 s
    # to 0.84 s, and cannot be stopped in the 0.15 s before.
    (0.2, 1.0, 0),
    (0.3, 1.0, 5),
    (0.5, 1.0, 3),
    (0.7, 1.0, 0),
    (0.2, 2.0, 3),
  ],
)
def test_command_waits_for_the_ground(
  phase: float, clock_rate: float, held: int
) -> None:
  modes = [_LIBRARY.index(name) for name in ('leap_forward', 'idle')]
  plan = schedule.ModeSchedule(
    np.array([modes]), np.array([[0.0, 0.1]]), np.array([clock_rate])
  )
  for gated in (False, True):
    tracker = commands.ModeTracker(_LIBRARY, 0.1, 1, 2)
    tracker.reset(
      _FIRST, plan, np.array([phase - clock_rate / 12]), np.zeros(1)
    )
    taken = [bool(_run(tracker, 1, gated)) for _ in range(9)]
    assert taken.index(True) == (held if gated else 0)


def test_mode_with_a_take_off_runs_to_its_end() -> None:
  modes = np.array([[_LIBRARY.index(n) for n in ('launch', 'idle', 'launch')]])
  plan = schedule.ModeSchedule(modes, np.array([[0.0, 0.2, 5.0]]), np.ones(1))
  tracker = commands.ModeTracker(_LIBRARY, 0.1, 1, 3)
  tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
  assert _run(tracker, 10, gated=True) == []
  seconds, latents = tracker.upcoming()  # It waits.
  assert seconds == 0 and np.array_equal(latents, _LIBRARY.latents[modes[:, 1]])
  assert _run(tracker, 1, gated=True) == [modes[0, 1]]
  tracker.state.pending[:] = modes[0, 0]
  tracker.state.pending[:] = modes[0, 1]  # A later command replaces it.
  assert _run(tracker, 1, gated=True) == []


@pytest.mark.parametrize(
  ('pace', 'steps', 'x'),
  # The first cycle of 2 m: v0 t + (1 - v0) t^2 / 2 of it; then in full.
  [(0.0, 2, 0.25), (0.0, 4, 1.0), (0.0, 6, 2.0), (0.5, 2, 0.625), (1, 3, 1.5)],
)
def test_gait_starts_at_the_pace_of_the_robot(
  pace: float, steps: int, x: float
) -> None:
  tracker = commands.ModeTracker(
    _MODE_SET, _TIMESTEP, 1, 1, feasible_references=True
  )
  plan = schedule.single(np.array([_STAND]))
  tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
  velocity = np.array([[2.0 * pace, -1.0, 0.0]])
  origin = np.zeros((1, 3))
  tracker.command(_FIRST, np.array([_GO]), origin, np.zeros(1), velocity)
  _run(tracker, steps)
  np.testing.assert_allclose(tracker.reference().position, [[x, 0.0, 0.5]])


def test_fast_flight_is_lower() -> None:
  leap = _LIBRARY.index('leap_forward')
  for rate, feasible, share in (
    (0.5, True, 1.0),
    (1.0, True, 1.0),
    (2.0, True, 0.25),
    (2.0, False, 1.0),
  ):
    tracker = commands.ModeTracker(_LIBRARY, 0.03, 1, 1, feasible)
    plan = schedule.single(np.array([leap]), rate)
    tracker.reset(_FIRST, plan, np.array([0.56]), np.zeros(1))
    height = tracker.reference().position[0, 2]
    np.testing.assert_allclose(height, 0.5 + share * 0.18)


# --- The ledge that a mode is about to climb.


def _expecting() -> commands.ModeTracker:
  """Three worlds on supports of 0, 0.1 and 0.2 m; the last two climb."""
  tracker = _tracker(num_worlds=3)
  tracker.reset(
    np.arange(3),
    schedule.single(np.array([_GO, _JUMP, _JUMP])),
    np.zeros(3),
    np.array([0.0, 0.1, 0.2]),
  )
  tracker.expect_ledge(np.array([1, 2]), np.array([0.25, np.inf]), 0.4)
  return tracker


@pytest.mark.parametrize(
  ('x', 'expected'),
  [
    (0.0, (0.0, 0.1, 0.2)),
    (0.2499, (0.0, 0.1, 0.2)),
    (0.25, (0.0, 0.5, 0.2)),  # An edge belongs to what starts there.
    (100.0, (0.0, 0.5, 0.2)),  # And one that is nowhere is never reached.
  ],
)
def test_expected_support(x: float, expected: tuple[float, ...]) -> None:
  tracker, some = _expecting(), np.array([2, 1])
  assert not _run(tracker, 9)  # A mode that goes on remembers it.
  np.testing.assert_array_equal(
    tracker.expected_support(np.full(3, x)), expected
  )
  np.testing.assert_array_equal(
    tracker.expected_support(np.full(2, x), some), np.array(expected)[some]
  )


def test_next_command_and_next_episode_forget_the_ledge() -> None:
  tracker, far = _expecting(), np.full(3, 9.0)
  origin = np.zeros((1, 3))
  tracker.command(
    np.array([1]), np.array([_GO]), origin, np.array([0.5]), origin
  )
  np.testing.assert_array_equal(tracker.expected_support(far), [0.0, 0.5, 0.2])
  assert (tracker.state.edge[1], tracker.state.rise[1]) == (np.inf, 0.0)
  tracker = _expecting()
  _restart(tracker, 1, _JUMP, support=0.3)
  np.testing.assert_array_equal(tracker.expected_support(far), [0.0, 0.3, 0.2])


# --- What is commanded next.


@pytest.mark.parametrize(
  ('modes', 'starts', 'expected'),
  [
    (
      [_GO, _STAND, _JUMP],
      [0.0, 0.5, 1.25],
      [
        (0.5, _STAND),
        (0.25, _STAND),
        (0.75, _JUMP),  # The second command has just been carried out.
        (0.5, _JUMP),
        (0.25, _JUMP),
        (np.inf, _JUMP),  # And this was the last: the mode that runs now.
        (np.inf, _JUMP),
      ],
    ),
    ([_GO, _GO, _STAND], [0.0, 0.25, 0.75], [(0.25, _GO), (0.5, _STAND)]),
    ([_JUMP], [0.0], [(np.inf, _JUMP)] * 2),
  ],
)
def test_upcoming_commands(
  modes: list[int], starts: list[float], expected: list[tuple[float, int]]
) -> None:
  tracker = _started(modes, starts)
  for countdown, mode in expected:
    seconds, latents = tracker.upcoming()
    np.testing.assert_array_equal(seconds, [countdown])
    np.testing.assert_array_equal(latents, np.eye(4)[[mode]])
    _run(tracker, 1)


def test_shorter_schedule_forgets_the_longer_one() -> None:
  tracker = _started([_GO, _STAND, _JUMP], [0.0, 0.25, 0.5])
  _restart(tracker, 0, _TURN)
  seconds, latents = tracker.upcoming()
  np.testing.assert_array_equal(seconds, [np.inf])
  np.testing.assert_array_equal(latents, np.eye(4)[[_TURN]])
  assert not _run(tracker, 5)


# --- Of modes of the library.


def test_reference_of_some_worlds() -> None:
  count, random = len(_LIBRARY), np.random.RandomState(0)
  tracker = commands.ModeTracker(_LIBRARY, 0.03, count, 1)
  tracker.reset(
    np.arange(count),
    schedule.single(np.arange(count)),
    random.uniform(size=count),
    random.uniform(size=count),
  )
  tracker.state.heading[:] = random.uniform(-3, 3, count)
  tracker.state.anchor[:] = random.uniform(-3, 3, (count, 3))
  every = tracker.reference()
  assert np.ptp(every.position[:, :2]) > 1.0
  for ids in (np.array([7, 2, 9]), np.zeros(0, dtype=np.int64), slice(3, 5)):
    for mine, expected in zip(tracker.reference(ids), every, strict=True):
      np.testing.assert_array_equal(mine, expected[ids])


def _beside_one_that_stands(
  name: str, phase: float, clock_rate: float = 1.0
) -> commands.ModeTracker:
  tracker = commands.ModeTracker(_LIBRARY, 0.03, 2, 1)
  modes = np.array([_LIBRARY.index('idle'), _LIBRARY.index(name)])
  plan = schedule.single(modes, clock_rate)
  tracker.reset(np.arange(2), plan, np.array([0.5, phase]), np.zeros(2))
  return tracker


@pytest.mark.parametrize(
  ('name', 'phase', 'expected'),
  [
    ('walk_forward', 0.3, False),  # One foot is enough.
    ('hop_forward', 0.65, False),
    ('hop_forward', 0.68, True),
    ('leap_left', 0.41, False),
    ('leap_left', 0.42, True),
    ('leap_left', 0.69, True),
    ('leap_left', 0.71, False),
    ('launch', 0.81, True),
    ('launch', 1.0, False),
  ],
)
def test_airborne(name: str, phase: float, expected: bool) -> None:
  tracker, both = _beside_one_that_stands(name, phase), np.arange(2)
  np.testing.assert_array_equal(tracker.airborne(both), [False, expected])
  np.testing.assert_array_equal(tracker.airborne(both[::-1]), [expected, False])


@pytest.mark.parametrize(
  ('name', 'phase', 'clock_rate', 'expected'),
  [
    ('launch', 0.40, 1.0, True),
    ('launch', 0.38, 1.0, False),  # 0.03 / 1.1 = 0.027: not there yet.
    ('launch', 0.38, 2.0, True),
    ('launch', 0.42, 1.0, False),  # Passed already.
    ('launch', 1.0, 1.0, False),
    ('leap_forward', 0.40, 1.0, False),  # It may be left at any time.
  ],
)
def test_take_offs(
  name: str, phase: float, clock_rate: float, expected: bool
) -> None:
  tracker = _beside_one_that_stands(name, phase, clock_rate)
  tracker.state.heading[:] = np.pi / 2
  tracker.advance()
  ids, velocity = tracker.take_offs()
  assert ids.tolist() == ([1] if expected else [])
  if expected:
    x, _, z = tracker.bank.start_velocity(
      np.array([_LIBRARY.index('launch')]), np.array([0.42])
    )[0]
    assert z > 2.0
    np.testing.assert_allclose(
      velocity, [clock_rate * np.array([0.0, x, z])], atol=1e-12
    )


# --- Resets.


def test_start_pose_is_the_reference_with_its_velocity() -> None:
  tracker = _started([_GO], phase=0.5, support=0.2, clock_rate=1.5)
  position, orientation, velocity = tracker.start_pose(_FIRST)
  np.testing.assert_allclose(position, [[1.0, 0.0, 0.7]])
  np.testing.assert_allclose(orientation, [[1.0, 0.0, 0.0, 0.0]])
  np.testing.assert_allclose(velocity, [[3.0, 0.0, 0.0]])


def test_worlds_are_independent() -> None:
  tracker = _tracker(num_worlds=3, max_knots=2)
  plan = schedule.ModeSchedule(
    np.array([[_GO, _STAND], [_STAND, _GO], [_JUMP, _GO]]),
    np.array([[0.0, 0.5], [0.0, np.inf], [0.0, 1.0]]),
    np.ones(3),
  )
  phase, support = np.array([0.0, 0.25, 0.5]), np.array([0.0, 0.1, 0.2])
  tracker.reset(np.arange(3), plan, phase, support)
  tracker.advance()
  np.testing.assert_array_equal(tracker.state.phase, [0.25, 0.5, 0.75])
  countdown, latents = tracker.upcoming()
  np.testing.assert_array_equal(countdown, [0.25, np.inf, 0.75])
  np.testing.assert_array_equal(latents, np.eye(4)[[_STAND, _STAND, _GO]])
  some, rows = tracker.upcoming(np.array([2, 1]))
  np.testing.assert_array_equal(some, countdown[[2, 1]])
  np.testing.assert_array_equal(rows, latents[[2, 1]])
  _restart(tracker, 1, _JUMP, support=0.7)
  np.testing.assert_array_equal(tracker.state.mode, [_GO, _JUMP, _JUMP])
  np.testing.assert_array_equal(tracker.state.phase, [0.25, 0.0, 0.75])
  np.testing.assert_array_equal(tracker.state.step, [1, 0, 1])
  np.testing.assert_array_equal(tracker.state.anchor[:, 2], [0, 0.7, 0.2])
  plan = schedule.from_knots(np.array([[_GO, _STAND, _GO]]), 0.5)
  with pytest.raises(ValueError, match='max_knots'):
    tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
