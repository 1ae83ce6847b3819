"""The mini biped as a dm_control locomotion walker."""

from typing import Any, Sequence

import mujoco
import numpy as np

from dmc_multimode.walkers import derivation
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

SIDES = ('left', 'right')
# Of both legs, from the trunk down; the left leg's come first everywhere.
JOINTS = robot_lib.mini_biped().joints


class MiniBiped(robot_walker.RobotWalker):
  """A 14 kg biped with five torque-limited servos a leg.

  Actions are joint targets in radians, relative to a crouch; the servos apply
  clip(30 (a - q) - 0.5 qdot, +-30) Nm at every physics step (Eq. 2). The gains
  are those of the actuators in `xml/mini_biped.xml`, which
  `xml/mini_biped.yaml` declares.
  """

  def _build(  # type: ignore[override]
    self,
    name: str | None = 'walker',
    initializer: Any = None,
    marker_rgba: Sequence[float] | None = None,
  ) -> None:
    """Builds the robot.

    Args:
      name: of the walker; that of the file if None.
      initializer: a `WalkerInitializer`, or several; upright by default.
      marker_rgba: colour of the trunk, to tell robots and teams apart.
    """
    super()._build(robot_lib.mini_biped(), name, initializer)
    if marker_rgba is not None:
      for geom in self.marker_geoms:
        geom.rgba = marker_rgba

  @property
  def marker_geoms(self) -> tuple[Any, ...]:
    """The visible geoms that are coloured by `marker_rgba`."""
    return tuple(
      geom
      for geom in self.root_body.geom
      if geom.material is not None and geom.material.name == 'shell'
    )


def standing_action(
  model: mujoco.MjModel, prefix: str = 'walker/'
) -> np.ndarray:
  """Returns the joint targets that hold the crouch against gravity.

  Args:
    model: a compiled model with one mini biped on a free joint.
    prefix: of the robot's names in it.

  Returns:
    Radians, [10]; see `derivation.standing_action`.
  """
  return derivation.standing_action(model, robot_lib.mini_biped(), prefix)
