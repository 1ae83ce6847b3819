"""Measures energy, torques, and how deep feet are in the ground.

    python -m benchmarks.reliability.fault_physics

- A robot without torques that is dropped never has more energy (kinetic and
  potential, of gravity) than it began with. Contacts are springs, whose energy
  MuJoCo does not count: while they push the robot off, what is counted rises
  again, and that is shown, too.
- On every arena, 10,000 control steps of random actions: the largest torque of
  a servo, and how deep a corner of a foot ever was in a box of the ground.
  Episodes end as they do in the task. `full` actions are uniform over the range
  of the servos, half a turn to either side, which asks for all of their torque
  all of the time and whips the feet about at 60 rad/s; `standing` ones are
  normal around standing with 0.2 rad, about what a training begins with;
  `policy` is the shipped pi2 with the noise that it explored with at its end.
"""

import itertools
from typing import Any, Callable, NamedTuple

import mujoco
import numpy as np

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.experiments import config as run_config
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.utils import constants

FULL, STANDING, POLICY = ACTIONS = ('full', 'standing', 'policy')
USERS_TIMESTEP = constants.PHYSICS_TIMESTEP
TRAINING_TIMESTEP = run_config.RunConfig().task.physics_timestep
_POLICY = 'pi2'
_STANDING_STD = 0.2  # Radians.
_SEGMENTS = 4  # Of a flat arena, for the steps that modes call for.
_CORNERS = np.array(
  [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
)


_DROPS = (
  'timestep s=timestep | drops:d | energy J=start:.1f | '
  'most over it=excess:.4f | most rebound=rebound:.4f'
)
_BODIES = (
  'actions, timestep s, arena=name | steps:,d | episodes:,d | diverged:d | '
  'torque Nm=torque:.3f | deepest mm=deepest:.2f | median mm=median:.2f | '
  'over 10 mm=deep:,d'
)


class Drop(NamedTuple):
  """Joules of a passive drop: at first, and the most over that and the least.

  `start` is over that of the robot at rest on the ground; `excess` is negative
  if energy only falls; `rebound` is the most over the least before.
  """

  start: float
  excess: float
  rebound: float


class Bodies(NamedTuple):
  """Counts steps and ends; the largest torque, Nm; and depths of feet.

  `depth` is that of the deepest corner of a foot in the ground, metres, each
  step's and world's with a foot in it, [N].
  """

  steps: int
  episodes: int
  diverged: int
  torque: float
  depth: np.ndarray


def _task(arena: str, timestep: float) -> composer_task.Imitation:
  made = track.make(arena, _SEGMENTS) if arena == 'flat' else track.make(arena)
  policy = pretrained.load(_POLICY)
  return multimode_biped.make_task(
    policy.mode_set,
    arena=made,
    config=task_config.ImitationConfig(
      physics_timestep=timestep,
      extra_observations=policy.config.extra_observations,
    ),
  )


def drop(timestep: float, seed: int, height: float = 0.5) -> Drop:
  """Drops a robot, turned and bent at random, so high over its crouch, m."""
  spec = mujoco_worlds.make_spec(_task('flat', timestep))
  ground = spec.geom('segment_0')
  ground.size = [20.0, *ground.size[1:]]
  model = spec.compile()
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
  model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
  data, random = mujoco.MjData(model), np.random.RandomState(seed)
  data.mocap_pos[0] = [0.0, 0.0, -terrain_lib.BOX_THICKNESS / 2]
  data.qpos[2] = constants.STAND_HEIGHT + height
  data.qpos[3:7] = random.standard_normal(4)
  data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
  data.qpos[7:] = random.uniform(-0.2, 0.2, model.nq - 7)
  energies = []
  for _ in range(round(3.0 / timestep)):
    mujoco.mj_step(model, data)
    energies.append(float(data.energy.sum()))
  values = np.array(energies)
  least = np.minimum.accumulate(values)
  return Drop(
    values[0] - values[-1],
    float((values - values[0]).max()),
    float((values - least).max()),
  )


def _depths(
  worlds: batched_env.BatchedImitation,
  terrain: terrain_lib.Terrain,
  feet: list[int],
  bind: Any,
) -> np.ndarray:
  """Returns how deep the deepest corner of a foot is in a box, metres, [B]."""
  halves = worlds.physics.model.geom_size[feet]
  offsets = _CORNERS[None] * halves[:, None]  # [2, 8, 3]
  rotation = bind['xmat'][:, feet].reshape(-1, len(feet), 3, 3)
  corners = np.einsum('bfij,fcj->bfci', rotation, offsets)
  corners += bind['xpos'][:, feet, None]
  corners = corners.reshape(len(rotation), -1, 3)
  centres, boxes = terrain_lib.boxes(terrain)
  # Of a point in a box: to the nearest of the faces that it can have come by.
  inside = boxes[:, None] - np.abs(corners[:, :, None] - centres[:, None])
  top = (centres + boxes)[:, None, :, 2] - corners[:, :, None, 2]
  depth = np.minimum(np.minimum(inside[..., 0], inside[..., 1]), top)
  depth = np.where((inside > 0).all(axis=-1), depth, 0.0)
  return depth.max(axis=(1, 2))


def _actor(
  actions: str, worlds: batched_env.BatchedImitation, seed: int
) -> Callable[[np.ndarray], np.ndarray]:
  """Returns what maps observations [B, D] to actions [B, 10]; see above."""
  spec, random = worlds.action_spec(), np.random.RandomState(seed)
  shape = (worlds.num_worlds, *spec.shape)
  if actions == FULL:
    return lambda _: random.uniform(spec.minimum, spec.maximum, shape)
  noise = lambda std: std * random.standard_normal(shape)
  if actions == STANDING:
    return lambda _: worlds.standing_action() + noise(_STANDING_STD)
  policy = pretrained.load(_POLICY)
  std = policy.network.std.detach().numpy()
  return lambda seen: policy.select_action(seen) + noise(std)


def random_actions(
  arena: str,
  timestep: float,
  actions: str,
  steps: int = 10_000,
  num_worlds: int = 100,
  seed: int = 0,
) -> Bodies:
  """Acts on an arena by one of ACTIONS; steps are of all worlds together."""
  task = _task(arena, timestep)
  worlds = batched_env.BatchedImitation(task, num_worlds, seed, 1)
  names = {name: f'geom_{name}' for name in ('xpos', 'xmat')}
  bind = {key: worlds.physics.batch.bind(name) for key, name in names.items()}
  force = worlds.physics.batch.bind('actuator_force')
  feet = [
    worlds.physics.model.geom(f'walker/{s}_foot').id for s in ('left', 'right')
  ]
  act, seen = _actor(actions, worlds, seed), worlds.reset()
  torque, depths, episodes, diverged = 0.0, [], 0, 0
  for _ in range(-(-steps // num_worlds)):
    before = terrain_lib.Terrain(*(x.copy() for x in worlds.core.terrain))
    step = worlds.step(act(seen))
    seen = step.observation
    invalid = step.results.causes == worlds.invalid_cause
    episodes, diverged = episodes + len(invalid), diverged + int(invalid.sum())
    # What began anew was put somewhere, and not there by the physics.
    mine = np.flatnonzero(~step.last)
    torque = max(torque, float(np.abs(force[mine]).max(initial=0.0)))
    found = _depths(worlds, before, feet, bind)[mine]
    depths.append(found[found > 0])
  count = num_worlds * -(-steps // num_worlds)
  return Bodies(count, episodes, diverged, torque, np.concatenate(depths))


def _drops(timestep: float) -> common.Row:
  drops = [drop(timestep, seed) for seed in range(20)]
  return {
    'timestep': f'{timestep:g}',
    'drops': len(drops),
    'start': np.mean([d.start for d in drops]),
    'excess': max(d.excess for d in drops),
    'rebound': max(d.rebound for d in drops),
  }


def _bodies(actions: str, timestep: float, arena: str) -> common.Row:
  found = random_actions(arena, timestep, actions)
  depth = 1e3 * np.append(found.depth, 0.0)
  return {
    **found._asdict(),
    'name': f'{actions} {timestep:g} {arena}',
    'deepest': depth.max(),
    'median': np.median(depth),
    'deep': (depth > 10).sum(),
  }


def main() -> None:
  """Prints both tables."""
  timesteps = (USERS_TIMESTEP, TRAINING_TIMESTEP)
  common.print_table(_DROPS, map(_drops, timesteps))
  cases = itertools.product(ACTIONS, timesteps, layouts.NAMES)
  common.print_table(_BODIES, itertools.starmap(_bodies, cases))


if __name__ == '__main__':
  main()
