"""Gait metrics: motion of trunk and feet in an episode."""

from typing import Iterable, Mapping, NamedTuple

import numpy as np

_SETTLED = 1.0  # Seconds after which a gait has settled.
_STANCE_HEIGHT = 0.08  # Metres: tolerance of the trunk's height in a stance.
_SAME_PLANE = 1e-3  # Metres.


class Trace(NamedTuple):
  """One episode of one mode, T control steps.

  Attributes:
    position: of the trunk, world metres, [T, 3].
    reference: position of the reference, likewise.
    support: height of the support plane, metres, [T].
    yaw: of the trunk, radians, [T].
    tilt: its roll and pitch, radians, [T, 2]; see `motion.tilt`.
    contact: feet on the ground, in the robot's order, 0 or 1, [T, F].
    reference_contact: contacts of the reference, likewise.
    timestep: seconds.
    cycle: seconds of a cycle of the mode.
  """

  position: np.ndarray
  reference: np.ndarray
  support: np.ndarray
  yaw: np.ndarray
  tilt: np.ndarray
  contact: np.ndarray
  reference_contact: np.ndarray
  timestep: float
  cycle: float

  @property
  def height(self) -> np.ndarray:
    """Height of the trunk over its support, metres, [T]."""
    return self.position[:, 2] - self.support

  def cycles(self, values: np.ndarray) -> list[np.ndarray]:
    """Returns whole cycles of values [T, ...]; all values if there is none."""
    length = max(round(self.cycle / self.timestep), 1)
    whole = len(values) // length
    return np.split(values[: whole * length], whole) if whole else [values]

  def settled(self, values: np.ndarray) -> np.ndarray:
    """Returns values after the start-up of the gait, two rows at least."""
    return values[
      min(round(_SETTLED / self.timestep), max(len(values) - 2, 0)) :
    ]

  def velocity(self, way: np.ndarray) -> np.ndarray:
    """Returns the mean velocity of positions [T, ...] when settled, m/s."""
    way = self.settled(way)
    return (way[-1] - way[0]) / (max(len(way) - 1, 1) * self.timestep)


def traces(
  measured: Mapping[str, np.ndarray],
  lengths: Iterable[int],
  timestep: float,
  cycle: float,
) -> list[Trace]:
  """Splits measurements of `BatchedImitation.measure` into episodes.

  Args:
    measured: values after every step by name, [T, B, ...].
    lengths: control steps of the B episodes, [B].
    timestep: seconds of a control step.
    cycle: seconds of a cycle of the mode.
  """
  return [
    Trace(
      position=measured['position'][:length, world],
      reference=measured['reference'][:length, world],
      support=measured['support'][:length, world],
      yaw=measured['yaw'][:length, world],
      tilt=measured['tilt'][:length, world],
      contact=measured['contact'][:length, world],
      reference_contact=measured['reference_contact'][:length, world],
      timestep=timestep,
      cycle=cycle,
    )
    for world, length in enumerate(lengths)
  ]


def metrics(trace: Trace) -> dict[str, float]:
  """Returns all metrics of an episode by name.

  velocity, lateral_velocity: of the trunk when settled, m/s;
  reference_velocity: that of the reference; height: mean of the trunk over its
  support, m; apex: highest in a cycle, mean over the cycles, m; turn_rate,
  rise, flight, drift, alternation, agreement: see the functions of these names;
  single_support: share of the time with just one foot on the ground;
  position_error: mean distance from the reference, m; final_height: world
  height at the end, m.
  """
  velocity = trace.velocity(trace.position)
  distances = np.linalg.norm(trace.position - trace.reference, axis=-1)
  return {
    'velocity': float(velocity[0]),
    'lateral_velocity': float(velocity[1]),
    'reference_velocity': float(trace.velocity(trace.reference)[0]),
    'turn_rate': turn_rate(trace),
    'height': float(trace.height.mean()),
    'apex': float(np.mean([h.max() for h in trace.cycles(trace.height)])),
    'rise': rise(trace),
    'flight': flight(trace),
    'single_support': float((trace.contact.sum(axis=-1) == 1).mean()),
    'alternation': alternation(trace),
    'agreement': agreement(trace),
    'drift': drift(trace),
    'position_error': float(distances.mean()),
    'final_height': float(trace.position[-1, 2]),
  }


def drift(trace: Trace) -> float:
  """Returns the largest horizontal distance from the start, metres."""
  moved = trace.position[:, :2] - trace.position[0, :2]
  return float(np.linalg.norm(moved, axis=1).max())


def turn_rate(trace: Trace) -> float:
  """Returns the mean yaw rate when settled, to the left, rad/s."""
  return float(trace.velocity(np.unwrap(trace.yaw)))


def lean(trace: Trace, axis: int, sign: int, every_cycle: bool = True) -> float:
  """Returns how far the trunk leans to one side in a cycle, radians.

  The greatest angle of a cycle, mean of cycles; negative where the trunk leans
  to the other side throughout.

  Args:
    trace: an episode.
    axis: 0 for the roll, 1 for the pitch.
    sign: 1 for right or ahead, -1 for left or back.
    every_cycle: or else the greatest of the episode, for a mode that runs once.
  """
  angle = sign * trace.tilt[:, axis]
  parts = trace.cycles(angle) if every_cycle else [angle]
  return float(np.mean([part.max() for part in parts]))


def bob(trace: Trace) -> float:
  """Returns the largest deviation of the height from its mean, metres."""
  height = trace.settled(trace.height)
  return float(np.abs(height - height.mean()).max())


def alternation(trace: Trace) -> float:
  """Returns the share of single touch-downs that follow the other foot's.

  The other foot is that on the other side; of four feet it is the mean of both
  pairs. Contacts are the majority of three steps: a bounce or tap of one step
  is neither a take-off nor a touch-down.
  """
  contact = _majority(trace.settled(trace.contact).astype(bool))
  down = contact[1:] & ~contact[:-1]
  pairs = np.split(down, down.shape[1] // 2, axis=1)
  return float(np.mean([_alternation(pair) for pair in pairs]))


def _alternation(down: np.ndarray) -> float:
  """Returns the `alternation` of the touch-downs of two feet, [T, 2]."""
  feet = down[down.any(axis=1)]
  if len(feet) < 2:
    return 0.0
  alone = feet.sum(axis=1) == 1
  other = (feet[1:] != feet[:-1]).all(axis=1)
  return float((alone[1:] & alone[:-1] & other).mean())


def agreement(trace: Trace) -> float:
  """Returns the share of settled steps with the reference's contacts.

  It has no meaning for modes whose references leave contacts free.
  """
  same = trace.contact == trace.reference_contact
  return float(trace.settled(same).mean())


def _majority(flags: np.ndarray) -> np.ndarray:
  """Returns the majority of every three rows, [T, F] -> [T - 2, F]."""
  if len(flags) < 3:
    return flags
  return flags[:-2].astype(int) + flags[1:-1] + flags[2:] >= 2


def rise(trace: Trace) -> float:
  """Returns the range of the height in a cycle, mean of cycles, metres."""
  return float(np.mean([np.ptp(part) for part in trace.cycles(trace.height)]))


def flight(trace: Trace) -> float:
  """Returns the longest flight in a cycle, mean of cycles, seconds."""
  airborne = [part.sum(axis=1) == 0 for part in trace.cycles(trace.contact)]
  return (
    float(np.mean([longest_run(part) for part in airborne])) * trace.timestep
  )


def stance(
  trace: Trace, step: float, height: float, size: float = 1.0
) -> float:
  """Returns the longest time on all feet at a given height, seconds.

  Args:
    trace: an episode.
    step: height of the ground over that at the start, metres.
    height: desired height of the trunk over that ground, to 8 cm, metres.
    size: of the robot, in those of the mini biped: a factor of these 8 cm.
  """
  climbed = trace.support - trace.support[0]
  stands = (
    trace.contact.all(axis=1)
    & (np.abs(climbed - step) < _SAME_PLANE)
    & (np.abs(trace.height - height) < _STANCE_HEIGHT * size)
  )
  return longest_run(stands) * trace.timestep


def longest_run(flags: np.ndarray) -> int:
  """Returns the length of the longest run of True in flags [T]."""
  edges = np.flatnonzero(np.diff(flags.astype(int), prepend=0, append=0))
  return int(np.max(edges[1::2] - edges[::2], initial=0))
