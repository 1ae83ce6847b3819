"""Reach of the geoms of a model."""

import mujoco
import numpy as np


def collides(model: mujoco.MjModel) -> np.ndarray:
  """Returns whether each geom touches others, [G]."""
  return (model.geom_contype | model.geom_conaffinity) != 0


def farthest(
  model: mujoco.MjModel, data: mujoco.MjData, geom: int, way: np.ndarray
) -> float:
  """Returns how far a geom reaches along a direction, world metres.

  Args:
    model, data: of the robot, after `mj_kinematics`.
    geom: index.
    way: unit vector in the world, [3].

  Raises:
    ValueError: the geom is no solid body.
  """
  kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
  local = way @ data.geom_xmat[geom].reshape(3, 3)
  kinds = mujoco.mjtGeom
  if kind == kinds.mjGEOM_SPHERE:
    reach = size[0]
  elif kind == kinds.mjGEOM_CAPSULE:
    reach = size[0] + size[1] * abs(local[2])
  elif kind == kinds.mjGEOM_CYLINDER:
    reach = size[0] * np.hypot(local[0], local[1]) + size[1] * abs(local[2])
  elif kind == kinds.mjGEOM_ELLIPSOID:
    reach = np.linalg.norm(size * local)
  elif kind == kinds.mjGEOM_BOX:
    reach = np.abs(local) @ size
  elif kind == kinds.mjGEOM_MESH:
    mesh = model.geom_dataid[geom]
    start = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    reach = np.max(vertices @ local)
  else:
    name = model.geom(geom).name.rpartition('/')[2]
    raise ValueError(f'the geom {name!r} is no solid body.')
  return float(way @ data.geom_xpos[geom] + reach)


def bounds(
  model: mujoco.MjModel,
  data: mujoco.MjData,
  geoms: list[int],
  axes: np.ndarray | None = None,
) -> np.ndarray:
  """Returns the bounds of geoms along axes.

  Args:
    model, data: of the robot, after `mj_kinematics`.
    geoms: indices.
    axes: unit vectors in the world, [3, 3]; those of the world by default.

  Returns:
    Least and greatest distances from the world's origin, metres, [2, 3].
  """
  axes = np.eye(3) if axes is None else axes
  reach = lambda axis: max(farthest(model, data, g, axis) for g in geoms)
  return np.array(
    [[-reach(-axis) for axis in axes], [reach(axis) for axis in axes]]
  )
