"""Cameras that follow the robot, and visual decorations of a scene."""

import copy
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

from dm_control.mujoco import engine
import mujoco
import numpy as np
from scipy.spatial import transform

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.viewer import rollout


class View(NamedTuple):
  """A camera that follows the robot.

  Lengths are those for the mini biped; `scaled` fits them to other robots.

  Attributes:
    azimuth: degrees; 90 looks along +y, with +x to the right.
    elevation: degrees, negative from above.
    distance: to the point looked at, metres.
    ahead: distance of the point looked at from the trunk, metres along x.
    height: of the point looked at over the support plane, metres.
  """

  azimuth: float
  elevation: float
  distance: float
  ahead: float
  height: float = 0.45

  def scaled(self, size: float) -> 'View':
    """Returns the view for a robot of this `size`, see `Robot.size`."""
    return self._replace(
      distance=self.distance * size,
      ahead=self.ahead * size,
      height=self.height * size,
    )


VIEWS: Mapping[str, View] = {
  'side': View(76.0, -13.0, 2.3, 0.15),
  'front': View(152.0, -14.0, 2.1, 0.1),
  'overview': View(62.0, -20.0, 4.6, 0.9),
}
# Time constants of the view: ledges and leaps must not shake it.
_LAG = np.array([0.12, 0.4, 0.5])  # Seconds.
_JUMP = 1.5  # Metres to a target beyond which the view jumps.

GHOST = (0.15, 0.55, 0.95, 0.32)
TOP, _WALL = (0.74, 0.77, 0.80, 1.0), (0.40, 0.47, 0.56, 1.0)
_BAND, EDGE = (0.66, 0.695, 0.735, 1.0), (0.95, 0.60, 0.15, 1.0)
_BAND_WIDTH = 0.25  # Metres; bands lie twice as far apart.
_REACH = 10.0  # Metres ahead of and behind the robot with bands.
_LIFT = 0.002  # Metres: bands and edges lie this much over the ground.
_EDGE_WIDTH = 0.025  # Metres.
EXTRA_GEOMS = 400  # Places for decorations in a scene.


class Aim:
  """The point that a view looks at, low-pass filtered."""

  def __init__(self) -> None:
    """Starts at the robot's position in the first call of `follow`."""
    self._point: np.ndarray | None = None

  def follow(
    self, task: composer_task.Imitation, position: np.ndarray, view: View
  ) -> np.ndarray:
    """Advances by one control step; returns the point, world metres, [3].

    Args:
      task: of the robot.
      position: of the trunk, world metres, [3].
      view: scaled to the robot.
    """
    height = task.core.support(position[:1])[0] + view.height
    target = np.array([position[0] + view.ahead, position[1], height])
    if self._point is None or np.linalg.norm(target - self._point) > _JUMP:
      self._point = target
    share = 1 - np.exp(-task.control_timestep / _LAG)
    self._point = self._point + share * (target - self._point)
    return self._point


class Camera:
  """Renders a task's physics from one camera."""

  def __init__(
    self,
    physics: Any,
    task: composer_task.Imitation,
    name: str,
    width: int,
    height: int,
    ghost: bool = True,
  ):
    """Sets up the camera.

    Args:
      physics: of the task's environment, compiled after `prepare`.
      task: of the environment.
      name: one of `VIEWS`, or a camera of the model.
      width, height: pixels.
      ghost: whether the reference is drawn as a translucent trunk.

    Raises:
      ValueError: the camera is unknown.
    """
    self._physics, self._task, self._ghost = physics, task, ghost
    self._segments = set(physics.bind(task.root_entity.ground_geoms).element_id)
    self._trunk_size = task.config.robot.derived.trunk_size
    self._view: View | None = None
    if name in VIEWS:
      self._view = VIEWS[name].scaled(task.config.robot.size)
    self._aim = Aim()
    camera = -1 if self._view else _find(physics, name)
    self._camera = engine.Camera(
      physics,
      height,
      width,
      camera,
      max_geom=physics.model.ngeom + EXTRA_GEOMS,
      scene_callback=self._decorate,
    )

  def render(self) -> np.ndarray:
    """Returns the view, uint8 [height, width, 3]; advances by one step."""
    if self._view:
      self._follow(self._view)
    return self._camera.render().copy()

  def _follow(self, view: View) -> None:
    pose = self._camera._render_camera
    position = self._physics.data.qpos[:3].copy()
    pose.lookat[:] = self._aim.follow(self._task, position, view)
    pose.azimuth, pose.elevation = view.azimuth, view.elevation
    pose.distance = view.distance

  def _decorate(self, physics: Any, scene: Any) -> None:
    """Adds ground marks and the reference to the scene."""
    for geom in scene.geoms:
      is_segment = geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and (
        geom.objid in self._segments
      )
      if is_segment:  # The texture of the boxes moves with them.
        geom.matid, geom.rgba[:] = -1, TOP
    x = float(physics.data.qpos[0])
    boxes = list(ground_marks(self._task.root_entity.terrain, x))
    if self._ghost:
      position, rotation = reference_pose(self._task, x)
      boxes.append(Box(position, self._trunk_size, GHOST, rotation))
    add_boxes(scene, boxes)


def prepare(task: composer_task.Imitation, width: int, height: int) -> None:
  """Sets the size of the offscreen buffer; call it before the compilation."""
  root = task.root_entity.mjcf_model
  root.visual.get_children('global').set_attributes(
    offwidth=width, offheight=height
  )


def _find(physics: Any, name: str) -> int:
  """Returns the id of a camera, with or without the robot's prefix."""
  model = physics.model
  names = [model.id2name(i, 'camera') for i in range(model.ncam)]
  for candidate in (name, f'walker/{name}'):
    if candidate in names:
      return names.index(candidate)
  known = ', '.join(dict.fromkeys([*VIEWS, *names]))
  raise ValueError(f'Unknown camera {name!r}; cameras are {known}.')


def reference_pose(
  task: composer_task.Imitation, x: float
) -> tuple[np.ndarray, np.ndarray]:
  """Returns position and rotation of the reference for a trunk at `x`."""
  wanted = task.core.reference(np.array([x]))
  heading = transform.Rotation.from_euler(
    'z', task.core.tracker.state.heading[0]
  )
  local = transform.Rotation.from_quat(wanted.orientation[0], scalar_first=True)
  return wanted.position[0], (heading * local).as_matrix()


class Box(NamedTuple):
  """A box to draw: centre and half-sizes in metres, RGBA, rotation.

  A plane costs less than a flat box, and casts no shadow.
  """

  centre: np.ndarray
  halves: np.ndarray
  colour: Sequence[float]
  rotation: np.ndarray = np.eye(3)
  shape: mujoco.mjtGeom = mujoco.mjtGeom.mjGEOM_BOX


def ground_marks(terrain: terrain_lib.Terrain, x: float) -> Iterator[Box]:
  """Returns walls, edges and bands of a terrain near `x`."""
  deep = terrain_lib.BOX_THICKNESS / 2
  wide = terrain_lib.HALF_WIDTH
  for start, end, top in zip(*(field[0] for field in terrain), strict=True):
    if not np.isfinite(start):
      continue
    for edge, inside in ((start, 0.5), (end, -0.5)):
      wall = np.array([edge, 0, top - deep])
      yield Box(wall, np.array([_LIFT, wide, deep]), _WALL)
      strip = np.array([edge + inside * _EDGE_WIDTH, 0, top])
      halves = np.array([_EDGE_WIDTH / 2, wide, 2 * _LIFT])
      yield Box(strip, halves, EDGE)
    lefts = (
      2
      * _BAND_WIDTH
      * np.arange(
        np.floor((x - _REACH) / (2 * _BAND_WIDTH)),
        np.ceil((x + _REACH) / (2 * _BAND_WIDTH)),
      )
    )
    rights = np.minimum(lefts + _BAND_WIDTH, end)
    lefts = np.maximum(lefts, start)
    for left, right in zip(lefts, rights, strict=True):
      if right > left:
        centre = np.array([(left + right) / 2, 0, top + _LIFT])
        halves = np.array([(right - left) / 2, wide, 1.0])
        yield Box(centre, halves, _BAND, shape=mujoco.mjtGeom.mjGEOM_PLANE)


def segments(terrain: terrain_lib.Terrain) -> list[Box]:
  """Returns the boxes of a terrain, a batch of one."""
  centres, halves = terrain_lib.boxes(terrain)
  used = np.isfinite(terrain.starts[0])
  return [
    Box(centre, half, TOP)
    for centre, half in zip(centres[0][used], halves[0][used], strict=True)
  ]


def without_ground(robot: rollout.Robot) -> mujoco.MjModel:
  """Returns a copy of a robot's model with an invisible ground."""
  model = copy.deepcopy(robot.physics.model.ptr)
  ground = robot.physics.bind(robot.task.root_entity.ground_geoms).element_id
  model.geom_rgba[ground, 3] = 0.0
  return model


def add_boxes(scene: Any, boxes: Sequence[Box]) -> None:
  """Adds boxes to a scene, up to its capacity."""
  first = scene.ngeom
  scene.ngeom = min(first + len(boxes), scene.maxgeom)
  for geom, box in zip(scene.geoms[first:], boxes, strict=False):
    mujoco.mjv_initGeom(
      geom,
      box.shape,
      box.halves,
      box.centre,
      box.rotation.ravel(),
      np.array(box.colour, dtype=np.float32),
    )
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
