"""A declared robot as a dm_control locomotion walker."""

from typing import Any

from dm_control import composer
from dm_control import mjcf
from dm_control.locomotion.walkers import base
from dm_control.locomotion.walkers import legacy_base
import mujoco
import numpy as np

from dmc_multimode.walkers import extents
from dmc_multimode.walkers import robot as robot_lib

PREFIX = 'walker/'  # Of the names of a robot in its arena.
_PLACE = ('pos', 'quat', 'axisangle', 'euler', 'xyaxes', 'zaxis')
_SHAPES = {  # Of feet that are geoms, and of their sites.
  mujoco.mjtGeom.mjGEOM_SPHERE: 'sphere',
  mujoco.mjtGeom.mjGEOM_CAPSULE: 'capsule',
  mujoco.mjtGeom.mjGEOM_ELLIPSOID: 'ellipsoid',
  mujoco.mjtGeom.mjGEOM_CYLINDER: 'cylinder',
  mujoco.mjtGeom.mjGEOM_BOX: 'box',
}
# Views of robots that have none of these names: their places from the trunk, in
# metres of the mini biped, and their x and y axes.
_CAMERAS = {
  'side': ([0.0, -2.4, 0.35], [1.0, 0.0, 0.0, 0.0, 0.12, 1.0]),
  'front': ([2.2, -0.9, 0.5], [0.38, 0.92, 0.0, -0.18, 0.07, 1.0]),
}
_MARGIN = 0.005  # Metres by which a touch site is larger than its geom.
_DRAWN = range(3)  # Groups of geoms that films and MuJoCo's viewers draw.


class RobotWalker(legacy_base.Walker):
  """A robot whose actions are joint targets, radians, in its joints' order.

  Its servos apply clip(stiffness (a - q) - damping dq/dt, +-limit) at every
  physics step.
  """

  def _build(
    self,
    robot: robot_lib.Robot,
    name: str | None = 'walker',
    initializer: Any = None,
    bounded: bool = True,
  ) -> None:
    """Builds the robot.

    Args:
      robot: the declaration.
      name: of the walker; that of the file if None.
      initializer: a `WalkerInitializer`, or several; upright by default.
      bounded: bounds the actions as it follows from the model; false while
        that is derived.

    Raises:
      ValueError: in one line, the model is not what the declaration says.
    """
    super()._build(initializer=initializer)
    self.robot = robot
    try:
      self._mjcf_root = mjcf.from_xml_string(
        robot.model.xml, assets=dict(robot.model.assets)
      )
      parsed = _parse(self._mjcf_root)
    except Exception as error:  # Of many types, for what is no MJCF.
      raise ValueError(
        f'the model is not MJCF: {_first_line(error)}'
      ) from error
    if name:
      self._mjcf_root.model = name
    self._check_names()
    self._free_trunk()
    self._limit(parsed)
    self._drive()
    self._show(parsed)
    self._touches = self._touch_sensors()
    self._prev_action = np.zeros(robot.num_joints)
    if bounded:
      # dm_control's `action_spec` ignores default classes, and would bound the
      # actions by 1.
      bounds = robot.derived.action_bounds.T.tolist()
      _leave_inherited_ranges(self._mjcf_root)
      for actuator, bound in zip(self.actuators, bounds, strict=True):
        actuator.ctrlrange = bound
      self._add_cameras()
      self._add_light()

  def _add_cameras(self) -> None:
    """Adds the cameras that follow the robot, unless it has them."""
    for name, (place, axes) in _CAMERAS.items():
      if self._mjcf_root.find('camera', name) is None:
        self.root_body.add(
          'camera',
          name=name,
          mode='trackcom',
          pos=self.robot.size * np.array(place),
          xyaxes=axes,
          fovy=45,
        )

  def _add_light(self) -> None:
    """Adds a light that follows the robot and casts its shadow, if it has none.

    As the mini biped's own. The lights of its world are left out of a model.
    """
    if not self._mjcf_root.find_all('light'):
      self.root_body.add(
        'light',
        name='key',
        mode='trackcom',
        directional=True,
        pos=self.robot.size * np.array([0.0, -1.2, 3.0]),
        dir=[0.0, 0.4, -1.0],
        diffuse=[0.5] * 3,
        specular=[0.15] * 3,
      )

  def _check_names(self) -> None:
    """Raises ValueError unless the declared joints are those of the model."""
    root, declared = self._mjcf_root, self.robot.declaration
    found = []
    for joint in root.find_all('joint', exclude_attachments=True):
      if joint.tag == 'freejoint' or joint.type == 'free':
        continue
      if joint.parent == self.root_body:
        raise ValueError(
          f'the trunk has a joint {joint.name!r}: it floats, and has none.'
        )
      found.append(joint.name or '(without a name)')
    if tuple(found) != declared.joints:
      wrong = [name for name in declared.joints if name not in found]
      reason = f'there is no {wrong[0]!r}; ' if wrong else ''
      raise ValueError(
        f'joints must be all of the model, in its order: {reason}'
        f'it has {", ".join(found)}.'
      )
    kinds = ('site', 'geom', 'body')
    for foot in declared.feet:
      if all(root.find(kind, foot) is None for kind in kinds):
        raise ValueError(
          f'the foot {foot!r} is neither a site nor a geom nor a body.'
        )

  def _free_trunk(self) -> None:
    """Leaves the root joint and the place of the trunk to arenas."""
    trunk = self.root_body
    if trunk.freejoint is not None:
      trunk.freejoint.remove()
    for joint in list(trunk.joint):
      joint.remove()
    if any(getattr(trunk, name) is not None for name in _PLACE[1:]):
      raise ValueError('the trunk is turned in the model: leave it upright.')
    del trunk.pos

  def _limit(self, parsed: mujoco.MjSpec) -> None:
    """Gives joints the declared ranges; those of the model stay."""
    for name, bounds in self.robot.declaration.ranges.items():
      known = parsed.joint(name)
      unlimited = known.limited == mujoco.mjtLimited.mjLIMITED_FALSE
      if not unlimited and known.range[0] < known.range[1]:
        raise ValueError(
          f'ranges: {name!r} has a range in the model: leave it out.'
        )
      joint = self._mjcf_root.find('joint', name)
      joint.limited, joint.range = 'true', bounds

  def _show(self, parsed: mujoco.MjSpec) -> None:
    """Draws the geoms of bodies that have none in a group that is drawn.

    Many models have only geoms that collide in some bodies, in group 3.
    """
    if self._mjcf_root.compiler.inertiagrouprange is not None:
      return  # The groups say which geoms weigh.
    for body in self.bodies:
      geoms = [(geom, parsed.geom(geom.full_identifier)) for geom in body.geom]
      if all(known.group not in _DRAWN for _, known in geoms):
        for geom, _ in geoms:
          geom.group = _DRAWN[0]

  def _drive(self) -> None:
    """Gives the joints the declared servos and armature."""
    declared, root = self.robot.declaration, self._mjcf_root
    for name in declared.joints if declared.armature is not None else ():
      root.find('joint', name).armature = declared.armature
    if declared.servos is None:
      self._check_actuators()
      return
    for sensor in root.sensor.all_children():
      if getattr(sensor, 'actuator', None) is not None:
        sensor.remove()
    for actuator in root.find_all('actuator'):
      actuator.remove()
    for name in declared.joints:
      gains = {
        field: value[name] if isinstance(value, dict) else value
        for field, value in vars(declared.servos).items()
        if field in ('stiffness', 'damping', 'limit')
      }
      root.actuator.add(
        'position',
        name=name,
        joint=name,
        kp=gains['stiffness'],
        kv=gains['damping'],
        gear=[1.0],
        forcelimited=True,
        forcerange=[-gains['limit'], gains['limit']],
        ctrllimited=True,
        ctrlrange=[-1.0, 1.0],  # Until the ranges of the joints are known.
      )

  def _check_actuators(self) -> None:
    """Raises ValueError unless each joint has a servo of its own, in order."""
    root = self._mjcf_root
    driven = []
    for actuator in root.find_all('actuator', exclude_attachments=True):
      if actuator.tag != 'position' or actuator.joint is None:
        raise ValueError(
          f'the actuator {actuator.name!r} is no position servo of a joint: '
          'declare servos.'
        )
      driven.append(actuator.joint.name)
    if tuple(driven) != self.robot.joints:
      raise ValueError(
        "the model's actuators drive other joints, or in another order, than "
        f'declared ({", ".join(driven) or "none"}): declare servos.'
      )

  def _touch_sensors(self) -> tuple[Any, ...]:
    """Returns touch sensors of the feet, in their order.

    Those that the model has in this order are left; others are made.
    """
    root, feet = self._mjcf_root, self.robot.declaration.feet
    others = [foot for foot in feet if root.find('site', foot) is None]
    if others:
      # Compiled, for much of a shape may be that of a class.
      model = compile_model(root)
      for foot in others:
        if root.find('geom', foot) is not None:
          self._add_site(root.find('geom', foot), model.geom(foot))
        else:
          self._add_box(root.find('body', foot), model)
    sites = [root.find('site', foot) for foot in feet]
    for site in sites:
      if site.parent.name is None:  # dm_control's end effectors have names.
        site.parent.name = f'{site.name}_body'
    mine = [s for s in root.sensor.get_children('touch') if s.site in sites]
    if [sensor.site for sensor in mine] == sites:
      return tuple(mine)
    for sensor in mine:
      sensor.remove()
    return tuple(
      root.sensor.add('touch', name=site.name, site=site) for site in sites
    )

  def _add_site(self, geom: Any, compiled: Any) -> None:
    """Adds a site of a geom's shape and name, a little larger."""
    shape = _SHAPES.get(mujoco.mjtGeom(compiled.type[0]))
    if shape is None:
      raise ValueError(
        f'the foot {geom.name!r} must be a {", ".join(_SHAPES.values())}: '
        'declare a site in its place.'
      )
    used = np.where(compiled.size > 0, compiled.size + _MARGIN, 0.0)
    geom.parent.add(
      'site',
      name=geom.name,
      type=shape,
      size=used,
      pos=compiled.pos,
      quat=compiled.quat,
      group=4,
    )

  def _add_box(self, body: Any, model: mujoco.MjModel) -> None:
    """Adds a site of a body's name, around all that collides of it."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    index = model.body(body.name).id
    own = (model.geom_bodyid == index) & extents.collides(model)
    if not own.any():
      raise ValueError(
        f'the foot {body.name!r} touches nothing: no geom of it collides.'
      )
    axes = data.xmat[index].reshape(3, 3).T
    geoms = np.flatnonzero(own).tolist()
    low, high = extents.bounds(model, data, geoms, axes)
    body.add(
      'site',
      name=body.name,
      type='box',
      size=(high - low) / 2 + _MARGIN,
      pos=(low + high) / 2 - axes @ data.xpos[index],
      group=4,
    )

  def initialize_episode(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Forgets the action of the episode before."""
    super().initialize_episode(physics, random_state)
    self._prev_action = np.zeros(self.robot.num_joints)

  def apply_action(
    self,
    physics: Any,
    action: np.ndarray,
    random_state: np.random.RandomState,
  ) -> None:
    """Hands joint targets, radians [J], to the servos, and remembers them."""
    super().apply_action(physics, action, random_state)
    self._prev_action = np.array(action, dtype=float)

  @property
  def prev_action(self) -> np.ndarray:
    """The joint targets applied last, radians [J]; 0 before the first."""
    return self._prev_action

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    """The robot's MJCF tree."""
    return self._mjcf_root

  @property
  def upright_pose(self) -> base.WalkerPose:
    """The standing pose with the feet on the ground."""
    pose = self.robot.declaration.pose
    return base.WalkerPose(
      qpos=np.array([pose.get(name, 0.0) for name in self.robot.joints]),
      xpos=(0.0, 0.0, self.robot.stand_height),
    )

  @composer.cached_property
  def actuators(self) -> tuple[Any, ...]:
    """The servos, in the order of the joints."""
    return tuple(self._mjcf_root.find_all('actuator'))

  @composer.cached_property
  def observable_joints(self) -> tuple[Any, ...]:
    """The joints, in the order of actions."""
    return tuple(
      self._mjcf_root.find('joint', name) for name in self.robot.joints
    )

  @composer.cached_property
  def root_body(self) -> Any:
    """The trunk; its frame is that of positions and orientations."""
    return self._mjcf_root.find('body', self.robot.declaration.trunk)

  @property
  def bodies(self) -> tuple[Any, ...]:
    """All bodies, from the trunk down."""
    return tuple(self._mjcf_root.find_all('body'))

  @property
  def mocap_tracking_bodies(self) -> tuple[Any, ...]:
    """The bodies that a task of motion capture compares: all."""
    return self.bodies

  @composer.cached_property
  def end_effectors(self) -> tuple[Any, ...]:
    """The feet's bodies, in the order of the feet."""
    return tuple(sensor.site.parent for sensor in self._touches)

  @composer.cached_property
  def ground_contact_geoms(self) -> tuple[Any, ...]:
    """The geoms of the feet's bodies that collide, or those declared."""
    root, found = self._mjcf_root, []
    for foot, body in zip(
      self.robot.declaration.feet, self.end_effectors, strict=True
    ):
      geom = root.find('geom', foot)
      found += [geom] if geom is not None else list(body.geom)
    return tuple(found)

  @composer.cached_property
  def egocentric_camera(self) -> Any:
    """The camera named `egocentric`, which is made where there is none."""
    camera = self._mjcf_root.find('camera', 'egocentric')
    if camera is None:
      camera = self.root_body.add(
        'camera', name='egocentric', xyaxes=[0, -1, 0, 0, 0, 1], fovy=80
      )
    return camera

  @composer.cached_property
  def foot_sensors(self) -> tuple[Any, ...]:
    """The touch sensors of the feet, in their order."""
    return self._touches

  def aliveness(self, physics: Any) -> float:
    """Returns a value from 0, upright, to -1, upside down."""
    return float(physics.bind(self.root_body).xmat[-1] - 1.0) / 2


def compile_alone(walker: RobotWalker) -> mujoco.MjModel:
  """Compiles a robot on a free joint, over no ground, as tasks have it.

  Raises:
    ValueError: in one line, MuJoCo refuses the model.
  """
  arena = composer.Arena()
  walker.create_root_joints(arena.attach(walker))
  root = arena.mjcf_model
  root.option.noslip_iterations = 0
  return compile_model(root)


def compile_fixed(walker: RobotWalker) -> mujoco.MjModel:
  """Compiles a robot whose trunk is fixed at the origin.

  Raises:
    ValueError: in one line, MuJoCo refuses the model.
  """
  arena = composer.Arena()
  arena.attach(walker)
  return compile_model(arena.mjcf_model)


def compile_model(root: mjcf.RootElement) -> mujoco.MjModel:
  """Compiles a model; raises ValueError in one line."""
  try:
    return _parse(root).compile()
  except ValueError as error:
    reason = _first_line(error)
    raise ValueError(f'MuJoCo refuses the model: {reason}') from error


def _parse(root: mjcf.RootElement) -> mujoco.MjSpec:
  """Returns a model in which elements have the values of their classes."""
  return mujoco.MjSpec.from_string(
    root.to_xml_string(), assets=root.get_assets()
  )


def _leave_inherited_ranges(root: mjcf.RootElement) -> None:
  """Removes `inheritrange`, which MuJoCo refuses beside a `ctrlrange`."""
  defaults = [root.default, *root.default.find_all('default')]
  servos = [default.position for default in defaults]
  for servo in (*servos, *root.find_all('actuator')):
    if servo.inheritrange is not None:
      del servo.inheritrange


def _first_line(error: Exception) -> str:
  """Returns an error's text in one line."""
  lines = [line.strip() for line in str(error).splitlines() if line.strip()]
  return ' '.join(lines)[:300] or type(error).__name__
