"""Picture of a robot's standing pose, with what its declaration names."""

import copy
import pathlib
from typing import Sequence

import mujoco
import numpy as np
import PIL.Image

from dmc_multimode.walkers import derivation
from dmc_multimode.walkers import robot as robot_lib

_WIDTH, _HEIGHT = 640, 480  # Pixels of each of the two views.
_AZIMUTHS = (150.0, 90.0)  # Degrees: from ahead on the left, from the right.
_ELEVATION, _DISTANCE = -12.0, 3.0  # Degrees; of the robot's radius.
_LIGHT = (0.5, 0.7)  # Ambient and diffuse: robots are often black.
_FLOOR = (0.75, 0.78, 0.82, 1.0)
_AXIS, _THICK = 0.2, 0.006  # Length and radius of axes, in heights.
_FOOT = (0.1, 0.8, 0.1, 0.35)  # Colour of the sites of the feet.
_COLLIDING = 3  # Group of geoms by custom; shown where nothing else is.
_COLOURS = ((1.0, 0.1, 0.1, 1.0), (0.1, 0.7, 0.1, 1.0), (0.2, 0.3, 1.0, 1.0))

_Frame = tuple[np.ndarray, np.ndarray]  # Origin [3] and rotation [9].


def write(
  robot: robot_lib.Robot, model: mujoco.MjModel, path: pathlib.Path
) -> None:
  """Writes a PNG file of a robot in its standing pose, in two views.

  The sites of the feet are green; axes of the trunk and of these sites are red
  (x), green (y) and blue (z).

  Args:
    robot: to draw.
    model: of the robot on the ground, see `trial.on_ground`; not changed.
    path: of the file.

  Raises:
    OSError: the file cannot be written.
  """
  model = copy.copy(model)
  derived = robot.derived
  model.vis.global_.offwidth = max(model.vis.global_.offwidth, _WIDTH)
  model.vis.global_.offheight = max(model.vis.global_.offheight, _HEIGHT)
  sites = [
    model.site(derivation.PREFIX + foot).id for foot in robot.declaration.feet
  ]
  model.site_rgba[sites], model.site_group[sites] = _FOOT, 0
  model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = _LIGHT
  model.geom_rgba[model.geom_bodyid == 0] = _FLOOR
  data = mujoco.MjData(model)
  data.qpos[2], data.qpos[7:] = derived.stand_height, derived.pose
  mujoco.mj_forward(model, data)
  trunk = model.body(derivation.PREFIX + robot.declaration.trunk).id
  frames = [(data.xpos[trunk], data.xmat[trunk])]
  frames += [(data.site_xpos[site], data.site_xmat[site]) for site in sites]
  with mujoco.Renderer(model, _HEIGHT, _WIDTH) as renderer:
    views = [
      _view(renderer, data, azimuth, derived.stand_height, frames)
      for azimuth in _AZIMUTHS
    ]
  PIL.Image.fromarray(np.hstack(views)).save(path)


def _view(
  renderer: mujoco.Renderer,
  data: mujoco.MjData,
  azimuth: float,
  height: float,
  frames: Sequence[_Frame],
) -> np.ndarray:
  """Returns a view of a robot of a height, metres, with axes, [H, W, 3]."""
  camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
  model = renderer.model
  robot = model.geom_bodyid > 0
  places, reaches = data.geom_xpos[robot], model.geom_rbound[robot]
  centre = (places.min(axis=0) + places.max(axis=0)) / 2
  radius = np.max(np.linalg.norm(places - centre, axis=1) + reaches)
  camera.lookat[:], camera.distance = centre, _DISTANCE * radius
  camera.azimuth, camera.elevation = azimuth, _ELEVATION
  option.geomgroup[_COLLIDING] = not (
    robot & (model.geom_group < _COLLIDING)
  ).any()
  renderer.update_scene(data, camera, option)
  for origin, rotation in frames:
    _add_axes(renderer.scene, origin, rotation, height)
  return renderer.render()


def _add_axes(
  scene: mujoco.MjvScene,
  origin: np.ndarray,
  rotation: np.ndarray,
  height: float,
) -> None:
  """Adds the axes of a frame to a scene."""
  for axis, colour in zip(rotation.reshape(3, 3).T, _COLOURS, strict=True):
    geom = scene.geoms[scene.ngeom]
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_initGeom(
      geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(colour)
    )
    end = origin + _AXIS * height * axis
    mujoco.mjv_connector(geom, kind, _THICK * height, origin, end)
    scene.ngeom += 1
