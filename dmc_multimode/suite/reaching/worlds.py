"""Reaching by mode commands in many worlds at once: one step is one knot.

    worlds = dmm.make_worlds('reach_parkour', num_worlds=256)
    observation = worlds.reset()
    step = worlds.step(modes)  # One mode index a world.

Observations are those of the `reach_*` tasks, flat, and parts of them are named
by `layout`. Every world has its own track, drawn anew for every episode.
"""

import dataclasses
import math
from typing import Any, Mapping, NamedTuple

from dm_env import specs
import numpy as np
from numpy import typing as npt

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.utils import arrays


class ReachingStep(NamedTuple):
  """One knot of B worlds.

  Attributes:
    reward: sum of exp(-|goal - p|) over the knot's control steps, [B].
    discount: 0 where the robot has fallen, 1 elsewhere, [B].
    last: whether the episode ended, by a fall or with its last knot, [B].
    observation: for the next command; where `last`, the first of the next
      episode, float32 [B, D].
    final_observation: the last ones of the N episodes that ended, in the order
      of their worlds, float32 [N, D].
    reached: whether the robot stands at its goal after the knot, [B].
  """

  reward: np.ndarray
  discount: np.ndarray
  last: np.ndarray
  observation: np.ndarray
  final_observation: np.ndarray
  reached: np.ndarray


class ReachingWorlds:
  """B worlds of a `reach_*` task.

  Attributes:
    num_worlds: B.
    mode_names: names of the modes, in the order of their indices.
    layout: (name, size) of every part of an observation, in order.
    knot_steps: control steps of a knot.
  """

  def __init__(
    self,
    policy: reaching.Policy,
    track: str,
    num_worlds: int,
    seed: int = 0,
    num_threads: int = 0,
    sizes: Mapping[str, float] | None = None,
    disturbed: events_lib.TrainingEvents = events_lib.NONE,
    scan_errors: sensing.ScanErrors = sensing.EXACT,
    auto_reset: bool = True,
    physics_timestep: float | None = None,
    knot_duration: float | None = None,
  ):
    """Compiles the worlds; call `reset` before `step`.

    Args:
      policy: turns modes into motion.
      track: name of the track.
      num_worlds: B.
      seed: of all randomness.
      num_threads: of the physics; 0 takes every core.
      sizes: of the track, metres, where they are not its defaults.
      disturbed: disturbances and pushes; see `events.fixed`.
      scan_errors: of the observed ground.
      auto_reset: begins a new episode where one has ended. Otherwise a robot
        whose episode is over is not moved, and its steps count for nothing.
      physics_timestep: seconds; the product's by default.
      knot_duration: seconds from command to command; the track's by default.

    Raises:
      ValueError: the track or a size is unknown, or a knot is not a whole
        number of control steps.
    """
    self._policy, self._track = policy, track
    self.num_worlds, self._auto_reset = num_worlds, auto_reset
    self._scan_errors, self._knot_duration = scan_errors, knot_duration
    arena = track_lib.make(track, sizes=sizes)
    drawn = arena.generate(np.random.RandomState(seed))
    first = self._problem(drawn)
    config = reaching.task_config(policy, first, disturbed)
    config = dataclasses.replace(config, time_limit=math.inf)
    if physics_timestep is not None:
      config = dataclasses.replace(config, physics_timestep=physics_timestep)
    self._worlds = batched_env.BatchedImitation(
      multimode_biped.make_task(
        policy.mode_set,
        episodes.ScheduledEpisodes(schedule_lib.single(np.zeros(1))),
        arena,
        config,
      ),
      num_worlds,
      seed,
      num_threads,
      auto_reset=False,
    )
    self.knot_steps = reaching.knot_steps(first, config.control_timestep)
    self.mode_names = policy.mode_set.names
    self._observer = sensing.Observer(policy, self._worlds.core, scan_errors)
    self.layout = self._observer.layout
    self._random_state = np.random.RandomState(seed + 1)
    self.goal = np.zeros((num_worlds, 3))
    self._knots = np.ones(num_worlds, dtype=np.int64)
    self._knot = np.zeros(num_worlds, dtype=np.int64)
    self._over = np.ones(num_worlds, dtype=bool)
    self._shift = np.zeros(num_worlds)
    self._seen = np.zeros((num_worlds, 0), dtype=np.float32)
    self._observation = np.zeros(
      (num_worlds, self._observer.size), dtype=np.float32
    )

  @property
  def steps(self) -> int:
    """Control steps so far, summed over all worlds."""
    return self._worlds.steps

  @property
  def control_timestep(self) -> float:
    """Seconds of a control step."""
    return self._worlds.control_timestep

  @property
  def position(self) -> np.ndarray:
    """Positions of the trunks, world metres, [B, 3]."""
    return self._worlds.qpos[:, :3].copy()

  @property
  def terrain(self) -> terrain_lib.Terrain:
    """Terrains of the worlds; a view."""
    return self._worlds.core.terrain

  def observation_spec(self) -> specs.Array:
    """One world's observation, float32 [D]; see `layout`."""
    shape = (self._observer.size,)
    return specs.Array(shape, np.float32, name='observation')

  def action_spec(self) -> specs.DiscreteArray:
    """The index of a mode."""
    return specs.DiscreteArray(len(self.mode_names), name='mode')

  def part(self, name: str) -> slice:
    """Returns the place of a part of an observation; see `Observer.part`."""
    return self._observer.part(name)

  def obeyed(self) -> np.ndarray:
    """Returns the modes that can begin at once; see `Observer.obeyed`."""
    return self._observer.obeyed()

  def reset(self) -> np.ndarray:
    """Begins an episode in every world; returns observations [B, D]."""
    return self._begin(np.arange(self.num_worlds))

  def _problem(self, terrain: terrain_lib.Terrain) -> reaching.ReachingConfig:
    """Returns the problem on a terrain, a batch of one."""
    config = reaching.problem(self._track, terrain)
    if self._knot_duration is None:
      return config
    return reaching.in_knots(config, self._knot_duration)

  def _begin(self, ids: np.ndarray) -> np.ndarray:
    """Begins episodes in the worlds `ids`; returns all observations."""
    self._seen = self._worlds.reset(ids)
    for i in ids:
      config = self._problem(self.terrain.rows(np.array([i])))
      self.goal[i], self._knots[i] = config.goal, config.knots
    self._knot[ids], self._over[ids] = 0, False
    self._shift[ids] = self._scan_errors.draw_shift(
      len(ids), self._random_state
    )
    return self._observe()

  def step(self, modes: npt.ArrayLike) -> ReachingStep:
    """Commands modes and runs one knot.

    Args:
      modes: mode indices, one a world, [B].

    Raises:
      ValueError: they are no indices of modes, or have another shape.
    """
    worlds = self._worlds
    worlds.moving[:] = ~self._over
    count, mode_count = self.num_worlds, len(self.mode_names)
    modes = arrays.indices(modes, 'modes', (count,), mode_count)
    running = worlds.core.tracker.state.mode
    self._seen = worlds.command(np.where(self._over, running, modes))
    reward, alive = np.zeros(self.num_worlds), ~self._over
    for _ in range(self.knot_steps):
      worlds.moving[:] = alive
      step = worlds.step(self._policy.select_action(self._seen))
      self._seen = step.observation
      alive &= step.discount > 0
      worth = reaching.rewards(worlds.qpos[:, :3], self.goal)
      reward[alive] += worth[alive]
    self._knot += 1
    fell = ~self._over & ~alive
    last = fell | (~self._over & (self._knot >= self._knots))
    there = reaching.reached(
      worlds.qpos, worlds.qvel, worlds.core.terrain, self.goal
    )
    observation = self._observe()
    ids = np.flatnonzero(last)
    final = observation[ids]
    if self._auto_reset and len(ids):
      observation = self._begin(ids)
    else:
      self._over |= last
    return ReachingStep(
      reward,
      np.where(fell, 0.0, 1.0),
      last,
      observation,
      np.nan_to_num(final, posinf=0.0, neginf=0.0),
      there & alive,
    )

  def _observe(self) -> np.ndarray:
    """Makes the observations of all worlds; returns a copy, float32 [B, D]."""
    left = 1 - self._knot / self._knots
    self._observation[:] = self._observer.observe(
      self._seen,
      self._worlds.qpos[:, :3],
      sensing.Situation(self.goal, left, self._shift),
      self._random_state,
    )
    return self._observation.copy()

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of the whole state: `restore` continues bit for bit."""
    state = {f'worlds/{k}': v for k, v in self._worlds.state().items()}
    state |= {name: field.copy() for name, field in self._fields().items()}
    generator = arrays.generator_state(self._random_state)
    return state | {f'random/{k}': v for k, v in generator.items()}

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Restores a `state`; returns its observations.

    Raises:
      ValueError: the state is of another number of worlds or another task.
    """
    self._seen = self._worlds.restore(arrays.part_of(state, 'worlds/'))
    for name, field in self._fields().items():
      field[:] = state[name]
    arrays.restore_generator(
      self._random_state, arrays.part_of(state, 'random/')
    )
    return self._observation.copy()

  def _fields(self) -> dict[str, Any]:
    """Returns the arrays of the state that are its own."""
    return {
      'goal': self.goal,
      'knots': self._knots,
      'knot': self._knot,
      'over': self._over,
      'shift': self._shift,
      'observation': self._observation,
    }
