"""Cases that make the task of `BatchedImitation` harder, each apart."""

import dataclasses
from typing import Mapping

import mujoco
import numpy as np

from dmc_multimode.evaluation import evaluator
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.utils import schedule as schedules

_PUSH_PERIOD = 1.0  # Seconds.


@dataclasses.dataclass(frozen=True)
class Case:
  """One way to make it harder.

  Attributes:
    physics_timestep: seconds; None for that of the training.
    edge: how much farther the edges of blocks are, metres.
    mass: factor of all masses and inertias.
    friction: factor of all sliding friction.
    push: change of the trunk's velocity once a second, m/s.
    obstacles: share of the commands that meet an obstacle, see
      `suite.imitation.obstacles`.
  """

  physics_timestep: float | None = None
  edge: float = 0.0
  mass: float = 1.0
  friction: float = 1.0
  push: float = 0.0
  obstacles: float = 0.0


CASES: Mapping[str, Case] = {
  'as trained': Case(),
  '5 ms': Case(physics_timestep=0.005),
  '2 ms': Case(physics_timestep=0.002),
  '1 ms': Case(physics_timestep=0.001),
  'edge 6 cm nearer': Case(edge=-0.06),
  'edge 6 cm farther': Case(edge=0.06),
  'mass -10 %': Case(mass=0.9),
  'mass +10 %': Case(mass=1.1),
  'friction -10 %': Case(friction=0.9),
  'friction +10 %': Case(friction=1.1),
  'pushes': Case(push=0.3),
  'obstacles': Case(obstacles=1.0),
}


class Worlds(batched_env.BatchedImitation):
  """BatchedImitation in a `Case`; never begins anew by itself."""

  def __init__(
    self,
    case: Case,
    policy: evaluator.Policy,
    schedule: schedule_lib.ModeSchedule,
    config: task_config.ImitationConfig,
    seed: int,
  ):
    """Compiles the task of `policy`, one world a row of `schedule`."""
    self._case = case
    self._pushes = np.random.RandomState(seed)
    self._steps = 0
    task = multimode_biped.make_task(
      dataclasses.replace(
        policy.mode_set,
        motions=tuple(
          _with_edge(motion, case.edge) for motion in policy.mode_set.motions
        ),
      ),
      episodes.ScheduledEpisodes(schedule),
      config=dataclasses.replace(
        config,
        events=dataclasses.replace(
          config.events, obstacles=schedules.constant(case.obstacles)
        ),
      ),
    )
    model = mujoco_worlds.compile_model(task)
    model.body_mass *= case.mass
    model.body_inertia *= case.mass
    model.geom_friction[:, 0] *= case.friction
    mujoco.mj_setConst(model, mujoco.MjData(model))
    super().__init__(task, len(schedule), seed, auto_reset=False, model=model)

  def step(self, actions: np.ndarray) -> batched_env.BatchedTimeStep:
    """Pushes if it is time to, and steps."""
    self._steps += 1
    if not self._steps % round(_PUSH_PERIOD / self.control_timestep):
      angle = self._pushes.uniform(0, 2 * np.pi, self.num_worlds)
      direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
      self.qvel[:, :2] += self._case.push * direction
    return super().step(actions)


def _with_edge(
  motion: motion_lib.ReferenceMotion, offset: float
) -> motion_lib.ReferenceMotion:
  """Returns the mode with the edge of its step elsewhere."""
  if motion.ledge is None:
    return motion
  edge = motion.ledge.edge + offset
  return dataclasses.replace(
    motion, ledge=motion_lib.Ledge(edge, motion.ledge.height)
  )
