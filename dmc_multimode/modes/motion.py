"""Rough reference motions of the trunk, given by keyframes.

A mode is a few keyframes of the trunk (the paper's base), and optionally of the
contacts of the feet, over a normalised phase (Krishna and Nguyen, Sec. II-A),
without joints or physics; `reference` evaluates motions.

Frames. Keyframes live in the *anchor frame* of a mode command: its origin is
the point of the support plane under the trunk at the time of the command, x
points along the commanded heading, z up. Quaternions are (w, x, y, z).
"""

import dataclasses
from typing import Sequence

import numpy as np

from dmc_multimode.utils import constants

PERIODIC = 'periodic'  # The cycle repeats from where it ended.
TRANSIENT = 'transient'  # Runs once, then holds its last pose and phase.
STEADY = 'steady'  # One pose; only the clock runs.
KINDS = (PERIODIC, TRANSIENT, STEADY)

# Contact states are ordered (left, right), or as the robot's feet are.
NUM_FEET = 2  # Of the library's motions.
FEET_COUNTS = (2, 4)
# How far apart the ends of a cycle may be.
_CLOSED_HEIGHT, _CLOSED_ANGLE = 0.02, 0.05  # Metres, radians.


@dataclasses.dataclass(frozen=True)
class Ledge:
  """A rise or fall of the ground that a mode is made for.

  Attributes:
    edge: distance from the start of the mode to the edge, in metres along x.
    height: height of the support behind the edge over that before, in metres.
  """

  edge: float
  height: float


@dataclasses.dataclass(frozen=True, eq=False)
class ReferenceMotion:
  """One clip (a single cycle) of a locomotion mode.

  Attributes:
    name: of the mode.
    kind: 'periodic', 'transient' or 'steady'.
    duration: length of the clip at clock rate 1, in seconds.
    phases: keyframe phases, rising from 0 to 1, shape [K].
    positions: of the trunk in the anchor frame, metres, shape [K, 3].
    orientations: of the trunk in the anchor frame, shape [K, 4].
    contacts: feet on the ground (1) or not (0), held until the next keyframe,
      shape [K, F] with F of 2 or 4, or None where the mode leaves them free.
    ledge: ledge that the mode needs, or None for level ground.
    takeoff: phase of the take-off of a jump, or 0. Episodes do not switch away
      from the mode before the touch-down that follows.
    mirror: name of the left-right mirrored mode; the mode itself by default.
    half_cycle_symmetric: whether the reference is the same half a cycle later,
      so that its mirror image may run half a cycle out of phase.
  """

  name: str
  kind: str
  duration: float
  phases: np.ndarray
  positions: np.ndarray
  orientations: np.ndarray
  contacts: np.ndarray | None = None
  ledge: Ledge | None = None
  takeoff: float = 0.0
  mirror: str = ''
  half_cycle_symmetric: bool = False

  def __post_init__(self) -> None:
    as_array = lambda x: np.asarray(x, dtype=np.float64)
    object.__setattr__(self, 'phases', as_array(self.phases))
    object.__setattr__(self, 'positions', as_array(self.positions))
    orientations = as_array(self.orientations)
    norms = np.linalg.norm(orientations, axis=-1, keepdims=True)
    if orientations.ndim != 2 or np.any(norms < 1e-6):
      raise ValueError(f'{self.name}: orientations must be non-zero [K, 4].')
    # Unit quaternions stay the same to the bit, so that a motion survives
    # writing and reading.
    norms[np.abs(norms - 1.0) < 1e-12] = 1.0
    object.__setattr__(self, 'orientations', orientations / norms)
    if self.contacts is not None:
      object.__setattr__(self, 'contacts', as_array(self.contacts))
    object.__setattr__(self, 'mirror', self.mirror or self.name)
    self._validate()

  def __repr__(self) -> str:
    """Returns one line; the keyframes are in the attributes."""
    return (
      f'ReferenceMotion({self.name}, {self.kind}, {self.duration:g} s, '
      f'{len(self.phases)} keyframes)'
    )

  @property
  def num_feet(self) -> int | None:
    """Number F of the feet of the contacts; None where these are free."""
    if self.contacts is None:
      return None
    return self.contacts.shape[1] if self.contacts.ndim == 2 else NUM_FEET

  def _validate(self) -> None:
    """Raises ValueError with one line for an invalid motion."""
    k = len(self.phases)
    shapes = {'positions': (k, 3), 'orientations': (k, 4)}
    if self.contacts is not None:
      feet = self.num_feet or NUM_FEET
      if feet not in FEET_COUNTS:
        raise ValueError(
          f'{self.name}: contacts must be of two or four feet, got {feet}.'
        )
      shapes['contacts'] = (k, feet)
      if not np.isin(self.contacts, (0.0, 1.0)).all():
        raise ValueError(f'{self.name}: contacts must be 0 or 1.')
    for field, shape in shapes.items():
      value = getattr(self, field)
      if value.shape != shape:
        raise ValueError(
          f'{self.name}: {field} has shape {value.shape}, expected {shape}.'
        )
      if not np.isfinite(value).all():
        raise ValueError(f'{self.name}: {field} must be finite.')
    if self.kind not in KINDS:
      raise ValueError(
        f'{self.name}: kind {self.kind!r} is not one of {KINDS}.'
      )
    if not (np.isfinite(self.duration) and self.duration > 0):
      raise ValueError(f'{self.name}: duration must be positive.')
    if k < 2 or self.phases[0] != 0 or self.phases[-1] != 1:
      raise ValueError(f'{self.name}: phases must run from 0 to 1.')
    if not np.all(np.diff(self.phases) > 0):
      raise ValueError(f'{self.name}: phases must rise strictly.')
    if not 0 <= self.takeoff <= 1:
      raise ValueError(f'{self.name}: takeoff must be a phase in [0, 1].')
    if self.kind == STEADY and np.any(self.positions != self.positions[0]):
      raise ValueError(f'{self.name}: a steady mode has one base position.')
    if self.kind != TRANSIENT:
      self._check_closed()

  def _check_closed(self) -> None:
    """Raises ValueError if the reference jumps where a cycle repeats.

    A periodic mode may go on over the ground and turn about the vertical.
    """
    rise = self.positions[-1, 2] - self.positions[0, 2]
    if abs(rise) > _CLOSED_HEIGHT:
      raise ValueError(
        f'{self.name}: a cycle must end at the height where it begins, within '
        f'{_CLOSED_HEIGHT} m: this one ends {rise:+.3g} m from it.'
      )
    ends = self.orientations[[0, -1]]
    if self.kind == PERIODIC:
      ends = _without_yaw(ends)
    apart = angle_between(*ends)
    if apart > _CLOSED_ANGLE:
      turned = 'but for yaw ' if self.kind == PERIODIC else ''
      raise ValueError(
        f'{self.name}: a cycle of a {self.kind} mode must end {turned}in the '
        f'orientation in which it begins, within {_CLOSED_ANGLE} rad: this one '
        f'ends {apart:.3g} rad from it.'
      )


def check_cycle(
  motion: ReferenceMotion, control_timestep: float, clock_rate: float = 1.0
) -> None:
  """Raises ValueError if a control step is longer than a motion's cycle.

  Args:
    motion: a transient one has no cycle.
    control_timestep: seconds.
    clock_rate: of the phase.
  """
  fastest = motion.duration / control_timestep
  if motion.kind == TRANSIENT or clock_rate <= fastest * (1 + 1e-9):
    return
  rate = f' at the clock rate {clock_rate:g}' if clock_rate != 1 else ''
  raise ValueError(
    f'{motion.name}: its cycle of {motion.duration:g} s{rate} is shorter than '
    f'a control step of {control_timestep:g} s; the clock rate may be at most '
    f'{fastest:g}.'
  )


def check_start(
  motion: ReferenceMotion,
  distance: float = constants.TRACKING_DISTANCE,
  angle: float = constants.TRACKING_ANGLE,
  stand_height: float = constants.STAND_HEIGHT,
) -> None:
  """Raises ValueError if every command of a motion would be lost at once.

  A command finds the robot upright over the anchor, in the commanded heading.

  Args:
    motion: its first keyframe is checked.
    distance: bound on that of the trunk from its reference, metres.
    angle: bound on that of its orientation, radians.
    stand_height: of the robot's trunk over its feet, metres.
  """
  stand = np.array([0.0, 0.0, stand_height])
  away = np.linalg.norm(motion.positions[0] - stand)
  if away > distance:
    raise ValueError(
      f'{motion.name}: the first keyframe is {away:.3g} m from (0, 0, '
      f'{stand_height:g}), where a command finds the trunk: every '
      f'command would be lost at once; at most {distance:g} m are possible.'
    )
  turned = angle_between(motion.orientations[0], np.eye(4)[0])
  if turned > angle:
    raise ValueError(
      f'{motion.name}: the first keyframe is turned by {turned:.3g} rad from '
      'upright in the commanded heading: every command would be lost at once; '
      f'at most {angle:g} rad are possible.'
    )


def check_names(motions: Sequence[ReferenceMotion]) -> None:
  """Raises ValueError for no motions, or two of the same name."""
  if not motions:
    raise ValueError('A mode set needs at least one mode.')
  names = [motion.name for motion in motions]
  if len(set(names)) != len(names):
    raise ValueError(f'Mode names must be unique, got {names}.')


def num_feet(motions: Sequence[ReferenceMotion]) -> int:
  """Returns the number of feet of motions; 2 if none has contacts.

  Raises:
    ValueError: two motions have contacts of different numbers of feet.
  """
  counts = {m.num_feet: m.name for m in motions if m.num_feet is not None}
  if len(counts) > 1:
    (one, first), (other, second) = list(counts.items())[:2]
    raise ValueError(
      f'{first} has contacts of {one} feet, and {second} of {other}.'
    )
  return next(iter(counts), NUM_FEET)


def scaled(motion: ReferenceMotion, stand_height: float) -> ReferenceMotion:
  """Returns a library's motion for a robot of another height.

  Lengths are in proportion to the height h of the trunk, and times to
  sqrt(h / g), in which bodies of another size move alike (Alexander 1989).

  Args:
    motion: for a trunk that stands 0.5 m high.
    stand_height: h, metres.
  """
  size = stand_height / constants.STAND_HEIGHT
  if size == 1:
    return motion
  ledge = motion.ledge
  return dataclasses.replace(
    motion,
    duration=motion.duration * float(np.sqrt(size)),
    positions=motion.positions * size,
    ledge=ledge and Ledge(ledge.edge * size, ledge.height * size),
  )


def blend(
  motions: Sequence[ReferenceMotion], weights: Sequence[float], name: str
) -> ReferenceMotion:
  """Returns the weighted mean of motions, which is a motion.

  Steady motions, which have no cycle of their own, take part with their pose.

  Args:
    motions: at least one of them periodic, or all steady.
    weights: of the motions, of sum 1.
    name: of the blend.

  Raises:
    ValueError: a motion is transient, or two cycles have another duration or
      other contacts.
  """
  cycles = [motion for motion in motions if motion.kind != STEADY] or motions
  first = cycles[0]
  for motion in cycles:
    if motion.kind == TRANSIENT:
      raise ValueError(f'{name}: {motion.name} has no cycle to blend.')
    if motion.duration != first.duration:
      raise ValueError(
        f'{name}: cycles of {first.duration:g} s ({first.name}) and '
        f'{motion.duration:g} s ({motion.name}) cannot be blended.'
      )
  phases = np.unique(np.concatenate([motion.phases for motion in cycles]))
  held = [_contacts_at(motion, phases) for motion in cycles]
  if any(not np.array_equal(other, held[0]) for other in held):
    raise ValueError(f'{name}: cycles with other contacts cannot be blended.')
  positions, orientations = np.zeros((len(phases), 3)), np.zeros(4)
  for motion, weight in zip(motions, weights, strict=True):
    columns = np.hstack([motion.positions, motion.orientations]).T
    at = [np.interp(phases, motion.phases, column) for column in columns]
    positions = positions + weight * np.stack(at[:3], axis=1)
    orientations = orientations + weight * np.stack(at[3:], axis=1)
  return ReferenceMotion(
    name,
    first.kind,
    first.duration,
    phases,
    positions,
    orientations,
    held[0] if first.contacts is not None else None,
  )


def _contacts_at(motion: ReferenceMotion, phases: np.ndarray) -> np.ndarray:
  """Returns the contacts at phases, [K, F]; empty for none."""
  if motion.contacts is None:
    return np.zeros((len(phases), 0))
  rows = np.searchsorted(motion.phases, phases, side='right') - 1
  return motion.contacts[rows]


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
  """Returns the angle between two unit quaternions [4], radians."""
  return float(2 * np.arccos(np.minimum(np.abs(one @ other), 1.0)))


def _without_yaw(quaternions: np.ndarray) -> np.ndarray:
  """Turns orientations [K, 4] about z to a heading of zero."""
  half = yaw(quaternions) / 2
  c, s = np.cos(half), np.sin(half)
  w, x, y, z = quaternions.T
  # The product of the inverse heading (c, 0, 0, -s) and the quaternion.
  return np.stack(
    [c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w], 1
  )


def tilt(quaternions: np.ndarray) -> np.ndarray:
  """Returns roll and pitch of quaternions [..., 4], in radians, [..., 2].

  After the yaw about z: the pitch about the y axis so turned, positive for a
  trunk that leans ahead, and the roll about the x axis of that, positive for
  one that leans to its right.
  """
  w, x, y, z = np.moveaxis(np.asarray(quaternions), -1, 0)
  roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
  pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
  return np.stack([roll, pitch], axis=-1)


def yaw(quaternions: np.ndarray) -> np.ndarray:
  """Returns the heading angle of quaternions [..., 4], in radians."""
  w, x, y, z = np.moveaxis(np.asarray(quaternions), -1, 0)
  return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
