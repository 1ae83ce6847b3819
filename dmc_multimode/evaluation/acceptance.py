"""Acceptance criteria of the modes: gait metrics with bounds.

The reward measures the trunk alone, so that a shuffle on both feet may earn as
much as a walk. A mode's criteria follow from its reference. A standing mode
stays in place; a gait keeps its speed and height, or rises in every cycle if
the reference does, and alternates its feet if the reference does; a bounding
mode rises and flies in every cycle; a jump onto a block ends on it. Any mode
whose reference leans the trunk has to lean it, too.
"""

import functools
from typing import Callable, Iterator, NamedTuple, Sequence

import numpy as np

from dmc_multimode.evaluation import gait_metrics
from dmc_multimode.modes import motion as motion_lib

DURATION = 5.1  # Seconds: length of the episodes.

# Lengths are those of the mini biped.
_DRIFT = 0.05  # Metres in `DURATION`.
_SPEED = 1 / 6  # Tolerance of speed and turn rate, relative to the reference.
_BOB = 0.05  # Metres: largest deviation of a gait's height from its mean.
_ALTERNATION = 0.8  # Share of touch-downs.
_RISE = 0.6  # Of the reference's rise.
_FLIGHT = 0.45  # Of the reference's time in the air.
_STANCE = 1.0  # Seconds on all feet after a jump.
_LEAN = 0.5  # Of the reference's angle.
_UPRIGHT = np.deg2rad(8.0)  # The trunk's own sway: less is no lean.
_LEANS = (  # Name, axis of `Trace.tilt`, sign.
  ('lean_right', 0, 1),
  ('lean_left', 0, -1),
  ('lean_ahead', 1, 1),
  ('lean_back', 1, -1),
)


class Criterion(NamedTuple):
  """A metric of a mode with bounds of its mean.

  Attributes:
    metric: name of the metric.
    least, most: bounds; infinite for none.
    measure: computes the metric of an episode.
  """

  metric: str
  least: float
  most: float
  measure: Callable[[gait_metrics.Trace], float]


class Finding(NamedTuple):
  """Result of a criterion.

  Attributes:
    metric: name of the metric.
    value: mean over the episodes.
    worst: value of the episode farthest out of bounds.
    least, most: bounds.
    passed: whether the mean is within them.
  """

  metric: str
  value: float
  worst: float
  least: float
  most: float
  passed: bool


def criteria(
  motion: motion_lib.ReferenceMotion, size: float = 1.0
) -> tuple[Criterion, ...]:
  """Returns the criteria of a mode, by the nature of its reference.

  Args:
    motion: the reference.
    size: of the robot, in those of the mini biped: a factor of lengths.
  """
  return (*_of_kind(motion, size), *_of_leans(motion))


def _of_kind(
  motion: motion_lib.ReferenceMotion, size: float
) -> tuple[Criterion, ...]:
  """Returns the criteria of what the trunk's place and the feet do."""
  if motion.kind == motion_lib.STEADY:
    return (Criterion('drift', -np.inf, _DRIFT * size, gait_metrics.drift),)
  if motion.kind == motion_lib.TRANSIENT:
    return _of_jumps(motion, size)
  airborne = _time_in_the_air(motion)
  return _of_bounds(motion, airborne) if airborne else _of_gaits(motion, size)


def _of_leans(motion: motion_lib.ReferenceMotion) -> Iterator[Criterion]:
  """Yields a criterion for each side to which the reference leans."""
  tilt = motion_lib.tilt(motion.orientations)
  for name, axis, sign in _LEANS:
    angle = float((sign * tilt[:, axis]).max())
    if angle > _UPRIGHT:
      every = motion.kind != motion_lib.TRANSIENT
      measure = functools.partial(
        gait_metrics.lean, axis=axis, sign=sign, every_cycle=every
      )
      yield Criterion(name, _LEAN * angle, np.inf, measure)


def check(
  motion: motion_lib.ReferenceMotion,
  traces: Sequence[gait_metrics.Trace],
  size: float = 1.0,
) -> tuple[Finding, ...]:
  """Returns the findings of a mode's criteria for episodes at clock rate 1.

  Args:
    motion: of the mode.
    traces: of the episodes.
    size: of the robot, see `criteria`.
  """
  findings = []
  for metric, least, most, measure in criteria(motion, size):
    values = np.array([measure(trace) for trace in traces])
    worst = values[np.argmax(np.maximum(least - values, values - most))]
    mean = float(values.mean())
    passed = least <= mean <= most
    findings.append(Finding(metric, mean, float(worst), least, most, passed))
  return tuple(findings)


def _of_jumps(
  motion: motion_lib.ReferenceMotion, size: float
) -> tuple[Criterion, ...]:
  """Returns the criteria of a transient mode that moves: a jump."""
  if motion.ledge is None:
    return ()
  step = motion.ledge.height
  height = float(motion.positions[-1, 2]) - step
  stance = lambda trace: gait_metrics.stance(trace, step, height, size)
  return (Criterion('stance', _STANCE, np.inf, stance),)


def _of_gaits(
  motion: motion_lib.ReferenceMotion, size: float
) -> tuple[Criterion, ...]:
  """Returns the criteria of a periodic mode without flight: a gait."""
  result = []
  moved = motion.positions[-1] - motion.positions[0]
  yaw = motion_lib.yaw(motion.orientations)
  speed = float(np.linalg.norm(moved[:2])) / motion.duration
  if speed and not np.ptp(yaw):
    heading = moved[:2] / np.linalg.norm(moved[:2])
    along = lambda trace: float(trace.velocity(trace.position)[:2] @ heading)
    slack = _SPEED * speed
    result.append(Criterion('speed', speed - slack, speed + slack, along))
  rate = float(yaw[-1] - yaw[0]) / motion.duration
  if rate:
    slack = _SPEED * abs(rate)
    result.append(
      Criterion('turn_rate', rate - slack, rate + slack, gait_metrics.turn_rate)
    )
  rise = float(np.ptp(motion.positions[:, 2]))
  if rise:
    result.append(Criterion('rise', _RISE * rise, np.inf, gait_metrics.rise))
  else:
    result.append(Criterion('bob', -np.inf, _BOB * size, gait_metrics.bob))
  if motion.contacts is not None and _steps(motion.contacts):
    result.append(
      Criterion('alternation', _ALTERNATION, np.inf, gait_metrics.alternation)
    )
  return tuple(result)


def _steps(contacts: np.ndarray) -> bool:
  """Returns whether the feet of each pair, [K, F], step in turns."""
  left, right = contacts[:, ::2], contacts[:, 1::2]
  return bool(((left > right).any(axis=0) & (right > left).any(axis=0)).all())


def _of_bounds(
  motion: motion_lib.ReferenceMotion, airborne: float
) -> tuple[Criterion, ...]:
  """Returns the criteria of a gait that flies `airborne` seconds a cycle."""
  flight = Criterion('flight', _FLIGHT * airborne, np.inf, gait_metrics.flight)
  rise = float(np.ptp(motion.positions[:, 2]))
  if not rise:
    return (flight,)
  return (Criterion('rise', _RISE * rise, np.inf, gait_metrics.rise), flight)


def _time_in_the_air(motion: motion_lib.ReferenceMotion) -> float:
  """Returns the seconds of a cycle in which no foot touches the ground."""
  if motion.contacts is None:
    return 0.0
  airborne = ~motion.contacts[:-1].any(axis=1)
  return float(motion.duration * np.diff(motion.phases)[airborne].sum())
