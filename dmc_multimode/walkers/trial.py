"""Trials of a declared robot on level ground, with its standing action."""

from typing import NamedTuple

from dm_control import composer
import mujoco
import numpy as np

from dmc_multimode.utils import constants
from dmc_multimode.walkers import derivation
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

DROP = 0.1  # Share of the standing height from which a robot is dropped.
# Seconds of the trials, of robots with two feet and with four.
STANDING = {2: 0.5, 4: 2.0}
FALLING = 1.0
_SUNK, _TILTED = 0.1, 0.3  # Shares of the height, and radians: it has fallen.


class Trial(NamedTuple):
  """Outcome of a robot that held its standing action.

  Attributes:
    sunk: loss of height of the trunk, metres.
    tilt: of the trunk, radians.
    drift: of the trunk over the ground, metres.
    load: greatest sum of the forces on the feet, in the robot's weight.
    feet: on the ground at the end, F flags.
    stands: whether it neither sank nor tilted much, and all feet are down.
  """

  sunk: float
  tilt: float
  drift: float
  load: float
  feet: tuple[bool, ...]
  stands: bool


def drop(
  robot: robot_lib.Robot, height: float = 0.0, seconds: float | None = None
) -> Trial:
  """Drops a robot in its standing pose, and lets it stand.

  The physics are those of the tasks: no noise, no policy. Two feet stand so for
  a moment, and fall when they are dropped.

  Args:
    robot: to try.
    height: of the feet over the ground, metres.
    seconds: duration; that of `STANDING` by default.

  Raises:
    ValueError: the model is none of a robot.
  """
  model = on_ground(robot)
  seconds = seconds or STANDING[robot.num_feet]
  data, derived = mujoco.MjData(model), robot.derived
  start = height + derived.stand_height
  data.qpos[2], data.qpos[7:] = start, derived.pose
  data.ctrl[:] = derived.standing_action
  feet = [model.sensor_adr[model.sensor(name).id] for name in _sensors(robot)]
  greatest = 0.0
  for _ in range(round(seconds / model.opt.timestep)):
    mujoco.mj_step(model, data)
    greatest = max(greatest, float(data.sensordata[feet].sum()))
  sunk = derived.stand_height - float(data.qpos[2])
  upright = 1 - 2 * float(data.qpos[4] ** 2 + data.qpos[5] ** 2)
  tilt = float(np.arccos(np.clip(upright, -1.0, 1.0)))
  down = tuple(bool(force > 0) for force in data.sensordata[feet])
  finite = bool(np.isfinite(data.qpos).all())
  return Trial(
    sunk,
    tilt,
    float(np.linalg.norm(data.qpos[:2])),
    greatest / (derived.mass * constants.GRAVITY),
    down,
    finite
    and abs(sunk) < _SUNK * derived.stand_height
    and tilt < _TILTED
    and all(down),
  )


def _sensors(robot: robot_lib.Robot) -> list[str]:
  """Returns the names of the touch sensors of the feet."""
  walker = robot_walker.RobotWalker(robot)
  return [derivation.PREFIX + sensor.name for sensor in walker.foot_sensors]


def on_ground(robot: robot_lib.Robot) -> mujoco.MjModel:
  """Compiles a robot on a plane at a height of 0.

  Raises:
    ValueError: the model is none of a robot.
  """
  arena, walker = composer.Arena(), robot_walker.RobotWalker(robot)
  walker.create_root_joints(arena.attach(walker))
  root = arena.mjcf_model
  root.worldbody.add('geom', type='plane', size=[5, 5, 1])
  root.option.timestep = constants.PHYSICS_TIMESTEP
  root.option.integrator = 'implicitfast'
  root.option.cone, root.option.noslip_iterations = 'pyramidal', 0
  return robot_walker.compile_model(root)
