"""The imitation task on `mujoco.batch`: N worlds, one call.

The model is compiled from the arena and walker of a Composer `Imitation` task,
and the task itself is the same `ImitationCore`, so that policies move freely
between the two.
"""

from typing import Any, Mapping, NamedTuple

from dm_env import specs
import mujoco
import numpy as np
from numpy import typing as npt

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import core as imitation_core
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import motion_costs
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import symmetry as task_symmetry
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import arrays
from dmc_multimode.utils import durations
from dmc_multimode.walkers import derivation


class BatchedTimeStep(NamedTuple):
  """One control step of B worlds.

  Attributes:
    reward: Eq. 3 plus the contact-schedule bonus of `TrainingEvents`, [B].
    discount: 0 where the episode terminated, 1 elsewhere (also at the time
      limit), [B]: the mask for bootstrapping.
    last: whether the episode ended, [B]: the mask for cutting.
    observation: observations for the next action; where `last`, the first of
      the next episode, float32 [B, D].
    final_observation: last observations of the N episodes that ended, before
      the reset, in the order of `results.worlds`, float32 [N, D].
    results: the episodes that ended.
    transitions: the transitions that ended, which Algorithm 1 learns from; as
      `results`, but for episodes of several commands.
  """

  reward: np.ndarray
  discount: np.ndarray
  last: np.ndarray
  observation: np.ndarray
  final_observation: np.ndarray
  results: episodes_lib.EpisodeBatch
  transitions: episodes_lib.EpisodeBatch


class BatchedImitation:
  """B worlds of an `Imitation` task, stepped together on a thread pool.

  Attributes:
    physics: the engine's worlds.
    qpos, qvel: its generalised positions [B, 7 + J] and velocities [B, 6 + J].
    core: the task's worlds.
    steps: environment steps so far, summed over all worlds of all replicas.
    moving: whether the physics of each world is stepped, [B]. A world that is
      not stepped costs no time; its clocks run on. Not part of `state`.
    invalid_cause: `EpisodeBatch.causes` of a world whose physics diverged.
  """

  invalid_cause = terminations.NON_FINITE

  def __init__(
    self,
    task: composer_task.Imitation,
    num_worlds: int,
    seed: int | np.random.RandomState,
    num_threads: int = 0,
    auto_reset: bool = True,
    privileged: bool = False,
    replicas: int = 1,
    model: mujoco.MjModel | None = None,
  ):
    """Compiles the task's model; call `reset` before `step`.

    Args:
      task: its arena, walker, modes, episodes and configuration are used; its
        own physics is not touched.
      num_worlds: B.
      seed: of all randomness; the same seed gives the same worlds at any number
        of threads.
      num_threads: of the physics; 0 takes every core.
      auto_reset: resets a world in the step that ends its episode. Otherwise
        the world runs on, and only its first end is reported.
      privileged: appends the privileged critic observations; D is
        `observations.size(n_m, privileged)`.
      replicas: number of environments like this one that train together. With
        more than one, episodes update Algorithm 1 only through `learn`.
      model: result of `mujoco_worlds.compile_model` for the task, possibly with
        another mass or friction; compiled by default.
    """
    self.config = task.config
    self.episodes = task.episodes
    self.mode_set = task.mode_set
    self.num_worlds = num_worlds
    self._arena = task.root_entity
    self._action_spec = task.walker.action_spec
    self._bounds = np.stack(
      [self._action_spec.minimum, self._action_spec.maximum]
    )
    self._auto_reset = auto_reset
    self._replicas = replicas
    latent_dim = task.mode_set.latent_dim
    extra, robot = self.config.observed_terms, self.config.robot
    self._size = observations.size(latent_dim, privileged, extra, robot)
    self.privileged_size = self._size - observations.size(
      latent_dim, extra=extra, robot=robot
    )
    self._errors = observations.SensorErrors(latent_dim, extra, robot)
    scale = self.config.events.sensor_noise
    self._noisy = scale.largest > 0
    self._sensor_errors = np.zeros((num_worlds, len(self._errors.noise)))
    self._disturbances = self.config.events.disturbances
    self._soles = np.full((num_worlds, robot.num_feet, 3), np.inf)
    self._random_state = (
      seed
      if isinstance(seed, np.random.RandomState)
      else np.random.RandomState(seed)
    )
    self.core = task.make_core(num_worlds, task.episodes.max_knots)
    if model is None:
      model = mujoco_worlds.compile_model(task)
    self.physics = mujoco_worlds.MujocoWorlds(
      model, self._arena, num_worlds, num_threads, self._disturbances, robot
    )
    self.qpos, self.qvel = self.physics.qpos, self.physics.qvel
    self._returns = np.zeros(num_worlds)
    self._initial = np.zeros(num_worlds, dtype=np.int64)
    self._final = np.zeros(num_worlds, dtype=np.int64)
    self._ended = np.zeros(num_worlds, dtype=bool)
    self._horizon = np.full(num_worlds, self.config.horizon)
    # Step and return at the last command but one, and at the last.
    self._command_steps = np.zeros((num_worlds, 2), dtype=np.int64)
    self._command_returns = np.zeros((num_worlds, 2))
    self.moving = np.ones(num_worlds, dtype=bool)
    self.steps = 0
    self.assistance = events.TakeoffAssistance(
      self.config.events.assistance_steps, self.core.tracker.bank.takeoffs > 0
    )
    self.outcome: imitation_core.Outcome | None = None

  def observation_spec(self) -> specs.Array:
    """One world's observation, float32 [D]; see `observations`."""
    return specs.Array((self._size,), np.float32, name='observation')

  def action_spec(self) -> specs.BoundedArray:
    """One world's action: joint targets in radians, [J]."""
    return self._action_spec

  def standing_action(self) -> np.ndarray:
    """Returns joint targets that hold the standing pose, radians, [J]."""
    return derivation.standing_action(self.physics.model, self.config.robot)

  def mirror_image(self) -> task_symmetry.MirrorImage:
    """Returns the left-right mirror image; see `symmetry.mirror_image`."""
    return task_symmetry.mirror_image(
      self.mode_set,
      self.privileged_size > 0,
      self.config.observed_terms,
      self.config.robot,
    )

  @property
  def mode_names(self) -> tuple[str, ...]:
    """Names of the modes, in the order of their indices."""
    return self.mode_set.names

  @property
  def control_timestep(self) -> float:
    """Seconds between actions."""
    return self.config.control_timestep

  def reset(self, worlds: np.ndarray | None = None) -> np.ndarray:
    """Begins episodes; returns the observations of all worlds.

    Args:
      worlds: indices of those that begin anew, [N]; all by default.
    """
    ids = np.arange(self.num_worlds) if worlds is None else worlds
    self._begin(ids)
    self._ended[ids] = False
    return self._observe()

  def reset_alike(self) -> np.ndarray:
    """Begins one episode in all worlds; returns the observations.

    The episode is the first one of a single world, or of a Composer
    environment, with the same seed.
    """
    self._begin(np.array([0]))
    self._ended[:] = False
    return self.copy_state(np.zeros(self.num_worlds, dtype=np.int64))

  def step(self, actions: npt.ArrayLike) -> BatchedTimeStep:
    """Applies actions for one control step.

    Args:
      actions: joint targets in radians, clipped to their bounds, [B, J]. Those
        of worlds that are not stepped, or have diverged, do not matter.

    Raises:
      ValueError: they are no numbers, have another shape, or are not finite;
        the worlds are as before.
    """
    self.core.act(np.clip(self._checked(actions), *self._bounds))
    diverged = self.physics.step(
      self._targets(), self.moving, self.config.substeps
    )
    steps = self.num_worlds * self._replicas
    self.steps += steps
    self.assistance.fade(steps)
    self._follow_schedules()
    outcome = self.core.advance(self.qpos, self.qvel, self.feet_contact())
    if len(diverged):
      outcome.cause[diverged] = terminations.NON_FINITE
      outcome.reward[diverged] = 0.0
    self.outcome = outcome
    self._returns += outcome.reward
    training = np.where(
      outcome.cause == terminations.NON_FINITE,
      0.0,
      self._bonus(outcome) - self._costs(),
    )
    self._assist()
    self._push()
    knot = self.core.tracker.state.knot.copy()
    self._move_boxes(self.core.switch(self.qpos, self.qvel, self._random_state))
    strings = self.episodes.max_knots > 2
    left = self._left_transitions(knot) if strings else None
    self._draw_sensor_errors(slice(None))
    observation = self._observe()
    return self._conclude(outcome, training, observation, left)

  def _left_transitions(self, knot: np.ndarray) -> episodes_lib.EpisodeBatch:
    """Returns the transitions that new commands ended, before the episode did.

    Args:
      knot: of the schedules before this step's commands, [B].
    """
    state = self.core.tracker.state
    commanded = np.flatnonzero(state.knot > knot)
    ids = commanded[knot[commanded] > 0]
    begin, gained = self._command_steps[ids, 0], self._command_returns[ids, 0]
    lengths = state.step[ids] - begin
    batch = episodes_lib.EpisodeBatch(
      ids,
      state.schedule_modes[ids, knot[ids] - 1],
      state.schedule_modes[ids, knot[ids]],
      self.config.normalised(self._returns[ids] - gained, lengths, lengths),
      lengths,
      np.zeros(len(ids), dtype=np.int64),
    )
    for marks, now in (
      (self._command_steps, state.step),
      (self._command_returns, self._returns),
    ):
      marks[commanded, 0] = marks[commanded, 1]
      marks[commanded, 1] = now[commanded]
    return batch

  def _targets(self) -> np.ndarray:
    """Returns the joint targets of this control step, see `MujocoWorlds`."""
    if 'action_delay' not in self._disturbances.active:
      return self.core.actions[:, 0]
    config = self.config
    return disturbances.delayed(
      self.core.actions,
      self.core.disturbances['action_delay'],
      config.physics_timestep,
      config.substeps,
    )

  def _checked(self, actions: npt.ArrayLike) -> np.ndarray:
    """Returns actions that the engine can take; see `step`."""
    shape = (self.num_worlds, *self._action_spec.shape)
    checked = arrays.numbers(actions, 'actions', shape)
    valid = arrays.finite_rows(checked)
    if not valid.all():
      acts = self.moving & arrays.finite_rows(self.physics.state)
      arrays.check_worlds(valid | ~acts, 'actions')
    return checked

  def command(self, modes: np.ndarray) -> np.ndarray:
    """Commands modes now, whatever the schedules say; returns observations.

    As for a scheduled command, the reference is anchored where the robot is, a
    mode that runs already continues, and what a robot cannot obey is held until
    it can; see `ImitationCore.command`.

    Args:
      modes: mode indices, one a world, [B].

    Raises:
      ValueError: they are no indices of modes, or have another shape.
    """
    count, mode_count = self.num_worlds, len(self.mode_set)
    modes = arrays.indices(modes, 'modes', (count,), mode_count)
    self._move_boxes(
      self.core.command(
        np.arange(self.num_worlds),
        modes,
        self.qpos,
        self.qvel,
        self._random_state,
      )
    )
    return self._observe()

  def copy_state(
    self, sources: np.ndarray, other: 'BatchedImitation | None' = None
  ) -> np.ndarray:
    """Copies states: world i continues from the state of `sources[i]`.

    Args:
      sources: indices of worlds, [B].
      other: environment that holds the source worlds, of the same model and
        task, with any number of worlds; this one by default.

    Returns:
      The observations.

    Raises:
      ValueError: the sources are no indices of worlds, or the other's physics
        has a state of another size.
    """
    other = other or self
    sources = arrays.indices(
      sources, 'sources', (self.num_worlds,), other.num_worlds
    )
    theirs, mine = (each.physics.state.shape[1] for each in (other, self))
    if theirs != mine:
      raise ValueError(
        f"A world's state has {theirs} numbers there and {mine} here: use "
        'worlds of the same task.'
      )
    terrain = other.core.terrain.rows(sources)
    moved = [
      (mine != theirs).any(axis=1)
      for mine, theirs in zip(self.core.terrain, terrain, strict=True)
    ]
    fields = other._fields()
    for name, field in self._fields().items():
      field[:] = fields[name][sources]
    self._write_body(np.arange(self.num_worlds))
    self._move_boxes(np.flatnonzero(np.any(moved, axis=0)))
    return self._observe()

  def _fields(self) -> dict[str, np.ndarray]:
    """Returns the state arrays by name, views with a leading axis B."""
    fields = {
      'physics': self.physics.state,
      'returns': self._returns,
      'initial': self._initial,
      'final': self._final,
      'ended': self._ended,
      'horizon': self._horizon,
      'command_steps': self._command_steps,
      'command_returns': self._command_returns,
      'contact': self.core.contact,
      'actions': self.core.actions,
      'soles': self._soles,
      'pushed': self.core.pushed,
      'recovering': self.core.recovering,
    }
    if self._noisy:
      fields['sensor_errors'] = self._sensor_errors
    for name in self._disturbances.active:
      fields[f'disturbances/{name}'] = self.core.disturbances[name]
    for prefix, parts in (
      ('tracker', self.core.tracker.state),
      ('terrain', self.core.terrain),
    ):
      for name, field in parts._asdict().items():
        fields[f'{prefix}/{name}'] = field
    return fields

  def _follow_schedules(self) -> None:
    """Sets the distance slack and the obstacle share of this step count."""
    scheduled, core, steps = self.config.events, self.core, self.steps
    core.distance_slack = scheduled.distance_slack.at(steps)
    core.terrain_events.obstacle_share = scheduled.obstacles.at(steps)

  def _bonus(self, outcome: imitation_core.Outcome) -> np.ndarray | float:
    """Returns the bonuses that are added to Eq. 3 in training, [B]."""
    scheduled = self.config.events
    bonus: np.ndarray | float = 0.0
    weight = scheduled.contact_bonus.at(self.steps)
    if weight:
      bonus += weight * self.core.contact_schedule_agreement(
        outcome.reference, self.physics.soles()
      )
    weight = scheduled.precision_bonus.at(self.steps)
    if weight:
      bonus += weight * rewards.precision(outcome.errors, self.config.gains)
    return bonus

  def _costs(self) -> np.ndarray | float:
    """Returns the costs of motions that are not quiet, [B]."""
    scheduled = self.config.events
    share = scheduled.cost_share.at(self.steps)
    if not (share and scheduled.costs.active):
      return 0.0
    soles = self.physics.soles()
    motion = self.core.motion(
      self.qpos[:, 7:], self.physics.joint_limits, soles, self._soles
    )
    self._soles[:] = soles
    costs = share * motion_costs.total(motion, scheduled.costs)
    costs[self.core.recovering > 0] *= scheduled.push_cost_share
    return costs

  def _assist(self) -> None:
    """Adds the take-off assistance to the velocities of robots."""
    if not self.assistance.share:
      return
    ids, wanted = self.core.tracker.take_offs()
    self.qvel[ids, :3] += self.assistance.boost(self.qvel[ids, :3], wanted)

  def _push(self) -> None:
    """Applies random horizontal pushes; see `events.push`."""
    ids = events.push(
      self.qvel,
      self.config.events.push_speed.at(self.steps),
      self.core.push_probability,
      self._random_state,
    )
    self.core.recovering -= self.config.control_timestep
    self.core.recovering[ids] = events.RECOVERY

  def _conclude(
    self,
    outcome: imitation_core.Outcome,
    training: np.ndarray,
    observation: np.ndarray,
    left: episodes_lib.EpisodeBatch | None,
  ) -> BatchedTimeStep:
    """Returns the time step; ends and, with `auto_reset`, begins episodes."""
    terminated = outcome.cause > 0
    last = terminated | (self.core.tracker.state.step >= self._horizon)
    last &= ~self._ended
    ids = np.flatnonzero(last)
    results = self._finished(ids, outcome.cause)
    transitions = self._last_transitions(results, left)
    if self._replicas == 1:
      self.learn(transitions)
    # Where the state diverged, a learner multiplies the value of this
    # observation by a discount of 0, and 0 * NaN would still be NaN.
    final_observation = np.nan_to_num(observation[ids], posinf=0, neginf=0)
    if self._auto_reset:
      self._begin(ids)
      if len(ids):
        observation[ids] = self._observe(ids)
    else:
      self._ended |= last
    discount = np.where(terminated, 0.0, 1.0)
    return BatchedTimeStep(
      outcome.reward + training,
      discount,
      last,
      observation,
      final_observation,
      results,
      transitions,
    )

  def _finished(
    self, ids: np.ndarray, causes: np.ndarray
  ) -> episodes_lib.EpisodeBatch:
    """Returns the finished episodes of the worlds `ids`."""
    lengths = self.core.tracker.state.step[ids].copy()
    return episodes_lib.EpisodeBatch(
      ids,
      self._initial[ids],
      self._final[ids],
      self.config.normalised(self._returns[ids], lengths, self._horizon[ids]),
      lengths,
      causes[ids],
    )

  def _last_transitions(
    self,
    results: episodes_lib.EpisodeBatch,
    left: episodes_lib.EpisodeBatch | None,
  ) -> episodes_lib.EpisodeBatch:
    """Returns all transitions that ended in this step.

    The last one of an episode has the return since the last command but one,
    over the steps from there to the horizon.

    Args:
      results: the episodes that ended.
      left: the transitions that commands ended; None where episodes are single
        transitions.
    """
    if left is None:
      return results
    ids, state = results.worlds, self.core.tracker.state
    knot = np.maximum(state.knot[ids], 1)
    begin, gained = self._command_steps[ids, 0], self._command_returns[ids, 0]
    ended = results._replace(
      initial=state.schedule_modes[ids, knot - 1],
      final=state.schedule_modes[ids, knot],
      returns=self.config.normalised(
        self._returns[ids] - gained, results.lengths, self._horizon[ids], begin
      ),
    )
    return episodes_lib.EpisodeBatch(
      *(np.concatenate(pair) for pair in zip(left, ended, strict=True))
    )

  def learn(self, outcomes: episodes_lib.Outcomes) -> None:
    """Updates Algorithm 1 and assistance with finished episodes, in order."""
    if len(outcomes.initial):
      self.episodes.update(outcomes)
      self.assistance.update(outcomes.final, outcomes.causes == 0)

  def _begin(self, ids: np.ndarray) -> None:
    """Resets the worlds `ids` to new episodes."""
    if not len(ids):
      return
    drawn = [self._arena.generate(self._random_state) for _ in ids]
    terrain = terrain_lib.Terrain(
      *(np.concatenate(field) for field in zip(*drawn, strict=True))
    )
    episodes = self.episodes.sample(ids, self.steps, self._random_state)
    qpos, qvel = self.core.start(ids, episodes, terrain, self._random_state)
    self.physics.reset(ids, qpos, qvel)
    self._disturb(ids)
    self._draw_sensor_errors(ids)
    self._soles[ids] = np.inf
    self.core.recovering[ids] = 0.0
    self._move_boxes(ids)
    self._returns[ids] = 0.0
    self._initial[ids], self._final[ids] = episodes.initial, episodes.final
    is_bounded = self.config.horizon < durations.UNBOUNDED
    self._horizon[ids] = self.config.horizon * (
      episodes.stretch if is_bounded else 1
    )
    self._command_steps[ids], self._command_returns[ids] = 0, 0.0

  def _disturb(self, ids: np.ndarray) -> None:
    """Draws the disturbances of the worlds `ids`."""
    share = self.config.events.disturbance_share.at(self.steps)
    drawn = disturbances.draw(
      self._disturbances,
      share,
      len(ids),
      self._random_state,
      self.config.events.disturbance_fraction,
    )
    for name in self._disturbances.active:
      self.core.disturbances[name][ids] = drawn[name]
    self._write_body(ids)

  def _write_body(self, ids: np.ndarray) -> None:
    """Writes the disturbances of the worlds `ids` into their models."""
    if self._disturbances.active and len(ids):
      values = {
        name: value[ids] for name, value in self.core.disturbances.items()
      }
      self.physics.write_body(ids, values)

  def _move_boxes(self, ids: np.ndarray) -> None:
    """Moves the boxes of the worlds `ids` to the segments of their terrains."""
    self.physics.move_boxes(ids, self.core.terrain.rows(ids))

  def feet_contact(self) -> np.ndarray:
    """Returns the contacts of the feet, 0 or 1, [B, F]."""
    return (self.physics.touch() > self.config.contact_force).astype(np.float64)

  def measure(self) -> dict[str, np.ndarray]:
    """Returns copies of the quantities that evaluations use, by name.

    position: of the trunk, world metres, [B, 3]; reference: likewise; support:
    height of the plane under the trunk, metres, [B]; yaw: of the trunk in the
    world, radians, [B]; tilt: its roll and pitch, radians, [B, 2], see
    `motion.tilt`; contact: feet on the ground, [B, F];
    reference_contact: likewise, zero where the mode has none; mode: index, [B];
    phase: in [0, 1], [B].
    """
    tracked = self.core.tracker.state
    position = self.qpos[:, :3].copy()
    reference = self.core.reference(position[:, 0])
    return {
      'position': position,
      'reference': reference.position,
      'support': self.core.support(position[:, 0]),
      'yaw': motion_lib.yaw(self.qpos[:, 3:7]),
      'tilt': motion_lib.tilt(self.qpos[:, 3:7]),
      'contact': self.feet_contact(),
      'reference_contact': reference.contact,
      'mode': tracked.mode.copy(),
      'phase': tracked.phase.copy(),
    }

  def _observe(
    self,
    ids: np.ndarray | slice = slice(None),
  ) -> np.ndarray:
    qpos = self.qpos[ids]
    parts = self.core.observe(
      qpos, self.qvel[ids], ids, privileged=self.privileged_size > 0
    )
    flat = observations.flatten(parts)
    if self._noisy:
      errors = self._sensor_errors[ids]
      observed = flat[:, : errors.shape[1]]
      observed[:] = observations.with_errors(observed, errors)
    return flat

  def _draw_sensor_errors(self, ids: np.ndarray | slice) -> None:
    """Draws the errors of the next observations of the worlds `ids`."""
    if self._noisy:
      scale = self.config.events.sensor_noise.at(self.steps)
      count = len(self._sensor_errors[ids])
      self._sensor_errors[ids] = self._errors.draw(
        count, scale, self._random_state
      )

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of the whole state: `restore` continues bit for bit."""
    state: dict[str, Any] = {
      name: field.copy() for name, field in self._fields().items()
    }
    state['steps'] = np.array(self.steps)
    for name, part in self._stateful_parts():
      state |= {f'{name}/{k}': v for k, v in part.state().items()}
    generator = arrays.generator_state(self._random_state)
    return state | {f'random/{k}': v for k, v in generator.items()}

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Restores a `state`; returns its observations.

    Raises:
      ValueError: the state belongs to another number of worlds or another task.
    """
    if state['physics'].shape != self.physics.state.shape:
      raise ValueError(
        f'The saved worlds have shape {state["physics"].shape}, these '
        f'{self.physics.state.shape}: use the same number of worlds and task.'
      )
    for name, field in self._fields().items():
      if name not in state:  # Earlier versions had fewer.
        continue
      if state[name].shape != field.shape:
        raise ValueError(
          f'The saved worlds have {name} of shape {state[name].shape}, these '
          f'{field.shape}: use the same task.'
        )
      field[:] = state[name]
    # Earlier versions wrote `total_steps`, and a counter of the episodes.
    self.steps = int(state['steps' if 'steps' in state else 'total_steps'])
    for name, part in self._stateful_parts():
      part.restore(arrays.part_of(state, f'{name}/'))
    arrays.restore_generator(
      self._random_state, arrays.part_of(state, 'random/')
    )
    self._follow_schedules()
    self._move_boxes(np.arange(self.num_worlds))
    self._write_body(np.arange(self.num_worlds))
    return self._observe()

  def _stateful_parts(self) -> tuple[tuple[str, Any], ...]:
    return (('episodes', self.episodes), ('assistance', self.assistance))
