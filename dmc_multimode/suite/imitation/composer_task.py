"""The imitation task as a dm_control Composer task, for one world."""

import collections
import copy
import dataclasses
import math
import operator
from typing import Any

from dm_control import composer
from dm_control.composer.observation import observable
import mujoco
import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import core as imitation_core
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import arrays
from dmc_multimode.walkers import robot_walker

_WORLD = np.array([0])
_MEMORY, _FEW_JOINTS = 2, 10  # Megabytes of a robot of so many joints.
_GOOD, _BAD = np.array([0.2, 0.7, 0.3]), np.array([0.85, 0.2, 0.15])


class Imitation(composer.Task):
  """Follow the commanded modes' rough references (Sec. II of the paper).

  The reward is Eq. 3, in [0, 1]; observations are those of `observations`, each
  part under its own name. Episodes end early when the reference is lost, with
  discount 0; the time limit belongs to the environment.
  """

  def __init__(
    self,
    walker: robot_walker.RobotWalker,
    arena: track_lib.Track,
    mode_set: mode_set_lib.ModeSet,
    episodes: episodes_lib.EpisodeInitialiser,
    config: task_config.ImitationConfig | None = None,
  ):
    """Puts the walker on the arena.

    Args:
      walker: the configuration's robot; becomes part of the arena.
      arena: the track that the robot is attached to.
      mode_set: the modes.
      episodes: chooses each episode's mode schedule.
      config: of the task; defaults otherwise.

    Raises:
      ValueError: the walker is not the configuration's robot, or the modes have
        contacts of other feet.
    """
    self._arena, self._walker = arena, walker
    self.config = config or task_config.ImitationConfig()
    robot = self.config.robot
    if walker.robot != robot:
      raise ValueError(
        f'The walker is {walker.robot}, the task is for {robot}.'
      )
    self.mode_set = mode_set.for_feet(robot.num_feet)
    self.episodes = episodes
    self._walker.create_root_joints(self._arena.attach(self._walker))
    self._set_physics_options()
    self._set_scene_options()
    self.core = self.make_core(1, episodes.max_knots)
    self._visualize_reward = False
    self._parts: dict[str, np.ndarray] = {}
    self._substep = 0
    # Physics whose state no observation shows yet; computed when asked for,
    # because hooks that run after the task's may still move the robot.
    self._unseen: Any = None
    self._outcome: imitation_core.Outcome | None = None
    self._return = 0.0
    self._random_state = np.random.RandomState()  # Until there is one.
    self._episode: episodes_lib.Episodes | None = None
    self._body: tuple[Any, disturbances.Body] | None = None
    self._targets = np.zeros((self.config.substeps, robot.num_joints))
    self._errors = observations.SensorErrors(
      mode_set.latent_dim, self.config.extra_observations, robot
    )
    self._sensor_errors = np.zeros((1, len(self._errors.noise)))
    self._add_observables()

  def _set_physics_options(self) -> None:
    option = self._arena.mjcf_model.option
    option.integrator = 'implicitfast'
    option.cone = 'pyramidal'
    option.noslip_iterations = 0
    # One robot is one island: looking for more of them only costs time.
    option.flag.island = 'disable'
    # A diverged state must be seen, not silently replaced by the initial one.
    option.flag.autoreset = 'disable'
    self.set_timesteps(
      self.config.control_timestep, self.config.physics_timestep
    )

  def _set_scene_options(self) -> None:
    """Sets what belongs to neither arena nor walker, whom it may not suit."""
    root = self._arena.mjcf_model
    # Without a GPU shadows cost half of a frame, and much more at 2048.
    root.visual.quality.shadowsize = 1024
    root.statistic.center, root.statistic.extent = [0, 0, 0.5], 3.0
    # More than boxes and feet need, so that memory never grows.
    megabytes = _MEMORY * math.ceil(self.config.robot.num_joints / _FEW_JOINTS)
    root.size.memory = f'{megabytes}M'

  def make_core(
    self, num_worlds: int, max_knots: int
  ) -> imitation_core.ImitationCore:
    """Returns the engine-free task for `num_worlds` worlds of this task."""
    return imitation_core.ImitationCore(
      self.mode_set,
      self.config,
      num_worlds,
      self._arena.num_segments,
      self._arena.adaptive,
      max_knots,
    )

  def _add_observables(self) -> None:
    layout = observations.layout(
      self.mode_set.latent_dim,
      extra=self.config.extra_observations,
      robot=self.config.robot,
    )
    self._task_observables = collections.OrderedDict()
    for name, size in layout:
      self._parts[name] = np.zeros((1, size))
      part = observable.Generic(
        lambda physics, name=name: self._part(physics, name)
      )
      part.enabled = True
      self._task_observables[name] = part

  def _part(self, physics: Any, name: str) -> np.ndarray:
    """Returns a part of the observation of this physics step, [size].

    Only observables that are delayed or buffered are asked within a control
    step; the parts are computed then, and once for all of them.
    """
    if self._unseen is not None:
      self._observe(physics)
    return self._parts[name][0]

  @property
  def root_entity(self) -> track_lib.Track:
    """The arena."""
    return self._arena

  @property
  def walker(self) -> robot_walker.RobotWalker:
    """The robot."""
    return self._walker

  @property
  def task_observables(self) -> Any:
    """The parts of the policy's observation by name, in order."""
    return self._task_observables

  @property
  def observation(self) -> dict[str, np.ndarray]:
    """Parts of `observations.layout` for the next action, [1, size] each."""
    if self._unseen is not None:
      self._observe(self._unseen)
    return dict(self._parts)

  @property
  def visualize_reward(self) -> bool:
    """Colours the robot's eye by the reward."""
    return self._visualize_reward

  @visualize_reward.setter
  def visualize_reward(self, value: bool) -> None:
    self._visualize_reward = bool(value)

  @property
  def mode(self) -> str:
    """Name of the running mode."""
    return self.mode_set.names[int(self.core.tracker.state.mode[0])]

  @property
  def random(self) -> np.random.RandomState:
    """The environment's source of randomness, as dm_control's tasks have it."""
    return self._random_state

  @property
  def outcome(self) -> imitation_core.Outcome | None:
    """Outcome of the last step, or None right after a reset."""
    return self._outcome

  def action_spec(self, physics: Any) -> Any:
    """Joint targets in radians, float64 [J]."""
    del physics
    return self._walker.action_spec

  def after_compile(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Notes the source of randomness of a new environment."""
    del physics
    self._random_state = random_state

  def initialize_episode(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Draws terrain, schedule and initial state."""
    self._random_state = random_state
    self._finish_episode()
    terrain = self._arena.generate(random_state)
    episode = self.episodes.sample(_WORLD, 0, random_state)
    self._episode = episode
    qpos, qvel = self.core.start(_WORLD, episode, terrain, random_state)
    self._arena.apply(physics, self._current_terrain())
    physics.data.qpos[:], physics.data.qvel[:] = qpos[0], qvel[0]
    self._disturb(physics, random_state)
    self._draw_sensor_errors(random_state)
    self._outcome, self._return = None, 0.0
    self._substep, self._unseen = 0, physics

  def _disturb(self, physics: Any, random_state: np.random.RandomState) -> None:
    """Draws the disturbances of the episode, as at the first step."""
    scheduled = self.config.events
    if not scheduled.disturbances.active:
      return
    self.core.disturbances = disturbances.draw(
      scheduled.disturbances,
      scheduled.disturbance_share.at(0),
      1,
      random_state,
      scheduled.disturbance_fraction,
    )
    if self._body is None or self._body[0] is not physics.model:
      model = physics.model.ptr
      nominal = copy.copy(model)
      trunk = physics.bind(self._walker.root_body).element_id
      self._body = (
        physics.model,
        disturbances.Body(
          nominal,
          scheduled.disturbances,
          lambda name: operator.attrgetter(name)(model)[None],
          int(trunk),
        ),
      )
    self._body[1].write(_WORLD, self.core.disturbances)
    _derive_masses(physics, self._body[1])

  def set_events(
    self,
    physics: Any,
    changed: events.TrainingEvents,
    random_state: np.random.RandomState,
  ) -> None:
    """Replaces disturbances, pushes and sensor noise in mid-episode.

    Args:
      physics: of the environment.
      changed: from now on, in later episodes as well.
      random_state: source of the disturbances that are drawn.

    Raises:
      ValueError: the delay is longer than the actions that are remembered; all
        is as before.
    """
    most = (self.core.actions.shape[1] - 1) * self.config.control_timestep
    if changed.disturbances.action_delay[1] > most + 1e-9:
      raise ValueError(f'A delay that changes is at most {most:g} s here.')
    self.config = dataclasses.replace(self.config, events=changed)
    self.core.disturbances = disturbances.nominal(1)
    if self._body and self._body[0] is physics.model:
      self._body[1].restore(_WORLD)
      _derive_masses(physics, self._body[1])
    self._body = None
    self._disturb(physics, random_state)

  def _finish_episode(self) -> None:
    """Updates Algorithm 1 with the finished episode, if there is one."""
    if self._episode is None or self._outcome is None:
      return
    lengths = self.core.tracker.state.step.copy()
    self.episodes.update(
      episodes_lib.EpisodeBatch(
        _WORLD,
        self._episode.initial,
        self._episode.final,
        self.config.normalised(np.array([self._return]), lengths),
        lengths,
        self._outcome.cause,
      )
    )
    self._episode = None

  def set_terrain(self, physics: Any, terrain: terrain_lib.Terrain) -> None:
    """Replaces the ground in mid-episode.

    Args:
      physics: of the environment.
      terrain: a batch of one; the same under the robot and where it was.
    """
    self.core.terrain.write(_WORLD, terrain)
    self._arena.apply(physics, self._current_terrain())

  def _current_terrain(self) -> terrain_lib.Terrain:
    return self.core.terrain.rows(_WORLD)

  def before_step(
    self, physics: Any, action: np.ndarray, random_state: np.random.RandomState
  ) -> None:
    """Remembers the joint targets for the servos.

    Args:
      physics: of the running episode.
      action: joint targets in radians, [J].
      random_state: unused.

    Raises:
      ValueError: they are no numbers, have another shape, or are not finite;
        the state is as before.
    """
    action = arrays.numbers(action, 'action', (self.config.robot.num_joints,))
    if not np.isfinite(action).all():
      raise ValueError(f'action must be finite, got {action.tolist()}')
    if self._outcome is None:
      # dm_control resets with actuation disabled, which leaves the actuators'
      # velocities at 0: the first physics step would miss the servos' damping.
      physics.forward()
    bounds = self._walker.action_spec
    self.core.act(np.clip(action, bounds.minimum, bounds.maximum)[None])
    self._targets = disturbances.delayed(
      self.core.actions,
      self.core.disturbances['action_delay'],
      self.config.physics_timestep,
      self.config.substeps,
    )[0]

  def before_substep(
    self, physics: Any, action: np.ndarray, random_state: np.random.RandomState
  ) -> None:
    """Hands the joint targets to the servos, by the delay later."""
    del action
    targets = self._targets[self._substep]
    self._walker.apply_action(physics, targets, random_state)

  def after_substep(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Counts the physics steps since the clocks advanced."""
    del random_state
    self._substep, self._unseen = self._substep + 1, physics

  def after_step(
    self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Computes the outcome of the step, then carries out the due commands."""
    qpos, qvel = _state(physics)
    # Not through a binding: it would first run `forward`, and the forces would
    # be those after the last physics step instead of those in it.
    sensors = physics.bind(self._walker.foot_sensors).element_id
    touch = physics.data.sensordata[physics.model.sensor_adr[sensors]]
    contact = (touch > self.config.contact_force)[None]
    self._outcome = self.core.advance(qpos, qvel, contact.astype(float))
    self._return += float(self._outcome.reward[0])
    self._push(physics, random_state)
    qpos, qvel = _state(physics)
    self._rebuild(physics, self.core.switch(qpos, qvel, random_state))
    self._draw_sensor_errors(random_state)
    self._substep, self._unseen = 0, physics
    if self._visualize_reward:
      self._colour(physics, float(self._outcome.reward[0]))

  def _push(self, physics: Any, random_state: np.random.RandomState) -> None:
    """Pushes the robot at random; see `events.push`."""
    speed = self.config.events.push_speed.at(0)
    if speed:
      chance = self.core.push_probability
      events.push(physics.data.qvel[None], speed, chance, random_state)
      physics.forward()

  def _draw_sensor_errors(self, random_state: np.random.RandomState) -> None:
    """Draws the errors of the observations of this control step."""
    scale = self.config.events.sensor_noise.at(0)
    if scale:
      self._sensor_errors = self._errors.draw(1, scale, random_state)

  def command(
    self, physics: Any, mode: int, random_state: np.random.RandomState
  ) -> None:
    """Commands a mode now, whatever the schedule says.

    As for a scheduled command, the reference is anchored where the robot is, a
    mode that runs already continues, and what the robot cannot obey is held
    until it can; see `ImitationCore.command`. `observation` includes a command
    at once; the time step that the environment returned before does not.

    Args:
      physics: of the running episode.
      mode: index into `mode_set`.
      random_state: source of the places of ledges.

    Raises:
      ValueError: it is no index of a mode.
    """
    modes = arrays.indices([mode], 'mode', (1,), len(self.mode_set))
    qpos, qvel = _state(physics)
    self._rebuild(
      physics, self.core.command(_WORLD, modes, qpos, qvel, random_state)
    )
    self._observe(physics)

  def _rebuild(self, physics: Any, changed: np.ndarray) -> None:
    """Moves the boxes if the terrain changed."""
    if len(changed):
      self._arena.apply(physics, self._current_terrain())
      physics.forward()

  def _observe(self, physics: Any) -> None:
    share = self._substep / self.config.substeps
    start = 0
    for name, part in self.core.observe(*_state(physics), share=share).items():
      end = start + part.shape[1]
      errors = self._sensor_errors[:, start:end]
      self._parts[name] = observations.with_errors(part, errors)
      start = end
    self._unseen = None

  def _colour(self, physics: Any, reward: float) -> None:
    material = self._walker.mjcf_model.find('material', 'eye')
    if material is None:
      return
    colour = _BAD + reward * (_GOOD - _BAD)
    physics.bind(material).rgba = np.append(colour, 1.0)

  def get_reward(self, physics: Any) -> float:
    """The reward of Eq. 3."""
    del physics
    return float(self._outcome.reward[0]) if self._outcome else 0.0

  def should_terminate_episode(self, physics: Any) -> bool:
    """Returns True where a limit of `TerminationLimits` is crossed."""
    del physics
    return bool(self._outcome and self._outcome.cause[0])

  def get_discount(self, physics: Any) -> float:
    """0 at an early termination, 1 otherwise (also at the time limit)."""
    return 0.0 if self.should_terminate_episode(physics) else 1.0

  @property
  def termination_cause(self) -> str:
    """Cause of an early end, one of `CAUSES`; 'none' otherwise."""
    cause = self._outcome.cause[0] if self._outcome else 0
    return terminations.CAUSES[cause]


def _derive_masses(physics: Any, body: disturbances.Body) -> None:
  """Computes the model's constants anew that follow from masses."""
  if body.changes_mass:
    mujoco.mj_setConst(physics.model.ptr, mujoco.MjData(physics.model.ptr))


def _state(physics: Any) -> tuple[np.ndarray, np.ndarray]:
  """Returns qpos [1, 7 + J] and qvel [1, 6 + J]."""
  return physics.data.qpos[None].copy(), physics.data.qvel[None].copy()
