"""Trials of a declared robot on level ground, with its standing action."""

import math
from typing import NamedTuple

from dm_control import composer
import mujoco
import numpy as np

from dmc_multimode.utils import constants
from dmc_multimode.walkers import derivation
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

DROP = 0.1  # Share of the standing height from which a robot is dropped.
SECONDS = 5.0  # Of a trial: tall robots take a second or two to topple.
_SUNK, _TILTED = 0.1, 0.3  # Shares of the height, and radians: it has fallen.
_SETTLING = 0.2  # Seconds in which every foot has to feel the ground.
_DIVERGED = (
  mujoco.mjtWarning.mjWARN_BADQPOS,
  mujoco.mjtWarning.mjWARN_BADQVEL,
  mujoco.mjtWarning.mjWARN_BADQACC,
)


class Trial(NamedTuple):
  """Outcome of a robot that held its standing action, to the end or its fall.

  Attributes:
    seconds: until it fell, or of the whole trial.
    sunk: loss of height of the trunk by then, metres.
    tilt: of the trunk, radians.
    drift: of the trunk over the ground, metres.
    load: greatest sum of the forces on the feet, in the robot's weight.
    feet: on the ground by then, F flags.
    stands: whether it neither sank nor tilted much.
    fault: what is broken and not just out of balance, with what to do about
      it; empty if nothing is.
  """

  seconds: float
  sunk: float
  tilt: float
  drift: float
  load: float
  feet: tuple[bool, ...]
  stands: bool
  fault: str


def drop(
  robot: robot_lib.Robot,
  height: float = 0.0,
  seconds: float = SECONDS,
  model: mujoco.MjModel | None = None,
) -> Trial:
  """Drops a robot in its standing pose, and lets it stand until it falls.

  The physics are those of the tasks: no noise, no policy. Nothing balances the
  robot, so that many on two feet fall which learn to stand.

  Args:
    robot: to try.
    height: of the feet over the ground, metres.
    seconds: longest duration.
    model: of `on_ground`; compiled if None.

  Raises:
    ValueError: the model is none of a robot.
  """
  model = model or on_ground(robot)
  data, derived = mujoco.MjData(model), robot.derived
  data.qpos[2], data.qpos[7:] = height + derived.stand_height, derived.pose
  data.ctrl[:] = derived.standing_action
  touches = _touches(model, robot)
  fastest = math.sqrt(2 * constants.GRAVITY * data.qpos[2])  # Of a fall.
  greatest, sunk, tilt, step = 0.0, 0.0, 0.0, 0
  felt = np.zeros(len(touches), dtype=bool)
  stands, bursts = True, False
  while stands and step < round(seconds / model.opt.timestep):
    mujoco.mj_step(model, data)
    step += 1
    forces = data.sensordata[touches]
    greatest = max(greatest, float(forces.sum()))
    felt |= (forces > 0) & (step * model.opt.timestep <= _SETTLING)
    sunk = derived.stand_height - float(data.qpos[2])
    tilt = _tilt(data.qpos[3:7])
    # MuJoCo begins anew where the state is not finite, and counts it.
    bursts = bool(
      np.linalg.norm(data.qvel[:3]) > fastest
      or any(data.warning[warning].number for warning in _DIVERGED)
    )
    fallen = sunk > _SUNK * derived.stand_height or tilt > _TILTED
    stands = not (fallen or bursts)
  unfelt = [robot.declaration.feet[foot] for foot in np.flatnonzero(~felt)]
  fault = ''
  if bursts:
    fault = (
      'it bursts: exclude contacts of parts that overlap, soften its servos, '
      'or add armature'
    )
  elif unfelt and not height:
    fault = (
      f'the foot {unfelt[0]!r} feels no ground: its site must contain the '
      'contacts, or correct the pose'
    )
  elif not stands and tilt < _TILTED:
    fault = (
      f'it sinks by {1000 * sunk:.0f} mm upright: stiffen its servos, or '
      'correct its pose'
    )
  return Trial(
    step * model.opt.timestep,
    sunk,
    tilt,
    float(np.linalg.norm(data.qpos[:2])),
    greatest / (derived.mass * constants.GRAVITY),
    tuple(bool(force > 0) for force in data.sensordata[touches]),
    stands,
    fault,
  )


def _touches(model: mujoco.MjModel, robot: robot_lib.Robot) -> list[int]:
  """Returns the places of the feet's touch sensors in `sensordata`, [F]."""
  sites = [
    model.site(derivation.PREFIX + foot).id for foot in robot.declaration.feet
  ]
  touching = model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH
  return [
    int(model.sensor_adr[touching & (model.sensor_objid == site)][0])
    for site in sites
  ]


def _tilt(quaternion: np.ndarray) -> float:
  """Returns the angle of the z axis of a rotation [4] from upright, radians."""
  upright = 1 - 2 * float(quaternion[1] ** 2 + quaternion[2] ** 2)
  return float(np.arccos(np.clip(upright, -1.0, 1.0)))


def on_ground(robot: robot_lib.Robot) -> mujoco.MjModel:
  """Compiles a robot on a plane at a height of 0.

  Raises:
    ValueError: the model is none of a robot.
  """
  arena, walker = composer.Arena(), robot_walker.RobotWalker(robot)
  walker.create_root_joints(arena.attach(walker))
  root = arena.mjcf_model
  root.worldbody.add('geom', type='plane', size=[5, 5, 1])
  # For pictures: robots may be black, and so is a world without a sky.
  root.asset.add(
    'texture',
    name='sky',
    type='skybox',
    builtin='flat',
    rgb1=[0.85, 0.9, 0.95],
    width=8,
    height=48,
  )
  root.visual.headlight.ambient = [0.4] * 3
  root.option.timestep = constants.PHYSICS_TIMESTEP
  root.option.integrator = 'implicitfast'
  root.option.cone, root.option.noslip_iterations = 'pyramidal', 0
  return robot_walker.compile_model(root)
