"""Description of a policy, for controllers that know nothing of this package.

It is JSON, and says all that lies between sensors and servos: docs/DEPLOY.md
explains it. Sizes, units, frames, gains and bounds are those that the task and
the compiled model have.
"""

from typing import Any, Iterable, Mapping

import mujoco
import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.suite.imitation import observations
from dmc_multimode.walkers import derivation
from dmc_multimode.walkers import robot as robot_lib

FORMAT = 'dmc_multimode.deployment.1'
# Of the parts of the observation, in symbols of a free joint: position p and
# orientation o of the trunk in the world, joint angles q.
FORMULAS: Mapping[str, str] = {
  'clock': '[sin(2 pi phase), cos(2 pi phase)]',
  'command': 'latent of the running mode',
  'height': 'p_z - support, the height of the ground under the trunk',
  'orientation': 'conj(h) o, with h = (cos(heading/2), 0, 0, sin(heading/2))',
  'joints_pos': 'q',
  'velocity': 'transpose(R(o)) dp/dt',
  'angular_velocity': 'omega, as a gyroscope in the trunk measures it',
  'joints_vel': 'dq/dt',
  'displacement': 'clip(Rz(-heading) (p - reference), -0.5, 0.5), x and y: '
  'odometry since the command, less the way of the reference',
  'clock_rate': 'rate of the clock; 1 is as the modes say',
  'previous_action': 'the action before; at the start q',
  'ground_scan': '0.03 s ago: clip(ground - support, -0.6, 0.6) at -0.18, '
  '-0.09, ... 1.17 m along the heading from the trunk; -0.6 for no ground',
}
_CLOCK: Mapping[str, Any] = {
  'start': 'phase = 0, heading = 0: the first mode',
  'step': 'phase += control_timestep / duration, after each action',
  'end': {  # Where phase >= 1 after a step.
    motion_lib.PERIODIC: 'phase -= 1, heading += turn',
    motion_lib.STEADY: 'phase -= 1',
    motion_lib.TRANSIENT: 'phase = 1',
  },
  'command': 'another mode: heading += yaw of the old one at its phase, phase '
  '= 0; the running mode: nothing',
}
_REFERENCE: Mapping[str, str] = {
  'command': 'another mode: anchor = p; way = last less first keyframe, turned '
  'by the heading; pace = clip(dp/dt . way duration / |way|^2, 0, 1) of a mode '
  'that ramps, else 1; x and y of each',
  'place': 'anchor + Rz(heading) k (pace + (1 - pace) phase / 2), with k the '
  'keyframes at the phase, linear in between',
  'end': 'of a periodic cycle: anchor += way (1 + pace) / 2, pace = 1',
}
_TORQUE = 'clip(stiffness (action - q) - damping dq/dt, -limit, limit)'


def describe(policy: pretrained.Policy) -> dict[str, Any]:
  """Returns the description of a policy, JSON values."""
  config = task_config.evaluated(policy.config)
  robot = config.robot
  model = mujoco_worlds.compile_model(
    multimode_biped.make_task(policy.mode_set, config=config)
  )
  return {
    'format': FORMAT,
    'model': {'input': 'observation', 'output': 'action'},
    'control_timestep': config.control_timestep,
    'physics_timestep': config.physics_timestep,
    'modes': _modes(policy.mode_set, config.feasible_references),
    'clock': dict(_CLOCK),
    'reference': dict(_REFERENCE),
    'observation': parts(
      policy.mode_set.latent_dim, policy.config.extra_observations, robot
    ),
    'frames': dict(observations.FRAMES),
    'quaternion': {'order': 'w, x, y, z', 'sign': 'w >= 0', 'norm': 1.0},
    'joints': list(robot.joints),
    **_robot(model, robot),
    'start': {
      'height': robot.stand_height,
      'joints_pos': robot.derived.pose.tolist(),
    },
    'fallen_below': policy.config.limits.height,
  }


def parts(
  latent_dim: int,
  extra: Iterable[str] = (),
  robot: robot_lib.Robot | None = None,
) -> list[dict[str, Any]]:
  """Returns the parts of the observation in their order.

  Args:
    latent_dim: n_m.
    extra: names of the parts beyond the paper's.
    robot: the mini biped by default.
  """
  found: list[dict[str, Any]] = []
  for term, (name, size) in zip(
    observations.terms(extra=extra),
    observations.layout(latent_dim, extra=extra, robot=robot),
    strict=True,
  ):
    found.append(
      {
        'name': name,
        'size': size,
        'start': sum(part['size'] for part in found),
        'unit': term.unit,
        'frame': term.frame,
        'formula': FORMULAS[name],
      }
    )
  return found


def _modes(
  mode_set: mode_set_lib.ModeSet, feasible_references: bool
) -> list[dict[str, Any]]:
  """Returns the modes as in a mode file, each with what follows from it."""
  ramps = mode_set.bank.level & feasible_references
  return [
    {
      **mode_files.motion_to_dict(motion),
      'latent': latent,
      'turn': turn,  # Radians a cycle.
      'ramps': ramp,  # From the robot's own speed, see `_REFERENCE`.
    }
    for motion, latent, turn, ramp in zip(
      mode_set.motions,
      mode_set.latents.tolist(),
      mode_set.bank.turns.tolist(),
      ramps.tolist(),
      strict=True,
    )
  ]


def _robot(model: mujoco.MjModel, robot: robot_lib.Robot) -> dict[str, Any]:
  """Returns what the action means, and the servos, of a compiled model."""
  servos = list(range(robot.num_joints))
  joints = model.actuator_trnid[servos, 0]
  array = lambda values: np.asarray(values).tolist()
  return {
    'action': {
      'meaning': 'targets of the joints, held for a control step',
      'unit': 'rad',
      'minimum': array(model.actuator_ctrlrange[servos, 0]),
      'maximum': array(model.actuator_ctrlrange[servos, 1]),
      'standing': array(derivation.standing_action(model, robot)),
    },
    'servos': {
      'torque': _TORQUE,
      'period': 'a physics step; on a robot as short as can be',
      'stiffness': array(model.actuator_gainprm[servos, 0]),  # Nm/rad
      'damping': array(-model.actuator_biasprm[servos, 2]),  # Nm s/rad
      'limit': array(model.actuator_forcerange[servos, 1]),  # Nm
      'minimum': array(model.jnt_range[joints, 0]),  # Radians.
      'maximum': array(model.jnt_range[joints, 1]),
    },
  }
