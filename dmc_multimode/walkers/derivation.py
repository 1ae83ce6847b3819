"""Derives from a robot's model all that tasks need, and checks both.

Every check raises a ValueError of one line, without the robot's name.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np

from dmc_multimode.walkers import extents
from dmc_multimode.walkers import mirroring
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

PREFIX = robot_walker.PREFIX
_TRUNK = 0.2  # Share of the height that a trunk without geoms is shown with.
_LEVEL = 0.02  # Share of the height by which the feet's heights may differ.
_DIGITS = 5  # Of the corners of soles, metres.
_SWEEPS, _GRID = 3, 33  # Of the search for the longest leg.
_MOVING = tuple(
  int(kind)
  for kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
)


@dataclasses.dataclass(frozen=True, eq=False)
class Derived:
  """Numbers that follow from the model of a robot with J joints and F feet.

  Lengths that tasks use have three digits.

  Attributes:
    mass: of the robot, kg.
    stand_height: from the feet to the trunk's origin, metres.
    leg_length: farthest that a foot gets from its leg's first joint, metres.
    stance_width: of the feet, from right to left, metres.
    sole_depth: of the contact with the ground below each foot's site, metres,
      [F].
    sole_corners: of each sole in the frame of its site, metres, [F, 4, 3].
    pose: joints in the standing pose, radians, [J].
    joint_limits: lower and upper, radians, [2, J].
    action_bounds: lower and upper, radians, [2, J].
    action_scale: distance of target and joint that takes the whole torque,
      radians, [J]; infinite without a limit.
    stiffness: of the servos, Nm/rad, [J].
    damping: of the servos and of the joints themselves together, Nm s/rad, [J].
    standing_action: targets that hold the standing pose against gravity,
      radians, [J].
    mirror: exchange of left and right.
    trunk_size: how far the trunk reaches from its origin along its axes,
      metres, [3].
  """

  mass: float
  stand_height: float
  leg_length: float
  stance_width: float
  sole_depth: np.ndarray
  sole_corners: np.ndarray
  pose: np.ndarray
  joint_limits: np.ndarray
  action_bounds: np.ndarray
  action_scale: np.ndarray
  stiffness: np.ndarray
  damping: np.ndarray
  standing_action: np.ndarray
  mirror: mirroring.Mirror
  trunk_size: np.ndarray


class Stance(NamedTuple):
  """A robot in its standing pose, its trunk upright at the origin.

  Attributes:
    model: compiled, with nothing but the robot.
    data: of the pose, after `mj_forward`.
    trunk: index of its body.
    joints: indices of the joints, [J].
    sites: of the feet, [F].
    bodies: of the feet, [F].
    geoms: of each foot that collide, F lists.
    ground: height of the ground, metres.
  """

  model: mujoco.MjModel
  data: mujoco.MjData
  trunk: int
  joints: np.ndarray
  sites: np.ndarray
  bodies: np.ndarray
  geoms: tuple[list[int], ...]
  ground: float


def derive(robot: robot_lib.Robot) -> Derived:
  """Compiles a robot, and returns what follows.

  Raises:
    ValueError: in one line, the model and the declaration do not fit.
  """
  model = robot_walker.compile_alone(
    robot_walker.RobotWalker(robot, bounded=False)
  )
  stance = _stand(model, robot, _joints(model, robot))
  mirror = mirroring.derive(
    model,
    stance.data.qpos,
    robot.joints,
    robot.declaration.feet,
    stance.sites,
    robot.declaration.asymmetry or 0.0,
  )
  heights = stance.data.site_xpos[stance.sites, 2]
  lowest = [_lowest(model, stance.data, geoms) for geoms in stance.geoms]
  limits = model.jnt_range[stance.joints].T.copy()
  return Derived(
    mass=float(model.body_subtreemass[stance.trunk]),
    stand_height=_rounded(-stance.ground),
    leg_length=_leg_length(stance),
    stance_width=_stance_width(stance, mirror),
    sole_depth=np.array([_rounded(d) for d in heights - np.array(lowest)]),
    sole_corners=np.array([_corners(stance, f) for f in range(len(heights))]),
    pose=stance.data.qpos[7:].copy(),
    joint_limits=limits,
    action_bounds=_action_bounds(model, robot, limits),
    action_scale=_action_scale(model),
    stiffness=model.actuator_gainprm[:, 0].copy(),
    damping=model.dof_damping[model.jnt_dofadr[stance.joints]]
    - model.actuator_biasprm[:, 2],
    standing_action=_standing_action(stance, robot),
    mirror=mirror,
    trunk_size=_trunk_size(stance),
  )


def _rounded(value: float) -> float:
  """Returns a length with three digits."""
  return float(f'{value:.3g}')


def _joints(model: mujoco.MjModel, robot: robot_lib.Robot) -> np.ndarray:
  """Returns the indices of the joints, [J], each checked."""
  ids = np.array([model.joint(PREFIX + name).id for name in robot.joints])
  for name, joint in zip(robot.joints, ids.tolist(), strict=True):
    if model.jnt_type[joint] not in _MOVING:
      raise ValueError(f'the joint {name!r} is no hinge or slide.')
    low, high = model.jnt_range[joint]
    if not (model.jnt_limited[joint] and low < high):
      raise ValueError(
        f'the joint {name!r} has no limits: give it a range in the model, or '
        'declare `ranges`.'
      )
    angle = robot.declaration.pose.get(name, 0.0)
    if not low <= angle <= high:
      raise ValueError(
        f'pose: {name!r} is {angle:g}, outside of its range {low:.3g} to '
        f'{high:.3g}.'
      )
  if model.nq != 7 + len(ids) or model.nu != len(ids):
    raise ValueError(
      f'the model has {model.nq} coordinates and {model.nu} actuators; a free '
      f'joint and {len(ids)} driven ones have {7 + len(ids)} and {len(ids)}.'
    )
  if ids.tolist() != list(range(1, 1 + len(ids))):
    ordered = sorted(
      robot.joints, key=lambda name: model.joint(PREFIX + name).id
    )
    raise ValueError(
      f'joints must be in the order of the model: {", ".join(ordered)}.'
    )
  if (model.actuator_trnid[:, 0] != ids).any():
    raise ValueError('the servos are not in the order of the joints.')
  if (model.actuator_gear[:, 0] != 1).any():
    raise ValueError("the model's servos have gears: declare servos.")
  return ids


def _stand(
  model: mujoco.MjModel, robot: robot_lib.Robot, joints: np.ndarray
) -> Stance:
  """Puts the robot into its standing pose; checks that it can stand so."""
  data = mujoco.MjData(model)
  pose = robot.declaration.pose
  data.qpos[:3] = 0.0
  data.qpos[7:] = [pose.get(name, 0.0) for name in robot.joints]
  mujoco.mj_forward(model, data)
  sites = np.array(
    [model.site(PREFIX + foot).id for foot in robot.declaration.feet]
  )
  bodies = model.site_bodyid[sites]
  geoms = tuple(
    _foot_geoms(model, foot, body)
    for foot, body in zip(robot.declaration.feet, bodies.tolist(), strict=True)
  )
  lowest = [_lowest(model, data, own) for own in geoms]
  ground = min(lowest)
  if ground >= 0:
    raise ValueError('the feet are not below the trunk in the standing pose.')
  for foot, height in zip(robot.declaration.feet, lowest, strict=True):
    if height - ground > _LEVEL * -ground:
      raise ValueError(
        f'the foot {foot!r} is {1000 * (height - ground):.0f} mm over the '
        'ground in the standing pose: correct the pose.'
      )
  _check_above(model, data, ground, {g for own in geoms for g in own})
  trunk = int(model.body(PREFIX + robot.declaration.trunk).id)
  return Stance(model, data, trunk, joints, sites, bodies, geoms, ground)


def _foot_geoms(
  model: mujoco.MjModel, foot: str, body: int, prefix: str = PREFIX
) -> list[int]:
  """Returns the geoms with which a foot touches the ground."""
  named = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, prefix + foot)
  own = [
    geom
    for geom in range(model.ngeom)
    if model.geom_bodyid[geom] == body and extents.collides(model)[geom]
  ]
  found = own if named < 0 else [geom for geom in own if geom == named]
  if not found:
    raise ValueError(
      f'the foot {foot!r} touches nothing: its geom does not collide.'
    )
  return found


def _check_above(
  model: mujoco.MjModel, data: mujoco.MjData, ground: float, feet: set[int]
) -> None:
  """Raises ValueError if a geom of no foot is in the ground."""
  for geom in range(model.ngeom):
    if not extents.collides(model)[geom] or geom in feet:
      continue
    depth = ground - _lowest(model, data, [geom])
    if depth > _LEVEL * -ground:
      name = model.geom(geom).name or model.body(model.geom_bodyid[geom]).name
      raise ValueError(
        f'{name.removeprefix(PREFIX)!r} is {1000 * depth:.0f} mm in the ground '
        'in the standing pose: correct the pose.'
      )


def _lowest(
  model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int]
) -> float:
  """Returns the height of the lowest point of geoms, metres."""
  return float(extents.bounds(model, data, geoms)[0, 2])


def _corners(stance: Stance, foot: int) -> np.ndarray:
  """Returns the corners of a flat sole in the frame of its site, [4, 3]."""
  data, site = stance.data, stance.sites[foot]
  low, high = extents.bounds(stance.model, data, stance.geoms[foot])
  places = np.array(
    [(x, y, low[2]) for x in (low[0], high[0]) for y in (low[1], high[1])]
  )
  axes = data.site_xmat[site].reshape(3, 3)
  return np.round((places - data.site_xpos[site]) @ axes, _DIGITS)


def _trunk_size(stance: Stance) -> np.ndarray:
  """Returns how far the trunk's solid geoms reach along its axes, [3]."""
  model = stance.model
  own = np.flatnonzero(
    (model.geom_bodyid == stance.trunk) & extents.collides(model)
  )
  if not len(own):
    return np.full(3, -_TRUNK * stance.ground)
  return np.abs(extents.bounds(model, stance.data, own.tolist())).max(axis=0)


def _stance_width(stance: Stance, mirror: mirroring.Mirror) -> float:
  """Returns the mean distance of left feet from right ones, metres."""
  y = stance.data.site_xpos[stance.sites, 1]
  widths = [y[left] - y[right] for left, right in mirror.pairs]
  return _rounded(float(np.mean(widths)))


def _leg_length(stance: Stance) -> float:
  """Returns the farthest that the first foot gets from its leg's first joint.

  Each joint in turn goes to the place of a grid of its range at which the foot
  is farthest away, a few times over; metres.
  """
  model, data = stance.model, mujoco.MjData(stance.model)
  data.qpos[:] = stance.data.qpos
  body, leg = int(stance.bodies[0]), []
  while model.body_parentid[body] and model.body_jntadr[body] != 0:
    count = model.body_jntnum[body]
    leg += list(range(model.body_jntadr[body], model.body_jntadr[body] + count))
    body = int(model.body_parentid[body])
  if not leg:
    raise ValueError('a foot is fixed to the trunk: legs have joints.')
  first = min(leg)
  longest = 0.0
  for joint in sorted(leg) * _SWEEPS:
    place, reaches = model.jnt_qposadr[joint], []
    low, high = model.jnt_range[joint].tolist()
    angles = np.linspace(low, high, _GRID)
    for angle in angles:
      data.qpos[place] = angle
      mujoco.mj_kinematics(model, data)
      away = data.site_xpos[stance.sites[0]] - data.xanchor[first]
      reaches.append(float(np.linalg.norm(away)))
    data.qpos[place] = angles[np.argmax(reaches)]
    longest = max(reaches)
  return _rounded(longest)


def _action_bounds(
  model: mujoco.MjModel, robot: robot_lib.Robot, limits: np.ndarray
) -> np.ndarray:
  """Returns the bounds of the actions, radians, [2, J].

  Those of the model's own servos; of declared ones, the targets that take the
  whole torque at a limit of the joint.
  """
  if robot.declaration.servos is None:
    if not model.actuator_ctrllimited.all():
      raise ValueError(
        "the model's servos have no ctrlrange: give them one, or declare "
        'servos.'
      )
    return model.actuator_ctrlrange.T.copy()
  return limits + np.array([[-1.0], [1.0]]) * _action_scale(model)


def _action_scale(model: mujoco.MjModel) -> np.ndarray:
  """Returns the distances of targets that take the whole torque, [J]."""
  limited = model.actuator_forcelimited.astype(bool)
  limit = np.where(limited, model.actuator_forcerange[:, 1], np.inf)
  joints = model.actuator_trnid[:, 0]
  bounded = model.jnt_actfrclimited[joints].astype(bool)
  limit[bounded] = np.minimum(limit, model.jnt_actfrcrange[joints, 1])[bounded]
  return limit / model.actuator_gainprm[:, 0]


def _standing_action(stance: Stance, robot: robot_lib.Robot) -> np.ndarray:
  """Returns `standing_action` of servos that are strong enough, [J]."""
  found = standing_action(stance.model, robot)
  off = np.abs(found - stance.data.qpos[7:])
  scale = _action_scale(stance.model)
  if (off > scale).any():
    worst = int(np.argmax(off / scale))
    raise ValueError(
      f'the servo of {robot.joints[worst]!r} is too weak to stand: it takes '
      f'{off[worst] / scale[worst]:.2g} of its torque.'
    )
  return found


def standing_action(
  model: mujoco.MjModel, robot: robot_lib.Robot, prefix: str = PREFIX
) -> np.ndarray:
  """Returns the joint targets that hold the standing pose against gravity.

  The servos are soft: with targets at the pose itself a robot sags. The feet
  carry the weight as `_support` says; statics gives the torques, and the
  servos' stiffness the targets.

  Args:
    model: a compiled model with one such robot on a free joint.
    robot: the declaration.
    prefix: of the robot's names in it.

  Returns:
    Radians, [J].

  Raises:
    ValueError: the centre of mass is not over the feet.
  """
  data = mujoco.MjData(model)
  joints = [model.joint(prefix + name).id for name in robot.joints]
  pose = np.array([robot.declaration.pose.get(n, 0.0) for n in robot.joints])
  data.qpos[model.jnt_qposadr[joints]] = pose
  mujoco.mj_forward(model, data)
  trunk = model.body(prefix + robot.declaration.trunk).id
  weight = -model.opt.gravity[2] * model.body_subtreemass[trunk]
  torque = data.qfrc_bias.copy()
  jacobian = np.zeros((3, model.nv))
  for body, point, carriers in _support(model, data, robot, prefix, trunk):
    mujoco.mj_jac(model, data, jacobian, None, point, body)
    torque -= jacobian[2] * weight / carriers
  driven = model.actuator_trnid[:, 0].tolist()
  stiffness = model.actuator_gainprm[[driven.index(j) for j in joints], 0]
  return torque[model.jnt_dofadr[joints]] / stiffness + pose


def _support(
  model: mujoco.MjModel,
  data: mujoco.MjData,
  robot: robot_lib.Robot,
  prefix: str,
  trunk: int,
) -> list[tuple[int, np.ndarray, float]]:
  """Returns the forces that carry the robot, one a foot that carries.

  Two feet have soles, and each carries half of the weight straight under the
  centre of mass, at the side of the ankle if that is over the sole. Four feet
  are points, and carry what is least in the sum of squares.

  Returns:
    Body of each foot, point of its force, world metres, and the number of such
    forces that make the weight.

  Raises:
    ValueError: the centre of mass is not over the feet.
  """
  feet = robot.declaration.feet
  sites = [model.site(prefix + foot).id for foot in feet]
  bodies = [int(body) for body in model.site_bodyid[sites]]
  centre, places = data.subtree_com[trunk], data.site_xpos[sites]
  if len(feet) == 2:
    found: list[tuple[int, np.ndarray, float]] = []
    reaches = []
    for foot, body, place in zip(feet, bodies, places, strict=True):
      ends = extents.bounds(model, data, _foot_geoms(model, foot, body, prefix))
      ankle = data.xpos[body]
      over = ends[0, 1] <= ankle[1] <= ends[1, 1]
      y = ankle[1] if over else place[1]
      found.append((body, np.array([centre[0], y, ankle[2]]), 2))
      reaches.append(ends[:, 0])
    behind, ahead = np.mean(reaches, axis=0)
    stands = behind <= centre[0] <= ahead
  else:
    rows = np.vstack([np.ones(len(feet)), places[:, :2].T])
    wanted = np.array([1.0, centre[0], centre[1]])
    shares = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    stands = (shares > 0).all() and np.allclose(rows @ shares, wanted)
    carried = zip(bodies, places, shares.tolist(), strict=True)
    found = [
      (body, place, 1 / share) for body, place, share in carried if share
    ]
  if not stands:
    raise ValueError(
      'the centre of mass is not over the feet in the standing pose.'
    )
  return found
