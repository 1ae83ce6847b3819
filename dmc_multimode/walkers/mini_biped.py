"""The mini biped as a dm_control locomotion walker."""

from typing import Any, Sequence

from dm_control import composer
from dm_control import mjcf
from dm_control.locomotion.walkers import base
from dm_control.locomotion.walkers import legacy_base
import mujoco
import numpy as np

from dmc_multimode.utils import constants
from dmc_multimode.utils import resources

SIDES = ('left', 'right')
# Of one leg, from the trunk down; the left leg's come first everywhere.
LEG_JOINTS = ('hip_yaw', 'hip_roll', 'hip_pitch', 'knee', 'ankle')
JOINTS = tuple(f'{side}_{joint}' for side in SIDES for joint in LEG_JOINTS)


class MiniBiped(legacy_base.Walker):
  """A 14 kg biped with five torque-limited servos a leg.

  Actions are joint targets in radians, relative to a crouch; the servos apply
  clip(30 (a - q) - 0.5 qdot, +-30) Nm at every physics step (Eq. 2). The gains
  are those of the actuators in `xml/mini_biped.xml`.
  """

  def _build(
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
    super()._build(initializer=initializer)
    self._mjcf_root = mjcf.from_path(
      str(resources.path('xml', 'mini_biped.xml'))
    )
    if name:
      self._mjcf_root.model = name
    # Arenas choose the root joint and the place.
    self.root_body.freejoint.remove()
    del self.root_body.pos
    # dm_control's `action_spec` ignores default classes, and would bound the
    # actions by 1.
    servo = self._mjcf_root.default.find('default', 'servo').position
    for actuator in self.actuators:
      actuator.ctrlrange = servo.ctrlrange
    if marker_rgba is not None:
      for geom in self.marker_geoms:
        geom.rgba = marker_rgba
    self._prev_action = np.zeros(len(JOINTS))

  def initialize_episode(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Forgets the action of the episode before."""
    super().initialize_episode(physics, random_state)
    self._prev_action = np.zeros(len(JOINTS))

  def apply_action(
    self,
    physics: Any,
    action: np.ndarray,
    random_state: np.random.RandomState,
  ) -> None:
    """Hands joint targets, radians [10], to the servos, and remembers them."""
    super().apply_action(physics, action, random_state)
    self._prev_action = np.array(action, dtype=float)

  @property
  def prev_action(self) -> np.ndarray:
    """The joint targets applied last, radians [10]; 0 before the first."""
    return self._prev_action

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    """The robot's MJCF tree."""
    return self._mjcf_root

  @property
  def upright_pose(self) -> base.WalkerPose:
    """The crouch with both soles on the ground."""
    return base.WalkerPose(
      qpos=np.zeros(len(JOINTS)), xpos=(0.0, 0.0, constants.STAND_HEIGHT)
    )

  @composer.cached_property
  def actuators(self) -> tuple[Any, ...]:
    """The servos, in the order of `JOINTS`."""
    return tuple(self._mjcf_root.find('actuator', name) for name in JOINTS)

  @composer.cached_property
  def observable_joints(self) -> tuple[Any, ...]:
    """The hinges, in the order of `JOINTS`."""
    return tuple(self._mjcf_root.find('joint', name) for name in JOINTS)

  @composer.cached_property
  def root_body(self) -> Any:
    """The trunk; its frame is at the trunk's centre."""
    return self._mjcf_root.find('body', 'trunk')

  @property
  def bodies(self) -> tuple[Any, ...]:
    """All bodies, from the trunk down."""
    return tuple(self._mjcf_root.find_all('body'))

  @property
  def mocap_tracking_bodies(self) -> tuple[Any, ...]:
    """The bodies that a task of motion capture compares: all."""
    return self.bodies

  @property
  def marker_geoms(self) -> tuple[Any, ...]:
    """The visible geoms that are coloured by `marker_rgba`."""
    return tuple(
      geom
      for geom in self.root_body.geom
      if geom.material is not None and geom.material.name == 'shell'
    )

  @composer.cached_property
  def end_effectors(self) -> tuple[Any, ...]:
    """The feet's bodies (left, right)."""
    return tuple(self._mjcf_root.find('body', f'{s}_foot') for s in SIDES)

  @composer.cached_property
  def ground_contact_geoms(self) -> tuple[Any, ...]:
    """The soles (left, right)."""
    return tuple(self._mjcf_root.find('geom', f'{s}_foot') for s in SIDES)

  @composer.cached_property
  def egocentric_camera(self) -> Any:
    """The camera in the trunk's front."""
    return self._mjcf_root.find('camera', 'egocentric')

  @composer.cached_property
  def foot_sensors(self) -> tuple[Any, ...]:
    """The touch sensors of the soles (left, right)."""
    return tuple(self._mjcf_root.find('sensor', f'{s}_foot') for s in SIDES)

  def aliveness(self, physics: Any) -> float:
    """Returns a value from 0, upright, to -1, upside down."""
    return float(physics.bind(self.root_body).xmat[-1] - 1.0) / 2


def standing_action(
  model: mujoco.MjModel, prefix: str = 'walker/'
) -> np.ndarray:
  """Returns the joint targets that hold the crouch against gravity.

  The servos are soft: with targets at the crouch itself the robot sags and
  falls. Each foot carries half of the weight, straight under the centre of
  mass; statics gives the torques, and Eq. 2 the targets.

  Args:
    model: a compiled model with one mini biped on a free joint.
    prefix: of the robot's names in it.

  Returns:
    Radians, [10].
  """
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  weight = (
    -model.opt.gravity[2]
    * model.body_subtreemass[model.body(f'{prefix}trunk').id]
  )
  torque = data.qfrc_bias.copy()
  centre = data.body(f'{prefix}trunk').subtree_com
  jacobian = np.zeros((3, model.nv))
  for side in SIDES:
    foot = model.body(f'{prefix}{side}_foot').id
    sole = np.array([centre[0], data.xpos[foot, 1], data.xpos[foot, 2]])
    mujoco.mj_jac(model, data, jacobian, None, sole, foot)
    torque -= jacobian[2] * weight / len(SIDES)
  actuators = [model.actuator(f'{prefix}{name}') for name in JOINTS]
  dofs = [model.jnt_dofadr[actuator.trnid[0]] for actuator in actuators]
  stiffness = np.array([actuator.gainprm[0] for actuator in actuators])
  return torque[dofs] / stiffness
