"""Roll-outs of references alone: the ghost goes where keyframes put it.

There is no policy, and no robot to be seen: it is there for the camera to
follow, carried along.
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.viewer import camera
from dmc_multimode.viewer import rollout

_WORLD = np.zeros(1, dtype=np.int64)


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
  """Modes in the place of a policy.

  Attributes:
    mode_set: the modes.
    config: of the task, with the robot.
  """

  mode_set: mode_set_lib.ModeSet
  config: task_config.ImitationConfig


class Carried(rollout.Robot):
  """A robot that is carried along its reference, and not drawn."""

  def start(self) -> Any:
    """See `Robot.start`."""
    physics = super().start()
    geoms = self.task.walker.mjcf_model.find_all('geom')
    physics.model.geom_rgba[physics.bind(geoms).element_id, 3] = 0.0
    return physics

  def reset(self, anew: bool = False) -> None:
    """See `Robot.reset`."""
    super().reset(anew)
    self._carry()
    self._path.clear()
    self._path.append(self.position)

  def step(self) -> rollout.Step:
    """Advances the clock by a control step; nothing is scored."""
    core, state = self.task.core, self.task.core.tracker.state
    command, floor = int(state.knot[0]), float(state.anchor[0, 2])
    core.tracker.advance()
    self._carry()
    random = self._environment.random_state
    qpos, qvel = self.physics.data.qpos, self.physics.data.qvel
    if len(core.switch(qpos[None].copy(), qvel[None].copy(), random)):
      self.task.set_terrain(self.physics, core.terrain.rows(_WORLD))
    self._carry()
    self._path.append(self.position)
    period = self.task.config.control_timestep
    way = np.linalg.norm((self._path[-1] - self._path[0])[:2])
    return self.here()._replace(
      command=command,
      time=int(state.step[0]) * period,
      rise=float(self.position[2] - floor),
      speed=float(way / ((len(self._path) - 1) * period)),
      reward=np.nan,
      cause='',
    )

  def _carry(self) -> None:
    """Puts the trunk where the reference is, at rest."""
    data, ahead = self.physics.data, self.task.core.tracker.reference()
    position, rotation = camera.reference_pose(
      self.task, float(ahead.position[0, 0])
    )
    data.qpos[:3], data.qvel[:] = position, 0.0
    mujoco.mju_mat2Quat(data.qpos[3:7], rotation.ravel())
    self.physics.forward()


class ReferenceRollout(rollout.Rollout):
  """Roll-out of a schedule of references; `start`, then `steps`, once."""

  _robot_type = Carried

  def __init__(self, reference: Reference, config: rollout.RolloutConfig):
    """Builds the environment; see `Rollout`."""
    policy: Any = reference  # Of which the modes and the task are all it takes.
    super().__init__(policy, config)
