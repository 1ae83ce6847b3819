"""Motion metrics: servos, feet and energy in an episode, by physics steps.

Gait metrics say whether a mode does what its reference asks of it, motion
metrics how it moves: as quietly, softly and cheaply as a robot would have to.
`METRICS` is the table of them; a further one is a function and its row.
"""

from typing import Callable, NamedTuple

import numpy as np

_FAST = 5.0  # Hz: no gait has its second harmonic there.
_LEAST_LOAD = 1.0  # Newtons on a foot that touches the ground.
_STANCE_LOAD = 0.1  # Body weights on a foot that stands.
_LEAST_SWING = 0.03  # Seconds off the ground before a touch-down: no chatter.
_NEAR_LIMIT = np.deg2rad(0.5)
HIP_YAWS = (0, 5)  # Of the joints.


class MotionTrace(NamedTuple):
  """One episode: T control steps, N physics steps.

  Positions of the robot are those at the end of a physics step; forces and
  feet are those at its beginning.

  Attributes:
    actions: joint targets in force, radians, [T, J].
    joints: joint positions, radians, [N, J].
    joint_speeds: rad/s, [N, J].
    torques: of the servos, Nm, [N, J].
    loads: forces on the soles, newtons, [N, F].
    corners: of the soles, world metres, [N, F, C, 3]; one of a foot that is a
      point.
    depths: of these corners under the ground, negative over it, metres,
      [N, F, C].
    trunk: position of the trunk, world metres, [N, 3].
    limits: lower and upper bounds of the joints, radians, [2, J].
    weight: of the robot, newtons.
    travels: whether the mode goes somewhere.
    control_timestep: seconds.
    physics_timestep: seconds.
    pairs: indices of the feet (left, right).
    hip_yaws: indices of these joints of the mini biped; none of others.
  """

  actions: np.ndarray
  joints: np.ndarray
  joint_speeds: np.ndarray
  torques: np.ndarray
  loads: np.ndarray
  corners: np.ndarray
  depths: np.ndarray
  trunk: np.ndarray
  limits: np.ndarray
  weight: float
  travels: bool
  control_timestep: float
  physics_timestep: float
  pairs: tuple[tuple[int, int], ...] = ((0, 1),)
  hip_yaws: tuple[int, ...] = HIP_YAWS

  @property
  def velocities(self) -> np.ndarray:
    """Velocities of the corners over each physics step, m/s, [N - 1, F, C, 3].

    Of the steps that end where `loads[1:]` begin.
    """
    return np.diff(self.corners, axis=0) / self.physics_timestep


class Metric(NamedTuple):
  """A motion metric.

  Attributes:
    name: in reports.
    unit: '' for none.
    description: for the reader of a report.
    samples: returns what is measured in an episode, [K]; K may be 0.
    summary: reduces the samples of all episodes to the value.
  """

  name: str
  unit: str
  description: str
  samples: Callable[[MotionTrace], np.ndarray]
  summary: Callable[[np.ndarray], np.floating]


def value(metric: Metric, traces: list[MotionTrace]) -> float | None:
  """Returns a metric of several episodes; None without samples."""
  samples = np.concatenate([metric.samples(trace).ravel() for trace in traces])
  # JSON has no number for what a diverged world leaves.
  if not len(samples) or not np.isfinite(samples).all():
    return None
  return float(metric.summary(samples))


def action_change(trace: MotionTrace) -> np.ndarray:
  """Returns the changes of joint targets between control steps, radians."""
  return np.abs(np.diff(trace.actions, axis=0))


def fast_action_power(trace: MotionTrace) -> np.ndarray:
  """Returns the share of the actions' power, without mean, above 5 Hz, [1]."""
  actions = trace.actions - trace.actions.mean(axis=0)
  # Without a window, the ends of an episode would leak into all frequencies.
  window = np.hanning(len(actions) + 2)[1:-1, None]
  power = (np.abs(np.fft.rfft(window * actions, axis=0)) ** 2).sum(axis=1)
  is_fast = np.fft.rfftfreq(len(actions), trace.control_timestep) > _FAST
  return power[is_fast].sum(keepdims=True) / max(power.sum(), 1e-12)


def positive_power(trace: MotionTrace) -> np.ndarray:
  """Returns the positive mechanical power of all servos, watts, [N]."""
  # Positions change by the speed at the end of a step, so that this times the
  # step is the work.
  return np.maximum(trace.torques * trace.joint_speeds, 0.0).sum(axis=1)


def cost_of_transport(trace: MotionTrace) -> np.ndarray:
  """Returns positive work over weight and distance, [1]; none at rest, [0]."""
  way = np.linalg.norm(trace.trunk[-1, :2] - trace.trunk[0, :2])
  if not (trace.travels and way > 0):
    return np.zeros(0)
  work = positive_power(trace).sum(keepdims=True) * trace.physics_timestep
  return work / (trace.weight * way)


def touch_down_speeds(trace: MotionTrace) -> np.ndarray:
  """Returns the speeds of soles that land, m/s.

  Of every corner, over the physics step in which it comes into the ground,
  after 0.03 s outside.
  """
  inside = trace.depths > 0
  outside = round(_LEAST_SWING / trace.physics_timestep)
  steps = np.arange(len(inside))[:, None, None]
  last = np.maximum.accumulate(np.where(inside, steps, 0), axis=0)
  lands = inside[1:] & (steps[1:] - last[:-1] > outside)
  return np.linalg.norm(trace.velocities, axis=3)[lands]


def slips(trace: MotionTrace) -> np.ndarray:
  """Returns the horizontal speeds of soles that stand, m/s.

  Of the deepest corner, in steps with a tenth of the weight on the foot before
  and after.
  """
  stands = trace.loads > _STANCE_LOAD * trace.weight
  deepest = trace.depths[1:].argmax(axis=2)[..., None]
  speeds = np.linalg.norm(trace.velocities[..., :2], axis=3)
  speeds = np.take_along_axis(speeds, deepest, axis=2)[..., 0]
  return speeds[stands[1:] & stands[:-1]]


def penetrations(trace: MotionTrace) -> np.ndarray:
  """Returns the depths of feet on the ground, at their deepest corner, mm."""
  return 1e3 * trace.depths.max(axis=2)[trace.loads > _LEAST_LOAD]


def limit_excess(trace: MotionTrace) -> np.ndarray:
  """Returns how far joints are beyond their limits, degrees, [N]."""
  low, high = trace.limits
  beyond = np.maximum(low - trace.joints, trace.joints - high)
  return np.rad2deg(np.maximum(beyond, 0.0)).max(axis=1)


def hip_yaw_at_limit(trace: MotionTrace) -> np.ndarray:
  """Returns whether each hip yaw is at a limit or beyond, [N, Y]."""
  low, high = trace.limits + np.array([[_NEAR_LIMIT], [-_NEAR_LIMIT]])
  return ((trace.joints < low) | (trace.joints > high))[:, list(trace.hip_yaws)]


def peak_force(trace: MotionTrace) -> np.ndarray:
  """Returns the largest force on all soles together, body weights, [1]."""
  return trace.loads.sum(axis=1).max(keepdims=True) / trace.weight


def stance_asymmetry(trace: MotionTrace) -> np.ndarray:
  """Returns |left - right| / (left + right) of the stance times, [1]."""
  times = (trace.loads > _LEAST_LOAD).sum(axis=0)
  left, right = times[np.array(trace.pairs)].sum(axis=0)
  return np.array([abs(left - right) / max(left + right, 1)])


def drift(trace: MotionTrace) -> np.ndarray:
  """Returns the largest horizontal distance from the start, metres, [1]."""
  moved = trace.trunk[:, :2] - trace.trunk[0, :2]
  return np.linalg.norm(moved, axis=1).max(keepdims=True)


def _p99(samples: np.ndarray) -> np.floating:
  return np.percentile(samples, 99)


def _rms(samples: np.ndarray) -> np.floating:
  return np.sqrt(np.mean(samples**2))


METRICS = (
  Metric(
    'action_change',
    'rad',
    'change of a joint target from one control step to the next, mean',
    action_change,
    np.mean,
  ),
  Metric(
    'action_change_p99',
    'rad',
    'the same, 99th percentile',
    action_change,
    _p99,
  ),
  Metric(
    'fast_action_power',
    '',
    "share of the actions' power above 5 Hz",
    fast_action_power,
    np.mean,
  ),
  Metric(
    'torque_rms',
    'Nm',
    'root mean square of the torques',
    lambda trace: trace.torques,
    _rms,
  ),
  Metric(
    'torque_peak',
    'Nm',
    'largest torque',
    lambda trace: np.abs(trace.torques),
    np.max,
  ),
  Metric(
    'power',
    'W',
    'positive mechanical power of all servos, mean',
    positive_power,
    np.mean,
  ),
  Metric(
    'cost_of_transport',
    '',
    'positive work over weight and distance; none where a mode goes nowhere',
    cost_of_transport,
    np.mean,
  ),
  Metric(
    'touch_down_speed',
    'm/s',
    'speed of the corners of soles as they come into the ground, mean',
    touch_down_speeds,
    np.mean,
  ),
  Metric(
    'touch_down_speed_p99',
    'm/s',
    'the same, 99th percentile',
    touch_down_speeds,
    _p99,
  ),
  Metric(
    'slip',
    'm/s',
    'horizontal speed of a sole that bears a tenth of the weight, mean',
    slips,
    np.mean,
  ),
  Metric(
    'penetration_p99',
    'mm',
    'depth under the ground of the deepest corner of a loaded foot, 99th '
    'percentile',
    penetrations,
    _p99,
  ),
  Metric(
    'limit_excess',
    'degrees',
    'farthest that a joint is beyond its limit',
    limit_excess,
    np.max,
  ),
  Metric(
    'hip_yaw_at_limit',
    '',
    'share of the time that a hip yaw is within half a degree of a limit, or '
    'beyond',
    hip_yaw_at_limit,
    np.mean,
  ),
  Metric(
    'peak_force',
    'body weights',
    'largest force of the ground in an episode, mean',
    peak_force,
    np.mean,
  ),
  Metric(
    'stance_asymmetry',
    '',
    '|left - right| / (left + right) of the times on each foot, mean',
    stance_asymmetry,
    np.mean,
  ),
)
# Of episodes of a minute.
DRIFT = Metric(
  'drift_60s',
  'm',
  'largest horizontal distance from the start in 60 s, mean; of standing modes '
  'alone, none if the robot falls',
  drift,
  np.mean,
)
TABLE = (*METRICS, DRIFT)
