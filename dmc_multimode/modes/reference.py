"""Reference motions, evaluated for batches of worlds.

A bank stacks the keyframes of M modes into one table, so that B worlds, each in
a mode and at a phase of its own, look their references up together. Frames are
those of `motion`.
"""

from typing import NamedTuple, Sequence, TYPE_CHECKING

import numpy as np
from numpy import typing as npt

from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.utils import constants

if TYPE_CHECKING:
  from scipy.spatial import transform

_LEAST_FLIGHT = 0.05  # Seconds.
# Of legs that walk: v^2 / (g h) at which animals begin to run (Alexander 1989).
_WALKING_FROUDE = 0.5
_IDENTITY = (1.0, 0.0, 0.0, 0.0)


class Reference(NamedTuple):
  """Desired trunk pose and contacts; all arrays have a leading batch axis.

  Attributes:
    position: metres, [B, 3].
    orientation: unit quaternions, [B, 4].
    contact: desired feet contacts, [B, F]; zero where the mode has none.
    has_contact: whether the mode prescribes contacts, [B].
  """

  position: np.ndarray
  orientation: np.ndarray
  contact: np.ndarray
  has_contact: np.ndarray


class ReferenceBank:
  """Several reference motions, evaluated together for a batch of worlds."""

  def __init__(
    self,
    motions: Sequence[motion_lib.ReferenceMotion],
    num_feet: int | None = None,
  ) -> None:
    """Stacks `motions`; their order gives the mode indices.

    Args:
      motions: M of them.
      num_feet: F; that of their contacts by default.
    """
    motion_lib.check_names(motions)
    self.num_feet = num_feet or motion_lib.num_feet(motions)
    self.motions = tuple(motions)
    self.names = tuple(motion.name for motion in motions)
    self.durations = np.array([m.duration for m in motions])
    self.periodic = np.array([m.kind == motion_lib.PERIODIC for m in motions])
    self.transient = np.array([m.kind == motion_lib.TRANSIENT for m in motions])
    self.steady = np.array([m.kind == motion_lib.STEADY for m in motions])
    self.base_heights = np.array([m.positions[0, 2] for m in motions])
    self.takeoffs = np.array([m.takeoff for m in motions])
    self.has_contacts = np.array([m.contacts is not None for m in motions])
    self._stack_keyframes()
    self.touchdowns = np.where(
      self.takeoffs > 0,
      self.grounded(np.arange(len(motions)), self.takeoffs),
      0.0,
    )

  def _stack_keyframes(self) -> None:
    """Builds one table of all keyframes, with equal rows for each motion.

    Spare rows repeat a motion's last keyframe, at an unreachable phase. All
    tables but `_inner_phases` have one row a keyframe.
    """
    num, width = len(self.motions), max(len(m.phases) for m in self.motions)
    phases = np.full((num, width), np.inf)
    positions = np.zeros((num, width, 3))
    orientations = np.tile(np.array(_IDENTITY), (num, width, 1))
    contacts = np.zeros((num, width, self.num_feet))
    for i, motion in enumerate(self.motions):
      k = len(motion.phases)
      phases[i, :k] = motion.phases
      positions[i, :k] = motion.positions
      positions[i, k:] = motion.positions[-1]
      orientations[i, :k] = motion.orientations
      if motion.contacts is not None:
        contacts[i, :k] = motion.contacts
    self._width = width
    self._phases = phases.ravel()
    # By keyframe, then by motion: sums run over contiguous rows.
    self._inner_phases = np.ascontiguousarray(phases[:, 1:-1].T)
    self._positions = positions.reshape(-1, 3)
    self._orientations = orientations.reshape(-1, 4)
    self._contacts = contacts.reshape(-1, self.num_feet)
    self._spans = _contact_spans(phases, contacts).reshape(2, -1)
    self._landings = _next_touch_downs(phases, contacts).ravel()
    airborne = self.has_contacts[:, None] & ~contacts.any(axis=-1)
    airborne &= np.isfinite(phases)  # Spare rows have no contacts.
    self._airborne = airborne.ravel()
    self._flights = _next_flights(airborne).ravel()
    # Modes in which some feet step while others stand.
    standing = contacts.sum(axis=-1)
    steps = (standing > 0) & (standing < self.num_feet)
    self.gaits = self.periodic & self.has_contacts & steps.any(axis=1)
    start = _rotation(orientations[:, :-1].reshape(-1, 4))
    end = _rotation(orientations[:, 1:].reshape(-1, 4))
    # Rotation vector from each keyframe to the next: slerp is its scaling.
    turns = np.zeros((num, width, 3))  # The last keyframes have no successor.
    turns[:, :-1] = (start.inv() * end).as_rotvec().reshape(num, width - 1, 3)
    self._turns = turns.reshape(-1, 3)
    self._turning = turns.any(axis=(1, 2))
    first, last = positions[:, 0], positions[:, -1]
    self.displacements = np.where(self.periodic[:, None], last - first, 0.0)
    # Yaw gained over one cycle; zero for modes that do not turn.
    ends = np.stack([m.orientations[-1] for m in self.motions])
    starts = np.stack([m.orientations[0] for m in self.motions])
    self.turns = np.where(
      self.periodic, motion_lib.yaw(ends) - motion_lib.yaw(starts), 0.0
    )
    self.flies = self.periodic & airborne.any(axis=1)
    # Modes that travel without a flight.
    self.level = ~self.flies & (np.abs(self.displacements[:, :2]).sum(1) > 0)
    speeds = np.linalg.norm(self.displacements[:, :2], axis=1) / self.durations
    gravity = constants.GRAVITY
    fastest = np.sqrt(_WALKING_FROUDE * gravity * self.base_heights)
    # Clock rates beyond which a mode without a flight cannot be followed.
    self.fastest_rates = np.divide(
      fastest, speeds, out=np.full(num, np.inf), where=self.level
    )
    self.straight = (
      self.gaits & ~self._turning & (self.displacements[:, 1] == 0)
    )
    self._velocities = self._keyframe_velocities()

  def grounded(
    self,
    modes: np.ndarray,
    phases: np.ndarray,
    push_off: float | np.ndarray = 0.0,
  ) -> np.ndarray:
    """Postpones phases in a flight to its touch-down, [B].

    Phases at most `push_off` seconds before a take-off are postponed likewise;
    others are returned unchanged.

    Args:
      modes: mode indices, [B].
      phases: phases in [0, 1], [B].
      push_off: seconds at clock rate 1 before a take-off that count as its
        flight; one for all or for each, [B].
    """
    keyframe, _ = self._locate(modes, phases)
    flight = self._flights[keyframe]
    begins = np.where(self._airborne[flight], self._phases[flight], np.inf)
    flies = begins - phases <= push_off / self.durations[modes]
    return np.where(flies, self._landings[flight], phases)

  def __len__(self) -> int:
    return len(self.motions)

  def index(self, name: str) -> int:
    """Returns the index of a mode; raises ValueError naming the known ones."""
    if name not in self.names:
      raise ValueError(
        f'Unknown mode {name!r}; this set has {", ".join(self.names)}.'
      )
    return self.names.index(name)

  def sample(self, modes: np.ndarray, phases: np.ndarray) -> Reference:
    """Evaluates the references in their anchor frames.

    Args:
      modes: mode indices, [B].
      phases: phases in [0, 1], [B].

    Returns:
      The `Reference`: positions and contacts linearly interpolated and held,
      respectively, orientations by spherical linear interpolation.
    """
    keyframe, weight = self._locate(modes, phases)
    return Reference(
      self._position(keyframe, weight),
      self._orientation(modes, keyframe, weight),
      self._contacts.take(keyframe, axis=0),
      self.has_contacts.take(modes),
    )

  def _locate(
    self, modes: np.ndarray, phases: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns last keyframes, [B], and the weights of the next, [B, 1]."""
    # `take` is several times as fast as indexing by mode and keyframe.
    passed = phases >= self._inner_phases.take(modes, axis=1)
    keyframe = modes * self._width + passed.sum(axis=0)
    t0, t1 = self._phases.take(keyframe), self._phases.take(keyframe + 1)
    return keyframe, ((phases - t0) / (t1 - t0))[:, None]

  def _position(self, keyframe: np.ndarray, weight: np.ndarray) -> np.ndarray:
    start = self._positions.take(keyframe, axis=0)
    return start + weight * (self._positions.take(keyframe + 1, axis=0) - start)

  def _orientation(
    self, modes: np.ndarray, keyframe: np.ndarray, weight: np.ndarray
  ) -> np.ndarray:
    orientation = self._orientations.take(keyframe, axis=0)
    # Few modes turn, and the quaternion products are the costliest part.
    rows = np.flatnonzero(self._turning.take(modes))
    if len(rows):
      turn = _rotation_from_vector(weight[rows] * self._turns[keyframe[rows]])
      turned = _rotation(orientation[rows]) * turn
      orientation[rows] = turned.as_quat(scalar_first=True)
    return orientation

  def velocity(
    self, modes: np.ndarray, phases: np.ndarray, step: float = 1e-3
  ) -> np.ndarray:
    """Returns trunk velocities at clock rate 1 by central difference.

    Args:
      modes: mode indices, [B].
      phases: phases in [0, 1], [B].
      step: half-width of the difference, in phase.

    Returns:
      Linear velocities in the anchor frame, in m/s, [B, 3].
    """
    before = np.clip(phases - step, 0.0, 1.0)
    after = np.clip(phases + step, 0.0, 1.0)
    moved = self._position(*self._locate(modes, after))
    moved = moved - self._position(*self._locate(modes, before))
    return moved / ((after - before) * self.durations[modes])[:, None]

  def start_velocity(self, modes: np.ndarray, phases: np.ndarray) -> np.ndarray:
    """Returns trunk velocities that a body can follow the reference with.

    Positions are interpolated linearly, without gravity: a body that took off
      with the slope as velocity would land short. In flight this is therefore
      the velocity of the ballistic path to the next touch-down; on the ground
      it is linear between keyframes, up to the take-off velocity.

    Args:
      modes: mode indices, [B].
      phases: phases in [0, 1], [B].

    Returns:
      Linear velocities in the anchor frame at clock rate 1, in m/s, [B, 3].
    """
    keyframe, weight = self._locate(modes, phases)
    before = self._velocities[keyframe]
    after = self._velocities[keyframe + 1]
    return np.where(
      self._airborne[keyframe][:, None],
      self._ballistic_velocity(modes, phases, self._landings[keyframe]),
      before + weight * (after - before),
    )

  def swing_timing(
    self, modes: np.ndarray, phases: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the swinging feet, and time and duration of their swing.

    Args:
      modes: mode indices, [B].
      phases: phases in [0, 1], [B].

    Returns:
      Mask of the feet that swing while another stands, [B, F];
      time since the middle of the swing at clock rate 1, seconds, [B]; its
      duration, seconds, [B].
    """
    keyframe, _ = self._locate(modes, phases)
    contact = self._contacts[keyframe]
    steps = contact.any(axis=1) & ~contact.all(axis=1)
    single = self.has_contacts[modes] & steps
    begin, end = self._spans[:, keyframe]
    duration = self.durations[modes]
    return (
      single[:, None] & (contact == 0),
      (phases - (begin + end) / 2) * duration,
      (end - begin) * duration,
    )

  def _ballistic_velocity(
    self, modes: np.ndarray, phases: np.ndarray, landings: np.ndarray
  ) -> np.ndarray:
    """Returns ballistic velocities to references at `landings`, m/s, [B, 3].

    With g = 9.81 m/s^2 along -z and the time t until the landing,
    v = (p(landing) - p(now)) / t + g t / 2.
    """
    # Just before touch-down t would be too small a divisor.
    least = _LEAST_FLIGHT / self.durations[modes]
    start = np.clip(landings - least, 0.0, phases)
    span = np.maximum(landings - start, least)
    time = (span * self.durations[modes])[:, None]
    moved = self._position(*self._locate(modes, landings))
    moved = moved - self._position(*self._locate(modes, start))
    return moved / time + 0.5 * time * np.array([0.0, 0.0, constants.GRAVITY])

  def _keyframe_velocities(self) -> np.ndarray:
    """Returns `start_velocity` at the keyframes."""
    modes = np.repeat(np.arange(len(self.motions)), self._width)
    phases = np.minimum(self._phases, 1.0)
    slopes = self.velocity(modes, phases)
    flight = self._ballistic_velocity(modes, phases, self._landings)
    return np.where(self._airborne[:, None], flight, slopes)


def _contact_spans(phases: np.ndarray, contacts: np.ndarray) -> np.ndarray:
  """Returns start and end phases of keyframes' contacts, [2, M, K]."""
  width = phases.shape[1]
  phases = np.minimum(phases, 1.0)
  spans = np.stack([phases, np.roll(phases, -1, axis=1)])
  spans[1, :, -1] = 1.0
  same = (contacts[:, 1:] == contacts[:, :-1]).all(axis=-1)
  for i in range(1, width):
    spans[0, :, i] = np.where(
      same[:, i - 1], spans[0, :, i - 1], spans[0, :, i]
    )
    j = width - 1 - i
    spans[1, :, j] = np.where(same[:, j], spans[1, :, j + 1], spans[1, :, j])
  return spans


def _next_touch_downs(phases: np.ndarray, contacts: np.ndarray) -> np.ndarray:
  """Returns the phase of the first contact at or after keyframes, [M, K]."""
  landings = np.where(contacts.any(axis=-1), np.minimum(phases, 1.0), np.inf)
  landings = np.minimum.accumulate(landings[:, ::-1], axis=1)[:, ::-1]
  return np.minimum(landings, 1.0)


def _next_flights(airborne: np.ndarray) -> np.ndarray:
  """Returns the current or next flight of each keyframe, [M, K].

  A flight is given by the row of its keyframe in the table of all; it is the
  motion's last keyframe if no flight follows.
  """
  num, width = airborne.shape
  flights = np.where(airborne, np.arange(width), width - 1)
  flights = np.minimum.accumulate(flights[:, ::-1], axis=1)[:, ::-1]
  return flights + width * np.arange(num)[:, None]


def _rotation(quaternions: np.ndarray) -> 'transform.Rotation':
  from scipy.spatial import transform  # Late: scipy imports slowly.

  return transform.Rotation.from_quat(quaternions, scalar_first=True)


def _rotation_from_vector(vectors: np.ndarray) -> 'transform.Rotation':
  from scipy.spatial import transform

  return transform.Rotation.from_rotvec(vectors)


def sample(
  motion: motion_lib.ReferenceMotion, phases: npt.ArrayLike
) -> Reference:
  """Returns one motion's reference at `phases`, each in [0, 1], [T]."""
  bank = ReferenceBank([motion])
  phases = np.asarray(phases, dtype=np.float64)
  return bank.sample(np.zeros(len(phases), dtype=np.int64), phases)
