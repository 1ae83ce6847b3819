"""The left-right mirror image of observations, actions and commands.

Joints and actions are exchanged as the robot says (`walkers.mirroring`): of the
mini biped without a change of sign, for the axes of its right leg are those of
the left one mirrored. A mode whose reference looks the same half a cycle later
is mirrored half a cycle out of phase, so that its feet alternate.
"""

from typing import Iterable, NamedTuple

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.suite.imitation import observations
from dmc_multimode.walkers import robot as robot_lib


class MirrorImage(NamedTuple):
  """Mirror image x'[i] = signs[i] * x[order[i]].

  Attributes:
    observation_order, observation_signs: of flat observations, [D].
    action_order, action_signs: of actions, [A].
    mirrored_modes: index of every mode's mirror image, [M].
    clock_signs: -1 for the modes that are mirrored half a cycle later, [M].
    commands: start indices of latents in the observation; a latent is mirrored
      to that of the mirrored mode.
  """

  observation_order: np.ndarray
  observation_signs: np.ndarray
  action_order: np.ndarray
  action_signs: np.ndarray
  mirrored_modes: np.ndarray
  clock_signs: np.ndarray
  commands: tuple[int, ...] = (2,)


def mirror_image(
  mode_set: mode_set_lib.ModeSet,
  with_privileged: bool = False,
  extra: Iterable[str] = (),
  robot: robot_lib.Robot | None = None,
) -> MirrorImage:
  """Returns the mirror image for a mode set.

  Args:
    mode_set: the modes.
    with_privileged: whether observations end with the privileged parts.
    extra: names of the observations beyond the paper's.
    robot: the mini biped by default.

  Raises:
    ValueError: the set holds a mode but not its mirror image.
  """
  motions, names = mode_set.motions, mode_set.names
  for motion in motions:
    if motion.mirror not in names:
      raise ValueError(
        f'{motion.name} is mirrored by {motion.mirror!r}, which is not in the '
        'mode set: add it or train without symmetry.'
      )
  robot = robot_lib.find(robot)
  body = robot.derived.mirror
  order, signs, commands = observations.mirror(
    mode_set.latent_dim, with_privileged, extra, robot
  )
  return MirrorImage(
    order,
    signs,
    np.array(body.joint_order),
    np.array(body.joint_signs, dtype=np.float32),
    np.array([names.index(motion.mirror) for motion in motions]),
    np.array([-1.0 if m.half_cycle_symmetric else 1.0 for m in motions], 'f4'),
    commands,
  )
