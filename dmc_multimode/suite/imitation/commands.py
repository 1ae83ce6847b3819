"""Commands, clocks and references of a batch of worlds, without any physics.

`ModeTracker` holds, for the Composer task (one world) and the batched
environment (many), the commanded modes, the anchors of their references and
their phases.
"""

from typing import NamedTuple

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import reference as reference_lib
from dmc_multimode.modes import schedule as schedule_lib

_NEVER = np.iinfo(np.int64).max


class Tracked(NamedTuple):
  """State of a `ModeTracker` that checkpoints hold; [B] unless said.

  Attributes:
    schedule_modes: [B, K].
    schedule_steps: control steps at which the modes are commanded, [B, K].
    clock_rate: of the phase.
    knot: column of the schedule that is in force.
    step: control steps since the reset.
    mode: index of the running mode.
    phase: in [0, 1].
    anchor: origin of the anchor frame, world metres, [B, 3].
    heading: commanded heading, radians.
    edge: x of the ledge that the running mode is made for, world metres;
      infinite without one.
    rise: height of that ledge, metres.
    pending: index of the mode that is commanded and waits for the robot; -1
      for none.
    pace: share of the reference's speed at the start of the cycle; it rises to
      1 within the cycle.
  """

  schedule_modes: np.ndarray
  schedule_steps: np.ndarray
  clock_rate: np.ndarray
  knot: np.ndarray
  step: np.ndarray
  mode: np.ndarray
  phase: np.ndarray
  anchor: np.ndarray
  heading: np.ndarray
  edge: np.ndarray
  rise: np.ndarray
  pending: np.ndarray
  pace: np.ndarray


class ModeTracker:
  """Runs the mode schedules of B worlds."""

  def __init__(
    self,
    mode_set: mode_set_lib.ModeSet,
    control_timestep: float,
    num_worlds: int,
    max_knots: int,
    feasible_references: bool = False,
  ):
    """Allocates the state; every world must be `reset` before use.

    Args:
      mode_set: the modes.
      control_timestep: seconds.
      num_worlds: B.
      max_knots: K, the most commands that a schedule may hold.
      feasible_references: adapts references to what a body can follow; see
        `ImitationConfig`.
    """
    self.bank = mode_set.bank
    self._ramps = mode_set.bank.level & feasible_references
    self._sinks = mode_set.bank.flies & feasible_references
    self._latents = mode_set.latents.astype(np.float64)
    self._timestep = control_timestep
    cycles = self.bank.durations[~self.bank.transient]
    self._fastest = cycles.min(initial=np.inf) / control_timestep
    num, knots = num_worlds, max_knots
    zeros = lambda *shape: np.zeros(shape, dtype=np.int64)
    self.state = Tracked(
      schedule_modes=zeros(num, knots),
      schedule_steps=np.full((num, knots), _NEVER),
      clock_rate=np.ones(num),
      knot=zeros(num),
      step=zeros(num),
      mode=zeros(num),
      phase=np.zeros(num),
      anchor=np.zeros((num, 3)),
      heading=np.zeros(num),
      edge=np.full(num, np.inf),
      rise=np.zeros(num),
      pending=np.full(num, -1),
      pace=np.ones(num),
    )

  def reset(
    self,
    ids: np.ndarray,
    schedule: schedule_lib.ModeSchedule,
    phase: np.ndarray,
    support: np.ndarray,
  ) -> None:
    """Starts the worlds `ids` at the origin of their first modes.

    Args:
      ids: worlds, [N].
      schedule: of N worlds.
      phase: where in their first mode they start, [N].
      support: height of the support plane at the origin, metres, [N].

    Raises:
      ValueError: the schedule holds more commands than there is room for.
    """
    state, used = self.state, schedule.modes.shape[1]
    if used > state.schedule_modes.shape[1]:
      raise ValueError(
        f'The schedule holds {used} commands, room is for '
        f'{state.schedule_modes.shape[1]}: raise max_knots.'
      )
    self.check_rate(float(np.max(schedule.clock_rate, initial=1.0)))
    state.schedule_modes[ids, :used] = schedule.modes
    state.schedule_steps[ids] = _NEVER
    state.schedule_steps[ids, :used] = schedule.start_steps(self._timestep)
    state.clock_rate[ids] = schedule.clock_rate
    state.knot[ids] = 0
    state.step[ids] = 0
    state.mode[ids] = schedule.modes[:, 0]
    state.phase[ids] = phase
    state.anchor[ids] = 0.0
    state.anchor[ids, 2] = support
    state.heading[ids] = 0.0
    state.pending[ids] = -1
    state.pace[ids] = 1.0
    self._forget_ledge(ids)

  def match_pace(self, ids: np.ndarray, velocity: np.ndarray) -> None:
    """Starts the gaits of `ids` with the robots' own speed.

    Of no effect without `feasible_references`.

    Args:
      ids: worlds, [N].
      velocity: of the trunks in the world, m/s, [N, 3].
    """
    self.state.pace[ids] = self._own_pace(ids, velocity)

  def check_rate(self, rate: float) -> None:
    """Raises ValueError if cycles are shorter than a control step at a rate.

    Args:
      rate: of the phase clock, 1 being the references' own.
    """
    for motion in self.bank.motions if rate > self._fastest else ():
      motion_lib.check_cycle(motion, self._timestep, rate)

  def _forget_ledge(self, ids: np.ndarray) -> None:
    self.state.edge[ids], self.state.rise[ids] = np.inf, 0.0

  def expect_ledge(
    self, ids: np.ndarray, edge: np.ndarray, rise: float
  ) -> None:
    """Sets the ledges that the modes of the worlds `ids` climb or descend.

    Args:
      ids: worlds, [N].
      edge: x of its edge, world metres, [N]; infinite if there is none.
      rise: its height in the motion, metres.
    """
    self.state.edge[ids], self.state.rise[ids] = edge, rise

  def expected_support(
    self, x: np.ndarray, ids: np.ndarray | slice = slice(None)
  ) -> np.ndarray:
    """Returns the ground heights at `x` that the motions expect, metres, [N].

    Args:
      x: world positions of the worlds `ids`, metres, [N].
      ids: worlds, [N]; all by default.
    """
    state = self.state
    climbed = x >= state.edge[ids]
    return state.anchor[ids, 2] + np.where(climbed, state.rise[ids], 0.0)

  def advance(self) -> None:
    """Advances every world's clock by one control step."""
    state = self.state
    state.step[:] += 1
    state.phase[:] += self._phase_step()
    over = state.phase >= 1.0
    if over.any():
      self._wrap(over)

  def _phase_step(self) -> np.ndarray:
    """Returns the increments of the phases in a control step, [B]."""
    state, durations = self.state, self.bank.durations
    return self._timestep * state.clock_rate / durations[state.mode]

  def ahead(self, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns phases and headings within the control step that comes.

    Args:
      share: of the control step that has passed, in [0, 1).

    Returns:
      Phases [B], and commanded headings, radians, [B].
    """
    state, bank = self.state, self.bank
    phase = state.phase + share * self._phase_step()
    hold = (phase >= 1.0) & bank.transient[state.mode]
    again = (phase >= 1.0) & ~hold
    heading = state.heading + again * bank.turns[state.mode]
    return np.where(hold, 1.0, phase - again), heading

  def take_offs(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns the take-offs of the control step that `advance` ended.

    Returns:
      Worlds whose clocks have just passed the take-off of their mode, [N], and
      the take-off velocities of their references, world m/s, [N, 3].
    """
    state, bank = self.state, self.bank
    takeoffs = bank.takeoffs[state.mode]
    before = state.phase - self._phase_step()
    passed = (state.phase >= takeoffs) & (before < takeoffs)
    ids = np.flatnonzero(passed & (takeoffs > 0))
    velocity = bank.start_velocity(state.mode[ids], takeoffs[ids])
    velocity *= self._speed_up(ids)
    return ids, _turn(velocity, state.heading[ids])

  def _rise(self, ids: np.ndarray | slice) -> np.ndarray:
    """Returns the factor of the heights of flights at the clock rates, [N].

    A flight that lasts 1/r as long rises 1/r^2 as high. Slower than 1, a body
    cannot fly; the reference keeps its height.
    """
    rate = np.maximum(self.state.clock_rate[ids], 1.0)
    return np.where(self._sinks[self.state.mode[ids]], rate**-2.0, 1.0)

  def _speed_up(self, ids: np.ndarray) -> np.ndarray:
    """Returns factors of velocities at the clock rates, [N, 3]."""
    rate = self.state.clock_rate[ids]
    return np.stack([rate, rate, rate * self._rise(ids)], axis=1)

  def _wrap(self, over: np.ndarray) -> None:
    """Ends cycles: transient modes hold phase 1, the others restart at 0."""
    state, bank = self.state, self.bank
    hold = over & bank.transient[state.mode]
    again = np.flatnonzero(over & ~hold)
    state.phase[hold] = 1.0
    state.phase[again] -= 1.0
    modes = state.mode[again]
    moved = bank.displacements[modes]
    slower = state.pace[again] < 1
    if slower.any():
      moved = moved * ((1 + state.pace[again]) / 2)[:, None]
      state.pace[again] = 1.0
    state.anchor[again] += _turn(moved, state.heading[again])
    state.heading[again] += bank.turns[modes]

  def take_due_commands(self) -> None:
    """Makes the commands that are due now pending."""
    state = self.state
    following = np.minimum(state.knot + 1, state.schedule_steps.shape[1] - 1)
    rows = np.arange(len(following))
    due = (state.schedule_steps[rows, following] <= state.step) & (
      following > state.knot
    )
    ids = np.flatnonzero(due)
    state.knot[ids] += 1
    state.pending[ids] = state.schedule_modes[ids, state.knot[ids]]

  def pop_pending(self, gated: bool) -> tuple[np.ndarray, np.ndarray]:
    """Pops the pending commands that the robots can obey now.

    Args:
      gated: holds commands in flight, shortly before a take-off, and before
        the end of a mode with a take-off; see `schedule.PUSH_OFF`.

    Returns:
      Worlds whose mode changes, [N], and their new modes, [N]. A command of the
      running mode changes nothing and is left out.
    """
    state = self.state
    ids = np.flatnonzero(state.pending >= 0)
    if gated and len(ids):
      ids = ids[self.can_obey(ids)]
    modes = state.pending[ids]
    state.pending[ids] = -1
    changed = modes != state.mode[ids]
    return ids[changed], modes[changed]

  def can_obey(self, ids: np.ndarray) -> np.ndarray:
    """Returns whether the robots of `ids` can follow a new command, [N].

    A robot cannot in flight, nor while it pushes off, nor before the end of a
    mode with a take-off, which no controller could abort.
    """
    state, bank = self.state, self.bank
    modes, phases = state.mode[ids], state.phase[ids]
    push_off = schedule_lib.PUSH_OFF * state.clock_rate[ids]
    grounded = bank.grounded(modes, phases, push_off) <= phases
    return np.where(bank.takeoffs[modes] > 0, phases >= 1.0, grounded)

  def command(
    self,
    ids: np.ndarray,
    modes: np.ndarray,
    position: np.ndarray,
    support: np.ndarray,
    velocity: np.ndarray,
  ) -> None:
    """Starts new modes where the robots are now.

    Args:
      ids: worlds, [N].
      modes: their new modes, [N].
      position: of the trunk in the world, metres, [N, 3].
      support: height of the support plane under it, metres, [N].
      velocity: of the trunk in the world, m/s, [N, 3].
    """
    state = self.state
    old = self.bank.sample(state.mode[ids], state.phase[ids])
    # The robot's own yaw never enters, so that yaw drift is corrected.
    state.heading[ids] += motion_lib.yaw(old.orientation)
    state.mode[ids] = modes
    state.phase[ids] = 0.0
    state.anchor[ids, :2] = position[:, :2]
    state.anchor[ids, 2] = support
    self.match_pace(ids, velocity)
    self._forget_ledge(ids)

  def _own_pace(self, ids: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Returns the robots' speeds as shares of their references', [N]."""
    state, modes = self.state, self.state.mode[ids]
    way = _turn(self.bank.displacements[modes], state.heading[ids])[:, :2]
    rate = state.clock_rate[ids] / self.bank.durations[modes]
    wanted = np.maximum(np.sum(way**2, axis=1) * rate, 1e-9)
    pace = np.clip(np.sum(velocity[:, :2] * way, axis=1) / wanted, 0.0, 1.0)
    return np.where(self._ramps[modes], pace, 1.0)

  def reference(
    self, ids: np.ndarray | slice = slice(None)
  ) -> reference_lib.Reference:
    """Returns the current references of the worlds `ids`, by default of all.

    Positions are in the world frame; orientations are relative to the heading.
    """
    state = self.state
    local = self.bank.sample(state.mode[ids], state.phase[ids])
    position = local.position
    slower = np.flatnonzero(state.pace[ids] < 1)
    if len(slower):
      pace, phase = state.pace[ids][slower], state.phase[ids][slower]
      # Half the square of the phase has a slope that rises from 0 to 1.
      position[slower, :2] *= (pace + (1 - pace) * phase / 2)[:, None]
    rise = self._rise(ids)
    lower = np.flatnonzero(rise < 1)
    if len(lower):
      base = self.bank.base_heights[state.mode[ids][lower]]
      position[lower, 2] -= base
      position[lower, 2] *= rise[lower]
      position[lower, 2] += base
    turned = _turn(position, state.heading[ids])
    return local._replace(position=state.anchor[ids] + turned)

  def airborne(self, ids: np.ndarray) -> np.ndarray:
    """Returns whether the references of `ids` are in flight, [N]."""
    state = self.state
    local = self.bank.sample(state.mode[ids], state.phase[ids])
    return local.has_contact & ~local.contact.any(axis=1)

  def swing_timing(
    self, ids: np.ndarray | slice = slice(None)
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns `ReferenceBank.swing_timing` of `ids` at their phases."""
    state = self.state
    rate = state.clock_rate[ids]
    swinging, time, length = self.bank.swing_timing(
      state.mode[ids], state.phase[ids]
    )
    return swinging, time / rate, length / rate

  def upcoming(
    self, ids: np.ndarray | slice = slice(None)
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns the next commands of the worlds `ids`, by default of all.

    Returns:
      Seconds until the next command, infinite where there is none, [N], and
      its latent (that of the running mode where there is none), [N, n_m].
    """
    state = self.state
    knot, steps = state.knot[ids], state.schedule_steps[ids]
    rows = np.arange(len(knot))
    following = np.minimum(knot + 1, steps.shape[1] - 1)
    due = steps[rows, following]
    exists = (following > knot) & (due < _NEVER)
    countdown = np.where(
      exists, (due - state.step[ids]) * self._timestep, np.inf
    )
    modes = state.schedule_modes[ids][rows, following]
    modes = np.where(exists, modes, state.mode[ids])
    pending = state.pending[ids]
    waits = pending >= 0
    countdown = np.where(waits, 0.0, countdown)
    return countdown, self._latents[np.where(waits, pending, modes)]

  def start_pose(
    self, ids: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns position, orientation and velocity of the references of `ids`.

    In the world frame: [N, 3] metres, [N, 4] quaternions, [N, 3] m/s. Valid
      right after `reset` only, while the headings are zero. See
      `ReferenceBank.start_velocity`.
    """
    state = self.state
    reference = self.reference(ids)
    velocity = self.bank.start_velocity(state.mode[ids], state.phase[ids])
    return (
      reference.position,
      reference.orientation,
      velocity * self._speed_up(ids),
    )

  def commands(self) -> np.ndarray:
    """Returns the latents of the running modes, [B, n_m]."""
    return self._latents[self.state.mode]


def _turn(vectors: np.ndarray, heading: np.ndarray) -> np.ndarray:
  """Turns vectors [B, 3] by headings [B] about z."""
  c, s = np.cos(heading), np.sin(heading)
  x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
  return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
