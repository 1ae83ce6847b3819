"""Joints of a declared robot for given places of its feet.

Inverse kinematics is solved once a robot, by mink of the extra `robots`, on a
grid of places of the feet below the trunk; in between the joints are
interpolated. All feet of a node of the grid are at once as far ahead of their
places in the standing pose, and as far below the trunk: a leg's joints depend
on its own foot alone.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from typing import Any
import warnings

import mujoco
import numpy as np

from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

# Shares of the standing height: of places ahead, and of heights of the trunk.
# Both have the standing pose for a node.
_AHEAD = np.linspace(-0.3, 0.3, 7)
_HEIGHTS = 1 + 0.075 * np.arange(-6, 6)
_REACHED = 0.02  # Share of the height by which a foot may miss its place.
_ITERATIONS, _SOLVER = 20, 'daqp'
_POSTURE, _FLAT, _DAMPING = 1e-3, 0.03, 1e-3  # Weights; 1 is that of places.


@dataclasses.dataclass(frozen=True, eq=False)
class Legs:
  """Joints over places of the feet, of a robot with F feet and J joints.

  Attributes:
    table: joints at the nodes, radians, [places ahead, heights, J].
    ahead: places of the feet ahead of the standing pose's, metres.
    heights: of the trunk over the feet, metres, that the legs reach.
    leg: index of the foot that a joint moves, [J]; -1 for none.
    pose: joints in the standing pose, radians, [J].
  """

  table: np.ndarray
  ahead: np.ndarray
  heights: np.ndarray
  leg: np.ndarray
  pose: np.ndarray

  def place(
    self,
    forward: np.ndarray,
    height: np.ndarray,
    forward_rate: np.ndarray,
    height_rate: np.ndarray,
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns the joints for given places of the feet.

    Args:
      forward: of the feet, from their places in the standing pose, metres,
        [N, F].
      height: of the trunk over the feet, metres, [N, F]; clipped to what the
        legs reach.
      forward_rate, height_rate: rates of these, m/s, [N, F].

    Returns:
      Joint angles, radians, and velocities, rad/s, [N, J] each; those of no leg
      are as in the standing pose.
    """
    i, u, along = _cell(self.ahead, forward)
    j, v, up = _cell(self.heights, height)
    angles = np.tile(self.pose, (len(forward), 1))
    rates = np.zeros_like(angles)
    for foot in range(forward.shape[1]):
      mine = np.flatnonzero(self.leg == foot)
      corner = lambda a, b, f=foot, m=mine: self.table[
        i[:, f] + a, j[:, f] + b
      ][:, m]
      w, h = u[:, foot, None], v[:, foot, None]
      near = (1 - h) * corner(0, 0) + h * corner(0, 1)
      far = (1 - h) * corner(1, 0) + h * corner(1, 1)
      low = (1 - w) * corner(0, 0) + w * corner(1, 0)
      high = (1 - w) * corner(0, 1) + w * corner(1, 1)
      angles[:, mine] = (1 - w) * near + w * far
      rates[:, mine] = (far - near) / along * forward_rate[:, foot, None] + (
        high - low
      ) / up * height_rate[:, foot, None]
    return angles, rates


def _cell(
  nodes: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
  """Returns the nodes below values, the shares of the next, and the spacing."""
  spacing = float(nodes[1] - nodes[0])
  place = np.clip((values - nodes[0]) / spacing, 0.0, len(nodes) - 1.0)
  below = np.minimum(place.astype(np.int64), len(nodes) - 2)
  return below, place - below, spacing


@functools.cache
def find(robot: robot_lib.Robot) -> Legs | None:
  """Returns the legs of a robot, solved at the first call.

  None, with a warning, where mink is not installed or the feet cannot be moved.
  """
  if importlib.util.find_spec('mink') is None:
    warnings.warn(
      f'mink is not installed: episodes of {robot.name} begin in its standing '
      'pose, not mid-stride; pip install "dmc_multimode[robots]".',
      stacklevel=2,
    )
    return None
  return _solve(robot)


def _solve(robot: robot_lib.Robot) -> Legs | None:
  """Solves the inverse kinematics on the grid, from the standing pose on."""
  height, pose = robot.stand_height, robot.derived.pose
  model = robot_walker.compile_fixed(robot_walker.RobotWalker(robot))
  solver = _Solver(model, robot)
  middle = int(np.argmin(np.abs(_AHEAD))), int(np.argmin(np.abs(_HEIGHTS - 1)))
  table = np.tile(pose, (len(_AHEAD), len(_HEIGHTS), 1))
  missed = np.zeros(table.shape[:2])
  # Each node begins with the solution of its neighbour towards the middle.
  order = sorted(
    np.ndindex(*missed.shape),
    key=lambda node: (abs(node[1] - middle[1]), abs(node[0] - middle[0])),
  )
  for node in order[1:]:
    back = np.sign(np.subtract(middle, node))
    near = node[0] + back[0], node[1] + (0 if back[0] else back[1])
    shift = np.array([_AHEAD[node[0]], 0.0, 1 - _HEIGHTS[node[1]]]) * height
    table[node], missed[node] = solver.solve(table[near], shift)
  # Heights about the standing one that the feet reach, also a little ahead.
  ahead = slice(middle[0] - 1, middle[0] + 2)
  fails = np.flatnonzero(missed[ahead].max(axis=0) > _REACHED * height)
  first = max(fails[fails < middle[1]], default=-1) + 1
  last = min(fails[fails > middle[1]], default=len(_HEIGHTS))
  kept = slice(first, last)
  if last - first < 2:
    warnings.warn(
      f'episodes of {robot.name} begin in its standing pose, not mid-stride: '
      'its feet cannot be moved up or down from there.',
      stacklevel=3,
    )
    return None
  heights = _HEIGHTS[kept] * height
  return Legs(table[:, kept], _AHEAD * height, heights, solver.leg, pose)


class _Solver:
  """Inverse kinematics of all feet, below a trunk that does not move."""

  def __init__(self, model: mujoco.MjModel, robot: robot_lib.Robot):
    """Prepares the tasks of mink."""
    import mink  # Late: of an extra.

    self._mink: Any = mink
    self._model, pose = model, robot.derived.pose
    self._configuration = mink.Configuration(model, pose)
    prefix = robot_walker.PREFIX
    self._sites = [prefix + foot for foot in robot.declaration.feet]
    flat = _FLAT if robot.num_feet == 2 else 0.0  # Four feet are points.
    self._feet = [
      mink.FrameTask(site, 'site', position_cost=1.0, orientation_cost=flat)
      for site in self._sites
    ]
    self._at = [self._transform(site) for site in self._sites]
    posture = mink.PostureTask(model, cost=_POSTURE)
    posture.set_target(pose)
    self._tasks = [*self._feet, posture]
    self._limits = [mink.ConfigurationLimit(model)]
    self.leg = np.full(robot.num_joints, -1)
    for foot, site in enumerate(self._sites):
      body = int(model.site_bodyid[model.site(site).id])
      while body:
        first = model.body_jntadr[body]
        self.leg[first : first + model.body_jntnum[body]] = foot
        body = int(model.body_parentid[body])

  def _transform(self, site: str) -> Any:
    return self._configuration.get_transform_frame_to_world(site, 'site')

  def solve(
    self, start: np.ndarray, shift: np.ndarray
  ) -> tuple[np.ndarray, float]:
    """Moves all feet from their places in the standing pose.

    Args:
      start: joints to begin with, radians, [J].
      shift: of the feet, metres, [3].

    Returns:
      Joints, radians, [J], and the distance by which the worst foot misses.
    """
    mink, dt = self._mink, 1.0
    self._configuration.update(start)
    for task, at in zip(self._feet, self._at, strict=True):
      goal = at.translation() + shift
      task.set_target(
        mink.SE3.from_rotation_and_translation(at.rotation(), goal)
      )
    for _ in range(_ITERATIONS):
      velocity = mink.solve_ik(
        self._configuration,
        self._tasks,
        dt,
        _SOLVER,
        damping=_DAMPING,
        limits=self._limits,
      )
      self._configuration.integrate_inplace(velocity, dt)
    missed = [
      self._transform(site).translation() - at.translation() - shift
      for site, at in zip(self._sites, self._at, strict=True)
    ]
    worst = float(np.linalg.norm(missed, axis=1).max())
    return self._configuration.q.copy(), worst
