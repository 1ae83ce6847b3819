"""The physics of B worlds of an imitation task, on `mujoco.batch`.

The model is compiled from the arena and walker of a Composer task. Each world
has a pool of mocap boxes, which are the segments of its ground.
"""

from typing import Any, Mapping, Sequence

import mujoco
from mujoco import batch as mujoco_batch
import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.walkers import derivation
from dmc_multimode.walkers import robot as robot_lib

# Fields of a model that depend on the size of a box.
_CONTROL = mujoco.mjtState.mjSTATE_CTRL
_SIZES = ('geom_size', 'geom_rbound', 'geom_aabb', 'bvh_aabb')


class MujocoWorlds:
  """B physics states of one model, stepped together on a thread pool.

  Attributes:
    model: shared by all worlds, but for the sizes of their boxes.
    batch: the engine.
    qpos, qvel: generalised positions [B, 7 + J] and velocities [B, 6 + J],
      views; writing to them sets the state.
    joint_limits: lower and upper, radians, [J, 2].
  """

  def __init__(
    self,
    model: mujoco.MjModel,
    arena: track_lib.Track,
    num_worlds: int,
    num_threads: int,
    disturbed: disturbances.Disturbances = disturbances.NOMINAL,
    robot: robot_lib.Robot | None = None,
  ):
    """Allocates the worlds.

    Args:
      model: result of `compile_model`.
      arena: of the task that the model was compiled from.
      num_worlds: B.
      num_threads: 0 takes every core.
      disturbed: the rows of these that are not nominal can be written.
      robot: of the task; the mini biped by default.
    """
    robot = robot_lib.find(robot)
    self.model = model
    self.batch = mujoco_batch.Batch(model, num_worlds, num_threads)
    self.qpos, self.qvel = self.batch.bind('qpos'), self.batch.bind('qvel')
    self._ctrl = self.batch.bind('ctrl')
    self._touch = self.batch.bind('sensordata')
    self._site_xpos = self.batch.bind('site_xpos')
    self._feet = model.sensor_objid[: robot.num_feet]
    # Under the sites of the feet, world metres.
    self._soles = np.zeros((robot.num_feet, 3))
    self._soles[:, 2] = robot.derived.sole_depth
    self._boxes = [
      model.geom(geom.full_identifier).id for geom in arena.ground_geoms
    ]
    bodies = model.geom_bodyid[self._boxes]
    self._mocaps = model.body_mocapid[bodies]
    self._mocap_pos = self.batch.bind('mocap_pos')
    self._bvhs = model.body_bvhadr[bodies]
    self._sizes = {name: self.batch.expand(name) for name in _SIZES}
    self._recorded: dict[str, np.ndarray] = {}
    self._records: dict[str, np.ndarray] = {}
    self.joint_limits = model.jnt_range[1:]
    self._body = disturbances.Body(
      model,
      disturbed,
      self.batch.expand,
      model.body(derivation.PREFIX + robot.declaration.trunk).id,
    )

  @property
  def state(self) -> np.ndarray:
    """Full physics state of every world, [B, S], a view."""
    return self.batch.state

  def reset(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """Puts the worlds `ids` into initial states, [N, 7 + J] and [N, 6 + J]."""
    self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
    self.qpos[ids], self.qvel[ids] = qpos, qvel

  def step(
    self, targets: np.ndarray, moving: np.ndarray, num: int
  ) -> np.ndarray:
    """Steps the physics.

    Args:
      targets: of the joints, radians, [B, J], or for each physics step,
        [B, num, J].
      moving: whether each world is stepped, [B].
      num: physics steps.

    Returns:
      Indices of the worlds that diverged, [N].
    """
    try:
      if targets.ndim == 2 and not self._recorded:
        self._ctrl[:] = targets
        self.batch.step(ids=moving, nstep=num)
      else:
        self._roll_out(targets, moving, num)
    except mujoco_batch.SimulationError as error:
      return np.asarray(error.ids)
    return np.zeros(0, dtype=np.int64)

  def record(self, fields: Sequence[str]) -> None:
    """Records fields of MjData after every physics step from now on.

    The physics stays the same to the bit. As after any step of MuJoCo, `qpos`
    and `qvel` are those at its end, and what is derived from them, such as
    forces and places of sites, that at its beginning.

    Args:
      fields: names; none ends the recording.
    """
    data = mujoco.MjData(self.model)
    self._recorded = {name: np.array(getattr(data, name)) for name in fields}

  @property
  def records(self) -> Mapping[str, np.ndarray]:
    """Records of the last control step by field, [B, physics steps, ...].

    Those of a world that was not stepped are zero.
    """
    return self._records

  def _roll_out(
    self, targets: np.ndarray, moving: np.ndarray, num: int
  ) -> None:
    """Steps with targets for each physics step, and records; see `step`."""

    def zeros(count: int) -> dict[str, np.ndarray]:
      return {
        name: np.zeros((count, num, *field.shape), field.dtype)
        for name, field in self._recorded.items()
      }

    # Filled in place, so that a world that diverges takes no record away.
    rows = zeros(int(np.count_nonzero(moving)))
    if targets.ndim == 2:
      targets = np.repeat(targets[:, None], num, axis=1)
    controls = targets if moving.all() else targets[moving]
    try:
      self.batch.rollout(num, controls, _CONTROL, [*rows], moving, rows)
    finally:
      self._records = rows if moving.all() else zeros(len(moving))
      for name, row in rows.items():
        self._records[name][moving] = row

  def move_boxes(self, ids: np.ndarray, terrain: terrain_lib.Terrain) -> None:
    """Moves the boxes of the worlds `ids` to the segments of N terrains."""
    if not len(ids):
      return
    centres, halves = terrain_lib.boxes(terrain)
    self._mocap_pos[np.ix_(ids, self._mocaps)] = centres
    rows = {name: field[ids] for name, field in self._sizes.items()}
    track_lib.write_sizes(halves, np.array(self._boxes), self._bvhs, **rows)
    for name, field in self._sizes.items():
      field[ids] = rows[name]

  def write_body(
    self, ids: np.ndarray, values: Mapping[str, np.ndarray]
  ) -> None:
    """Writes disturbances into the models of `ids`; see `disturbances.Body`."""
    self._body.write(ids, values)
    if self._body.changes_mass:
      self.batch.set_const(ids)

  def touch(self) -> np.ndarray:
    """Returns the forces on the feet, newtons, [B, F]."""
    return self._touch

  def soles(self) -> np.ndarray:
    """Returns world positions of the soles, metres, [B, F, 3]."""
    return self._site_xpos[:, self._feet] - self._soles


def make_spec(task: composer_task.Imitation) -> mujoco.MjSpec:
  """Returns the specification of the task's model, with foot sensors only."""
  root = task.root_entity.mjcf_model
  spec = mujoco.MjSpec.from_string(
    root.to_xml_string(), assets=root.get_assets()
  )
  kept = {sensor.full_identifier for sensor in task.walker.foot_sensors}
  for sensor in list(spec.sensors):
    if sensor.name not in kept:
      spec.delete(sensor)
  return spec


def compile_model(task: composer_task.Imitation) -> mujoco.MjModel:
  """Compiles the task's model without visual elements.

  Visual geoms, cameras, lights and all sensors but those of the feet cost a
  fifth of every physics step and change none.
  """
  spec = make_spec(task)
  sites = {sensor.objname for sensor in spec.sensors}
  unseen = [site for site in spec.sites if site.name not in sites]
  unseen += [
    geom
    for geom in spec.geoms
    if not geom.contype | geom.conaffinity and not _weighs(geom)
  ]
  for element in [*unseen, *spec.cameras, *spec.lights]:
    spec.delete(element)
  model = spec.compile()
  feet = [
    model.sensor_adr[model.sensor(sensor.full_identifier).id]
    for sensor in task.walker.foot_sensors
  ]
  if feet != list(range(len(feet))):
    raise ValueError('The foot sensors are not where they are expected.')
  return model


def _weighs(geom: Any) -> bool:
  """Returns whether a geom gives its body mass, which has no inertia else."""
  if geom.parent.explicitinertial:
    return False
  return bool(geom.mass > 0 if np.isfinite(geom.mass) else geom.density > 0)
