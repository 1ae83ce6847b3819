"""The initial state of a robot: on its reference, with noise. No engine."""

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.suite.imitation import commands
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import observations
from dmc_multimode.utils import constants
from dmc_multimode.walkers import kinematics

_SLOWEST_START = 0.5  # Share of the reference's velocity.
_FOOT_REACH = 0.12  # Metres ahead of and behind the trunk where feet may be.


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
    Initial qpos [N, 17] and qvel [N, 16].
  """
  count, joints = len(ids), observations.NUM_JOINTS
  position, orientation, velocity = tracker.start_pose(ids)
  position[:, 2] += lift_of_ground(tracker, terrain, position[:, 0], ids)
  # Some robots start slower than the reference: they practise flights that fall
  # short, which follow an imperfect take-off.
  pace = random_state.uniform(_SLOWEST_START, 1.0, size=count)
  velocity *= (pace * on_reference)[:, None]
  clear = terrain_lib.clearance_height(terrain, position[:, 0], _FOOT_REACH)
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
  velocity[:, 1] += pace * kinematics.sway(swinging, time, length)
  tilt = config.tilt_noise * random_state.standard_normal((count, 2))
  angles += config.joint_noise * random_state.standard_normal((count, joints))
  qpos = np.concatenate([position, _tilted(orientation, tilt), angles], axis=1)
  qvel = config.velocity_noise * random_state.standard_normal(
    (count, 6 + joints)
  )
  qvel[:, :3] += velocity
  qvel[:, 6:] += rates
  return qpos, qvel


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
