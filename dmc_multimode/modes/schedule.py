"""Mode schedules: commanded modes, their times and clock rates.

One type serves training (an initial mode, a switch time, a final mode),
planning (a mode a knot) and people (names with durations). A schedule refers to
modes by their index in a mode set and has one leading batch axis.
"""

import dataclasses
from typing import Sequence

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.utils import durations as durations_lib

CLIPS = (0, 1)  # Algorithm 1: clip_s ~ U{0, 1}.
SWITCH_PHASES = (0.25, 0.5, 0.75)  # Algorithm 1: phi_s ~ U{.25, .5, .75}.
# Seconds before a take-off in which a robot cannot stop.
PUSH_OFF = 0.15


@dataclasses.dataclass(frozen=True, eq=False)
class ModeSchedule:
  """A zero-order spline of modes for each of B worlds.

  Attributes:
    modes: mode indices, [B, K].
    starts: times at which they are commanded, in seconds, [B, K]; the first
      column is 0, rows rise, and unused columns are infinite.
    clock_rate: rate of the phase clock, 1 being the reference's own, [B].
  """

  modes: np.ndarray
  starts: np.ndarray
  clock_rate: np.ndarray

  def __post_init__(self) -> None:
    shape = np.shape(self.modes)
    if len(shape) != 2 or shape[1] < 1 or np.shape(self.starts) != shape:
      raise ValueError('A schedule needs modes and starts of one shape [B, K].')
    if np.shape(self.clock_rate) != shape[:1]:
      raise ValueError('A schedule needs one clock rate a world.')
    if np.any(self.starts[:, 0] != 0):
      raise ValueError('A schedule must begin at time 0.')
    later, earlier = self.starts[:, 1:], self.starts[:, :-1]
    if not np.all((later > earlier) | np.isinf(later)):
      raise ValueError('The start times of a schedule must rise.')
    if not np.all(np.isfinite(self.clock_rate) & (self.clock_rate > 0)):
      raise ValueError('Clock rates must be positive.')

  def __len__(self) -> int:
    return len(self.modes)

  def last_modes(self) -> np.ndarray:
    """Returns the index of each schedule's last mode, [B]."""
    last = np.isfinite(self.starts).sum(axis=1) - 1
    return self.modes[np.arange(len(last)), last]

  def start_steps(self, control_timestep: float) -> np.ndarray:
    """Returns the starts as control steps, [B, K]; unused ones are int max."""
    return durations_lib.steps(self.starts, control_timestep)


def single(modes: np.ndarray, clock_rate: float = 1.0) -> ModeSchedule:
  """Returns one mode for the whole episode of each world; `modes` is [B]."""
  modes = np.atleast_1d(np.asarray(modes, dtype=np.int64))[:, None]
  rates = np.full(len(modes), float(clock_rate))
  return ModeSchedule(modes, np.zeros(modes.shape), rates)


def transitions(
  mode_set: mode_set_lib.ModeSet,
  initial: np.ndarray,
  final: np.ndarray,
  clips: np.ndarray,
  phases: np.ndarray,
  clock_rate: np.ndarray | None = None,
) -> ModeSchedule:
  """Returns the episodes of Algorithm 1: m_i until t_s, then m_f.

  With the clip's duration T_i of the initial mode at its clock rate,

      t_s = (clip_s + phi_s) T_i,  clip_s ~ U{0, 1}, phi_s ~ U{.25, .5, .75}

  (Krishna and Nguyen, Algorithm 1). A mode with a take-off is not left before
  its touch-down. Whether a command that falls into a flight waits for the
  ground is up to the task; see `ImitationConfig.commands_from_ground`.

  Args:
    mode_set: the modes.
    initial, final: mode indices, [B].
    clips, phases: clip_s and phi_s, [B].
    clock_rate: of the phase clocks, [B]; 1 by default.
  """
  rates = np.ones(len(initial)) if clock_rate is None else clock_rate
  bank = mode_set.bank
  cycles = np.maximum(clips + phases, bank.touchdowns[initial])
  switch = cycles * bank.durations[initial] / rates
  modes = np.stack([initial, final], axis=1).astype(np.int64)
  starts = np.stack([np.zeros(len(switch)), switch], axis=1)
  return ModeSchedule(modes, starts, rates)


def from_knots(
  modes: np.ndarray, knot_duration: float, clock_rate: float = 1.0
) -> ModeSchedule:
  """Returns a plan: `modes` [B, K], one every `knot_duration` seconds."""
  modes = np.atleast_2d(np.asarray(modes, dtype=np.int64))
  if not 0 < knot_duration < np.inf:
    raise ValueError(f'Knots must last longer than 0 s, got {knot_duration}.')
  starts = np.tile(np.arange(modes.shape[1]) * knot_duration, (len(modes), 1))
  return ModeSchedule(modes, starts, np.full(len(modes), float(clock_rate)))


def from_names(
  mode_set: mode_set_lib.ModeSet,
  names: Sequence[str],
  durations: Sequence[float],
  clock_rate: float = 1.0,
) -> ModeSchedule:
  """Returns one world's schedule from mode names and seconds of each."""
  if len(names) != len(durations) or not names:
    raise ValueError('A schedule needs as many durations as modes, at least 1.')
  for name, duration in zip(names, durations, strict=True):
    if not (np.isfinite(duration) and duration > 0):
      raise ValueError(f'{name} needs a positive duration, got {duration}.')
  modes = np.array([[mode_set.index(name) for name in names]])
  starts = np.concatenate([[0.0], np.cumsum(durations)[:-1]])[None]
  return ModeSchedule(modes, starts, np.array([float(clock_rate)]))


def parse(text: str) -> tuple[list[str], list[float]]:
  """Parses 'walk_forward:2,leap_forward:3' to mode names and seconds.

  Raises:
    ValueError: with one line that quotes the faulty item.
  """
  names, durations = [], []
  for item in text.split(','):
    name, colon, seconds = item.strip().partition(':')
    try:
      duration = float(seconds)
    except ValueError:
      duration = float('nan')
    if not (name and colon and np.isfinite(duration) and duration > 0):
      raise ValueError(
        f'Schedule item {item.strip()!r} is not MODE:SECONDS with positive '
        'seconds, as in walk_forward:2,leap_forward:3.'
      )
    names.append(name)
    durations.append(duration)
  return names, durations
