"""Motion metrics of a policy's modes, from records of every physics step."""

import numpy as np

from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import episodes as evaluation_episodes
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.walkers import derivation

_FIELDS = ('qpos', 'qvel', 'actuator_force', 'sensordata')
_MOST_EPISODES = 16  # Of a mode: records are large.
_LONG = 60.0  # Seconds.


class Recorder:
  """Records worlds; makes traces of their episodes."""

  def __call__(
    self, worlds: batched_env.BatchedImitation
  ) -> evaluation_episodes.Measure:
    """Begins to record `worlds`; returns the records of a control step.

    By field of MjData, float32 [B, physics steps, ...], `action`, joint targets
    in force at the end, [B, J], and the segments of the ground, [B, S].
    """
    model, core = worlds.physics.model, worlds.core
    robot, prefix = worlds.config.robot, derivation.PREFIX
    feet = [model.site(prefix + foot).id for foot in robot.declaration.feet]
    worlds.physics.record([*_FIELDS, 'ctrl', 'site_xpos', 'site_xmat'])
    self._config = worlds.config
    trunk = model.body(prefix + robot.declaration.trunk).id
    self._weight = -model.opt.gravity[2] * model.body_subtreemass[trunk]
    self._limits = np.stack(
      [model.joint(prefix + name).range for name in robot.joints], axis=1
    )

    def measure() -> dict[str, np.ndarray]:
      records = worlds.physics.records
      return {
        **{name: records[name].astype(np.float32) for name in _FIELDS},
        'action': records['ctrl'][:, -1],
        'feet': records['site_xpos'][:, :, feet].astype(np.float32),
        'turns': records['site_xmat'][:, :, feet].astype(np.float32),
        **{key: field.copy() for key, field in core.terrain._asdict().items()},
      }

    return measure

  def traces(
    self, found: evaluation_episodes.Episodes, travels: bool
  ) -> list[motion_metrics.MotionTrace]:
    """Returns the traces of recorded episodes of one mode."""
    return [
      self._trace({k: v[:length, i] for k, v in found.traces.items()}, travels)
      for i, length in enumerate(found.lengths)
    ]

  def _trace(
    self, steps: dict[str, np.ndarray], travels: bool
  ) -> motion_metrics.MotionTrace:
    """Returns the trace of an episode's records, [T, physics steps, ...]."""
    flat = {key: v.reshape(-1, *v.shape[2:]) for key, v in steps.items()}
    robot = self._config.robot
    corners = _corners(flat['feet'], flat['turns'], robot.derived)
    ground = [
      np.repeat(steps[key], self._config.substeps, axis=0)
      for key in ('starts', 'ends', 'tops')
    ]
    return motion_metrics.MotionTrace(
      actions=steps['action'],
      joints=flat['qpos'][:, 7:],
      joint_speeds=flat['qvel'][:, 6:],
      torques=flat['actuator_force'],
      loads=flat['sensordata'],
      corners=corners,
      depths=depths(corners, *ground),
      trunk=flat['qpos'][:, :3],
      limits=self._limits,
      weight=float(self._weight),
      travels=travels,
      control_timestep=self._config.control_timestep,
      physics_timestep=self._config.physics_timestep,
      pairs=robot.derived.mirror.pairs,
      hip_yaws=motion_metrics.HIP_YAWS if robot.is_mini_biped else (),
    )


def _corners(
  feet: np.ndarray, turns: np.ndarray, derived: derivation.Derived
) -> np.ndarray:
  """Returns the corners of soles, world metres, [N, F, C, 3].

  Args:
    feet: places of their sites, world metres, [N, F, 3].
    turns: orientations of these, [N, F, 9].
    derived: of the robot.
  """
  if feet.shape[1] > 2:  # Points, however they are turned.
    under = derived.sole_depth[:, None] * np.array([0.0, 0.0, 1.0])
    return (feet - under)[:, :, None]
  axes = turns.reshape(*feet.shape, 3)
  return feet[:, :, None] + np.einsum(
    'nfij,fcj->nfci', axes, derived.sole_corners
  )


def depths(
  points: np.ndarray, starts: np.ndarray, ends: np.ndarray, tops: np.ndarray
) -> np.ndarray:
  """Returns how deep points are in the ground, metres, [N, ...].

  The way to the nearest face: a toe against the wall of a block is as deep as
  it is behind the wall. Negative outside, where it is a bound of the distance.

  Args:
    points: world positions, metres, [N, ..., 3].
    starts, ends, tops: of the ground's segments at the time of each point, see
      `terrain.Terrain`, [N, S].
  """
  x, z = points[..., 0], points[..., 2]
  shape = (-1, *(1,) * (x.ndim - 1))
  found = np.full(x.shape, -np.inf)
  for start, end, top in zip(starts.T, ends.T, tops.T, strict=True):
    inside = [top.reshape(shape) - z, x - start.reshape(shape)]
    inside.append(end.reshape(shape) - x)
    found = np.maximum(found, np.min(inside, axis=0))
  return found


def evaluate(
  evaluator: evaluator_lib.Evaluator, episodes: int, clock_rate: float = 1.0
) -> dict[str, dict[str, float | None]]:
  """Returns the motion metrics of every mode by name.

  An episode takes 5.1 s, and only a fall ends it: a robot that has lost its
  reference moves on.

  Args:
    evaluator: of the policy.
    episodes: of each mode; 16 at most are run.
    clock_rate: of the modes.
  """
  bank, recorder = evaluator.mode_set.bank, Recorder()
  episodes = min(episodes, _MOST_EPISODES)
  free = evaluator.changed(
    time_limit=acceptance.DURATION,
    limits=terminations.falls_alone(evaluator.config.limits),
  )
  modes = np.repeat(np.arange(len(bank)), episodes)
  found = free.run(schedule_lib.single(modes, clock_rate), 'motion', recorder)
  drifts = _drifts(free, -(-episodes // 4), recorder)
  result = {}
  for i, name in enumerate(bank.names):
    travels = bool(bank.displacements[i, :2].any())
    mine = found.rows(np.flatnonzero(modes == i))
    traces = recorder.traces(mine, travels)
    result[name] = {
      metric.name: motion_metrics.value(metric, traces)
      for metric in motion_metrics.METRICS
    }
    result[name][motion_metrics.DRIFT.name] = drifts.get(i)
  return result


def _drifts(
  free: evaluator_lib.Evaluator, episodes: int, recorder: Recorder
) -> dict[int, float | None]:
  """Returns the drift in 60 s by steady mode, None where a robot fell."""
  motions = free.mode_set.motions
  steady = [
    i for i, motion in enumerate(motions) if motion.kind == motion_lib.STEADY
  ]
  result: dict[int, float | None] = {}
  for i in steady:
    found = free.changed(time_limit=_LONG).run(
      schedule_lib.single(np.full(episodes, i)), 'drift', recorder
    )
    traces = recorder.traces(found, travels=False)
    drift = motion_metrics.value(motion_metrics.DRIFT, traces)
    result[i] = drift if found.survived.all() else None
  return result
