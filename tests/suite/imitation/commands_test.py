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


def _motion(
  name: str,
  kind: str,
  end: tuple[float, float, float],
  yaw: float = 0.0,
) -> motion_lib.ReferenceMotion:
  """One second from (0, 0, 0.5) to `end`, turning by `yaw` radians."""
  half = yaw / 2
  return motion_lib.ReferenceMotion(
    name=name,
    kind=kind,
    duration=1.0,
    phases=np.array([0.0, 1.0]),
    positions=np.array([[0.0, 0.0, 0.5], end]),
    orientations=np.array(
      [[1.0, 0.0, 0.0, 0.0], [np.cos(half), 0.0, 0.0, np.sin(half)]]
    ),
  )


_MOTIONS = (
  _motion('go', motion_lib.PERIODIC, (2.0, 0.0, 0.5)),
  _motion('stand', motion_lib.STEADY, (0.0, 0.0, 0.5)),
  _motion('jump', motion_lib.TRANSIENT, (1.0, 0.0, 0.9)),
  _motion('turn', motion_lib.PERIODIC, (1.0, 0.0, 0.5), yaw=np.pi / 2),
)


def _tracker(num_worlds: int = 1, max_knots: int = 3) -> commands.ModeTracker:
  return commands.ModeTracker(
    mode_set.one_hot(_MOTIONS), _TIMESTEP, num_worlds, max_knots
  )


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


def test_phase_runs_with_the_duration() -> None:
  tracker = _started([_GO])
  phases = []
  for _ in range(5):
    tracker.advance()
    phases.append(tracker.state.phase[0])
  assert phases == [0.25, 0.5, 0.75, 0.0, 0.25]


@pytest.mark.parametrize(('rate', 'expected'), [(0.5, 0.125), (2.0, 0.5)])
def test_clock_rate(rate: float, expected: float) -> None:
  tracker = _started([_GO], clock_rate=rate)
  tracker.advance()
  assert tracker.state.phase[0] == expected


def test_periodic_mode_goes_on_where_its_cycle_ended() -> None:
  tracker = _started([_GO], support=0.3)
  positions = []
  for _ in range(9):
    positions.append(tracker.reference().position[0])
    tracker.advance()
  expected = np.column_stack([np.arange(9) * 0.5, np.zeros(9), np.full(9, 0.8)])
  np.testing.assert_allclose(positions, expected, atol=1e-12)


def test_steady_mode_wraps_its_clock_alone() -> None:
  tracker = _started([_STAND])
  for _ in range(6):
    tracker.advance()
  assert tracker.state.phase[0] == 0.5
  np.testing.assert_array_equal(tracker.state.anchor, np.zeros((1, 3)))


def test_transient_mode_holds_its_end() -> None:
  tracker = _started([_JUMP])
  for _ in range(9):
    tracker.advance()
  assert tracker.state.phase[0] == 1.0
  np.testing.assert_allclose(tracker.reference().position, [[1.0, 0.0, 0.9]])


def test_turning_mode_bends_its_path() -> None:
  tracker = _started([_TURN])
  for _ in range(4):
    tracker.advance()
  np.testing.assert_allclose(tracker.state.heading, [np.pi / 2])
  for _ in range(4):
    tracker.advance()
  # One metre along x, then one along y.
  np.testing.assert_allclose(
    tracker.reference().position, [[1.0, 1.0, 0.5]], atol=1e-12
  )


class TestCommand:
  def _run(self, tracker: commands.ModeTracker, steps: int) -> list[int]:
    """Steps with the robot at (5, 6, 0.4) on a support of 0.2; new modes."""
    taken = []
    for _ in range(steps):
      tracker.advance()
      ids, modes = tracker.pop_due_commands()
      taken += modes.tolist()
      tracker.command(
        ids, modes, np.tile([5.0, 6.0, 0.4], (len(ids), 1)), 0.2 + 0.0 * ids
      )
    return taken

  def test_reference_is_anchored_where_the_robot_is(self) -> None:
    tracker = _started([_GO, _JUMP], [0.0, 0.75])
    assert self._run(tracker, 2) == []
    np.testing.assert_allclose(tracker.reference().position, [[1.0, 0.0, 0.5]])
    assert self._run(tracker, 1) == [_JUMP]
    assert tracker.state.phase[0] == 0.0
    np.testing.assert_allclose(tracker.reference().position, [[5.0, 6.0, 0.7]])

  def test_equal_command_lets_the_mode_continue(self) -> None:
    tracker = _started([_GO, _GO, _STAND], [0.0, 0.5, 1.5])
    assert self._run(tracker, 5) == []
    assert tracker.state.phase[0] == 0.25
    np.testing.assert_allclose(tracker.reference().position, [[2.5, 0.0, 0.5]])
    assert self._run(tracker, 1) == [_STAND]

  def test_last_command_stays_in_force(self) -> None:
    tracker = _started([_GO, _STAND], [0.0, 0.25])
    assert self._run(tracker, 20) == [_STAND]

  def test_heading_is_the_commanded_one(self) -> None:
    tracker = _started([_TURN, _GO], [0.0, 0.5])
    self._run(tracker, 2)
    # Half a cycle of a quarter turn.
    np.testing.assert_allclose(tracker.state.heading, [np.pi / 4])
    self._run(tracker, 1)
    step = 0.5 * np.sqrt(0.5)
    np.testing.assert_allclose(
      tracker.reference().position, [[5.0 + step, 6.0 + step, 0.7]]
    )

  def test_latents_follow_the_mode(self) -> None:
    tracker = _started([_GO, _JUMP], [0.0, 0.25])
    np.testing.assert_array_equal(tracker.commands(), [[1, 0, 0, 0]])
    self._run(tracker, 1)
    np.testing.assert_array_equal(tracker.commands(), [[0, 0, 1, 0]])

  @pytest.mark.parametrize(
    ('commands_from_ground', 'expected'), [(True, 1.0), (False, 0.82)]
  )
  def test_launch_is_left_only_when_it_is_over(
    self, commands_from_ground: bool, expected: float
  ) -> None:
    """Or, where commands need not come from the ground, has touched down."""
    motions = library.resolve('pi2')
    known = mode_set.one_hot(motions)
    bank = known.bank
    launch, count = bank.index('launch'), len(schedule.SWITCH_PHASES)
    plan = schedule.transitions(
      known,
      np.full(count, launch),
      np.zeros(count, dtype=np.int64),
      np.zeros(count),
      np.array(schedule.SWITCH_PHASES),
      commands_from_ground,
    )
    tracker = commands.ModeTracker(mode_set.one_hot(motions), 0.03, count, 2)
    tracker.reset(np.arange(count), plan, np.zeros(count), np.zeros(count))
    left = np.full(count, np.nan)
    for _ in range(40):
      tracker.advance()
      ids, modes = tracker.pop_due_commands()
      left[ids] = tracker.state.phase[ids]
      tracker.command(ids, modes, np.zeros((len(ids), 3)), 0.0 * ids)
    # To half a control step.
    half = 0.5 * 0.03 / bank.durations[launch] + 1e-9
    np.testing.assert_allclose(left, [expected] * count, atol=half)


class TestExpectedSupport:
  """The step that a mode is about to climb."""

  def _expecting(self) -> commands.ModeTracker:
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
      (0.25, (0.0, 0.5, 0.2)),
      (100.0, (0.0, 0.5, 0.2)),
    ],
  )
  def test_by_hand(
    self, x: float, expected: tuple[float, float, float]
  ) -> None:
    tracker = self._expecting()
    np.testing.assert_array_equal(
      tracker.expected_support(np.full(3, x)), expected
    )
    some = np.array([2, 1])
    np.testing.assert_array_equal(
      tracker.expected_support(np.full(2, x), some), np.array(expected)[some]
    )

  def test_next_command_forgets_the_step(self) -> None:
    tracker, far = self._expecting(), np.full(3, 9.0)
    tracker.command(
      np.array([1]), np.array([_GO]), np.zeros((1, 3)), np.array([0.5])
    )
    np.testing.assert_array_equal(
      tracker.expected_support(far), [0.0, 0.5, 0.2]
    )
    assert tracker.state.edge[1] == np.inf
    assert tracker.state.rise[1] == 0.0

  def test_next_episode_forgets_the_step(self) -> None:
    tracker, far = self._expecting(), np.full(3, 9.0)
    plan = schedule.single(np.array([_JUMP]))
    tracker.reset(np.array([1]), plan, np.zeros(1), np.array([0.3]))
    np.testing.assert_array_equal(
      tracker.expected_support(far), [0.0, 0.3, 0.2]
    )

  def test_mode_that_goes_on_remembers_it(self) -> None:
    tracker = self._expecting()
    for _ in range(9):
      tracker.advance()
      assert not len(tracker.pop_due_commands()[0])
    np.testing.assert_array_equal(tracker.state.edge, [np.inf, 0.25, np.inf])
    assert tracker.expected_support(np.full(3, 0.3))[1] == 0.5


class TestUpcoming:
  """What is commanded next; `_TIMESTEP` is 0.25 s."""

  def _assert_upcoming(
    self, tracker: commands.ModeTracker, countdown: float, mode: int
  ) -> None:
    seconds, latents = tracker.upcoming()
    np.testing.assert_array_equal(seconds, [countdown])
    np.testing.assert_array_equal(latents, np.eye(4)[[mode]])

  def _step(self, tracker: commands.ModeTracker) -> None:
    tracker.advance()
    ids, modes = tracker.pop_due_commands()
    tracker.command(ids, modes, np.zeros((len(ids), 3)), np.zeros(len(ids)))

  def test_counts_down_from_command_to_command(self) -> None:
    tracker = _started([_GO, _STAND, _JUMP], [0.0, 0.5, 1.25])
    expected = [
      (0.5, _STAND),
      (0.25, _STAND),
      (0.75, _JUMP),  # The second command has just been carried out.
      (0.5, _JUMP),
      (0.25, _JUMP),
      (np.inf, _JUMP),  # And this was the last: the mode that runs now.
      (np.inf, _JUMP),
    ]
    for countdown, mode in expected:
      self._assert_upcoming(tracker, countdown, mode)
      self._step(tracker)

  def test_due_command_is_due_in_no_time(self) -> None:
    tracker = _started([_GO, _STAND], [0.0, 0.25])
    tracker.advance()
    self._assert_upcoming(tracker, 0.0, _STAND)

  @pytest.mark.parametrize('max_knots', [1, 3])
  def test_single_command(self, max_knots: int) -> None:
    tracker = _tracker(max_knots=max_knots)
    plan = schedule.single(np.array([_JUMP]))
    tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
    for _ in range(3):
      self._assert_upcoming(tracker, np.inf, _JUMP)
      self._step(tracker)

  def test_shorter_schedule_forgets_the_longer_one(self) -> None:
    tracker = _started([_GO, _STAND, _JUMP], [0.0, 0.25, 0.5])
    plan = schedule.single(np.array([_TURN]))
    tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
    self._assert_upcoming(tracker, np.inf, _TURN)

  def test_equal_command_is_told_of(self) -> None:
    tracker = _started([_GO, _GO, _STAND], [0.0, 0.25, 0.75])
    self._assert_upcoming(tracker, 0.25, _GO)
    self._step(tracker)
    self._assert_upcoming(tracker, 0.5, _STAND)

  def test_rows_of_some_worlds(self) -> None:
    tracker = _tracker(num_worlds=3)
    plan = schedule.ModeSchedule(
      np.array([[_GO, _STAND], [_JUMP, _GO], [_TURN, _JUMP]]),
      np.array([[0.0, 0.5], [0.0, np.inf], [0.0, 1.0]]),
      np.ones(3),
    )
    tracker.reset(np.arange(3), plan, np.zeros(3), np.zeros(3))
    self._step(tracker)
    countdown, latents = tracker.upcoming(np.array([2, 1]))
    np.testing.assert_array_equal(countdown, [0.75, np.inf])
    np.testing.assert_array_equal(latents, np.eye(4)[[_JUMP, _JUMP]])
    countdown, latents = tracker.upcoming()
    np.testing.assert_array_equal(countdown, [0.25, np.inf, 0.75])
    np.testing.assert_array_equal(latents, np.eye(4)[[_STAND, _JUMP, _JUMP]])


def test_reference_of_some_worlds() -> None:
  motions = tuple(library.modes().values())
  count = len(motions)
  tracker = commands.ModeTracker(mode_set.one_hot(motions), 0.03, count, 1)
  random = np.random.RandomState(0)
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
    some = tracker.reference(ids)
    for mine, expected in zip(some, every, strict=True):
      np.testing.assert_array_equal(mine, expected[ids])


@pytest.mark.parametrize(
  ('name', 'phase', 'expected'),
  [
    ('idle', 0.5, False),
    ('walk_forward', 0.3, False),
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
  motions = tuple(library.modes().values())
  tracker = commands.ModeTracker(mode_set.one_hot(motions), 0.03, 2, 1)
  mode = tracker.bank.index(name)
  # The other world stands, whatever its phase.
  plan = schedule.single(np.array([tracker.bank.index('idle'), mode]))
  both = np.arange(2)
  tracker.reset(both, plan, np.array([0.5, phase]), np.zeros(2))
  np.testing.assert_array_equal(tracker.airborne(both), [False, expected])
  np.testing.assert_array_equal(tracker.airborne(both[::-1]), [expected, False])


def test_mode_without_contacts_is_never_airborne() -> None:
  tracker = _started([_JUMP], phase=0.5)
  np.testing.assert_array_equal(tracker.airborne(_FIRST), [False])


@pytest.mark.parametrize(
  ('name', 'phase', 'clock_rate', 'expected'),
  [
    ('launch', 0.40, 1.0, True),
    ('launch', 0.38, 1.0, False),
    ('launch', 0.38, 2.0, True),
    ('launch', 0.42, 1.0, False),
    ('launch', 1.0, 1.0, False),
    ('leap_forward', 0.40, 1.0, False),
  ],
)
def test_who_and_how_fast(
  name: str, phase: float, clock_rate: float, expected: bool
) -> None:
  motions = tuple(library.modes().values())
  tracker = commands.ModeTracker(mode_set.one_hot(motions), 0.03, 2, 1)
  # The other world stands, whatever its phase.
  index = tracker.bank.index
  plan = schedule.single(np.array([index('idle'), index(name)]), clock_rate)
  tracker.reset(np.arange(2), plan, np.array([0.5, phase]), np.zeros(2))
  tracker.state.heading[:] = np.pi / 2
  tracker.advance()
  ids, velocity = tracker.take_offs()
  assert ids.tolist() == ([1] if expected else [])
  if expected:
    x, _, z = tracker.bank.start_velocity(
      np.array([index('launch')]), np.array([0.42])
    )[0]
    assert z > 2.0
    np.testing.assert_allclose(
      velocity, [clock_rate * np.array([0.0, x, z])], atol=1e-12
    )


def test_worlds_are_independent() -> None:
  tracker = _tracker(num_worlds=3)
  tracker.reset(
    np.arange(3),
    schedule.single(np.array([_GO, _STAND, _JUMP])),
    np.array([0.0, 0.25, 0.5]),
    np.array([0.0, 0.1, 0.2]),
  )
  tracker.advance()
  np.testing.assert_array_equal(tracker.state.phase, [0.25, 0.5, 0.75])
  plan = schedule.single(np.array([_JUMP]))
  tracker.reset(np.array([1]), plan, np.zeros(1), np.array([0.7]))
  np.testing.assert_array_equal(tracker.state.mode, [_GO, _JUMP, _JUMP])
  np.testing.assert_array_equal(tracker.state.phase, [0.25, 0.0, 0.75])
  np.testing.assert_array_equal(tracker.state.step, [1, 0, 1])
  np.testing.assert_array_equal(tracker.state.anchor[:, 2], [0, 0.7, 0.2])


def test_shorter_schedule_forgets_the_longer_one_reset() -> None:
  tracker = _started([_GO, _STAND, _JUMP], [0.0, 0.25, 0.5])
  plan = schedule.single(np.array([_GO]))
  tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
  for _ in range(5):
    tracker.advance()
    assert not len(tracker.pop_due_commands()[0])


def test_start_pose_is_the_reference_with_its_velocity() -> None:
  tracker = _started([_GO], phase=0.5, support=0.2, clock_rate=1.5)
  position, orientation, velocity = tracker.start_pose(_FIRST)
  np.testing.assert_allclose(position, [[1.0, 0.0, 0.7]])
  np.testing.assert_allclose(orientation, [[1.0, 0.0, 0.0, 0.0]])
  np.testing.assert_allclose(velocity, [[3.0, 0.0, 0.0]])


def test_rejects_a_schedule_too_long() -> None:
  tracker = _tracker(max_knots=2)
  plan = schedule.from_knots(np.array([[_GO, _STAND, _GO]]), 0.5)
  with pytest.raises(ValueError, match='max_knots'):
    tracker.reset(_FIRST, plan, np.zeros(1), np.zeros(1))
