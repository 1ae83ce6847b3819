"""The initial state of a robot: on its reference, with noise. No engine.

The legs of robots that begin on their reference are where the gait has them: by
the mini biped's kinematics, or by the tables of `walkers.legs`. Without these,
which take the extra `robots`, others begin in their standing pose.
"""

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.suite.imitation import commands
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import constants
from dmc_multimode.walkers import kinematics
from dmc_multimode.walkers import legs as legs_lib

_SLOWEST_START = 0.5  # Share of the reference's velocity.
# Metres ahead of and behind the trunk where feet may be, of the mini biped.
_FOOT_REACH = 0.12


def initial_state(
  tracker: commands.ModeTracker,
  terrain: terrain_lib.Terrain,
  config: task_config.ImitationConfig,
  ids: np.ndarray,
  on_reference: np.ndarray,
  random_state: np.random.RandomState,
) -> tuple[np.ndarray, np.ndarray]:
  """Returns initial states on the references of `ids`, with noise.

  Args:
    tracker: of all worlds, which has just been reset.
    terrain: of the worlds `ids`.
    config: of the noise.
    ids: worlds, [N].
    on_reference: whether each robot has the reference's velocity, [N]; the
      others start from rest.
    random_state: source of the noise.

  Returns:
    Initial qpos [N, 7 + J] and qvel [N, 6 + J].
  """
  robot, count = config.robot, len(ids)
  position, orientation, velocity = tracker.start_pose(ids)
  position[:, 2] += lift_of_ground(tracker, terrain, position[:, 0], ids)
  # Some robots start slower than the reference: they practise flights that fall
  # short, which follow an imperfect take-off.
  pace = random_state.uniform(_SLOWEST_START, 1.0, size=count)
  velocity *= (pace * on_reference)[:, None]
  reach = _FOOT_REACH * robot.size
  clear = terrain_lib.clearance_height(terrain, position[:, 0], reach)
  if robot.is_mini_biped:
    angles, rates, sway = _mini_biped_legs(
      tracker, ids, position, velocity, clear, on_reference
    )
    velocity[:, 1] += pace * sway
  else:
    legs = legs_lib.find(robot) if on_reference.any() else None
    angles, rates, sway = _placed_legs(
      legs, tracker, config, ids, position, velocity, clear, on_reference
    )
    velocity[:, 1] += pace * sway
  tilt = config.tilt_noise * random_state.standard_normal((count, 2))
  angles += config.joint_noise * random_state.standard_normal(angles.shape)
  qpos = np.concatenate([position, _tilted(orientation, tilt), angles], axis=1)
  qvel = config.velocity_noise * random_state.standard_normal(
    (count, 6 + robot.num_joints)
  )
  qvel[:, :3] += velocity
  qvel[:, 6:] += rates
  return qpos, qvel


def _mini_biped_legs(
  tracker: commands.ModeTracker,
  ids: np.ndarray,
  position: np.ndarray,
  velocity: np.ndarray,
  clear: np.ndarray,
  on_reference: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Puts the legs of mini bipeds where their modes have them.

  Args:
    tracker: of all worlds, which has just been reset.
    ids: worlds, [N].
    position: of the trunks, world metres, [N, 3]; lifted in place to where the
      legs have room.
    velocity: of the trunks, m/s, [N, 3].
    clear: height of the highest ground under the feet, metres, [N].
    on_reference: whether each robot has the reference's velocity, [N].

  Returns:
    Joint angles, radians, and rates, rad/s, [N, 10] each, and the lateral
    velocity of the trunk, m/s, [N].
  """
  airborne = tracker.airborne(ids)
  # In flight the legs are drawn up; even so they must clear a block below.
  lowest = np.where(airborne, constants.STAND_HEIGHT, kinematics.LOWEST)
  position[:, 2] = np.maximum(position[:, 2], clear + lowest)
  swinging, time, length = tracker.swing_timing(ids)
  swinging &= on_reference[:, None]
  height = np.where(airborne, constants.STAND_HEIGHT, position[:, 2] - clear)
  climb = np.where(airborne, 0.0, velocity[:, 2])
  angles, rates = _leg_joints(
    velocity[:, 0], height, climb, swinging, time, length
  )
  return angles, rates, kinematics.sway(swinging, time, length)


def _placed_legs(
  legs: legs_lib.Legs | None,
  tracker: commands.ModeTracker,
  config: task_config.ImitationConfig,
  ids: np.ndarray,
  position: np.ndarray,
  velocity: np.ndarray,
  clear: np.ndarray,
  on_reference: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Puts the legs of a declared robot where their modes have them.

  Robots that are not on their reference, or whose legs are unknown, get the
  standing pose.

  Args:
    legs: of the robot, if they are known.
    tracker, ids, position, velocity, clear, on_reference: as for
      `_mini_biped_legs`.
    config: of the task.

  Returns:
    As `_mini_biped_legs`, [N, J], [N, J] and [N].
  """
  robot, count = config.robot, len(ids)
  lowest = np.full(count, robot.stand_height)
  placed = on_reference if legs else np.zeros(count, dtype=bool)
  airborne = tracker.airborne(ids) | ~placed
  if legs:
    lowest = np.where(airborne, lowest, legs.heights[0])
  position[:, 2] = np.maximum(position[:, 2], clear + lowest)
  angles = np.tile(robot.derived.pose, (count, 1))
  rates, sway = np.zeros_like(angles), np.zeros(count)
  if not legs:
    return angles, rates, sway
  swinging, time, length = tracker.swing_timing(ids)
  swinging &= placed[:, None]
  forward, lift, forward_rate, lift_rate = kinematics.stepping(
    velocity[:, 0], swinging, time, length, kinematics.LIFT * robot.size
  )
  height = np.where(airborne, robot.stand_height, position[:, 2] - clear)
  climb = np.where(airborne, 0.0, velocity[:, 2])
  found = legs.place(
    forward, height[:, None] - lift, forward_rate, climb[:, None] - lift_rate
  )
  angles[placed], rates[placed] = found[0][placed], found[1][placed]
  if robot.num_feet == 2:
    half = robot.derived.stance_width / 2
    sway = kinematics.sway(swinging, time, length, half, robot.stand_height)
  return angles, rates, sway


def lift_of_ground(
  tracker: commands.ModeTracker,
  terrain: terrain_lib.Terrain,
  x: np.ndarray,
  ids: np.ndarray | slice = slice(None),
) -> np.ndarray:
  """Returns ground height less the height that motions expect, metres, [N].

  A motion is made for level ground, or for the one ledge that it climbs.

  Args:
    tracker: of all worlds.
    terrain: of the worlds `ids`.
    x: world positions, metres, [N].
    ids: worlds, [N]; all by default.
  """
  support = terrain_lib.support_height(terrain, x)
  return support - tracker.expected_support(x, ids)


def _leg_joints(
  speed: np.ndarray,
  height: np.ndarray,
  climb: np.ndarray,
  swinging: np.ndarray,
  time: np.ndarray,
  length: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
  """Returns joint angles and rates in the middle of a stride, [N, 10] each."""
  forward, lift, forward_rate, lift_rate = kinematics.stepping(
    speed, swinging, time, length
  )
  return kinematics.placing(
    forward,
    height[:, None] - lift,
    forward_rate,
    climb[:, None] - lift_rate,
  )


def _tilted(quaternion: np.ndarray, tilt: np.ndarray) -> np.ndarray:
  """Turns orientations [N, 4] by small roll and pitch angles [N, 2]."""
  from scipy.spatial import transform  # Late: scipy imports slowly.

  from_quat = transform.Rotation.from_quat
  noise = transform.Rotation.from_rotvec(
    np.column_stack([tilt, np.zeros(len(tilt))])
  )
  return (from_quat(quaternion, scalar_first=True) * noise).as_quat(
    scalar_first=True
  )
