"""The suite's tasks as Gymnasium environments; needs the extra `gym`.

    import gymnasium
    from dmc_multimode.suite.wrappers import gymnasium_env
    env = gymnasium.make('dmc_multimode/walk_forward-v0')
    envs = gymnasium.make_vec('dmc_multimode/walk_forward-v0', num_envs=64)

Importing this module registers every task of the suite. A process that has not
imported it, such as one of `SubprocVecEnv`, takes the identifier with this
module before it, `MODULE:dmc_multimode/walk_forward-v0`.

Many environments of an imitation task are one batch of worlds, stepped in one
call (see `gymnasium_vector_env`); `make_vec` with `vectorization_mode='sync'`
or `'async'` makes as many single ones instead.

Modes of four feet are registered as well, and take a robot:

    gymnasium.make('dmc_multimode/trot_forward-v0', robot='go1')
"""

import copy
import math
from typing import Any, Mapping

import dm_env
from dm_env import specs
import numpy as np

from dmc_multimode import suite
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.wrappers import frames
from dmc_multimode.utils import durations

try:
  import gymnasium
except ModuleNotFoundError:
  raise ModuleNotFoundError(
    'Gymnasium is not installed: pip install dmc_multimode[gym]',
    name='gymnasium',
  ) from None

_VECTOR_ENTRY_POINT = (
  'dmc_multimode.suite.wrappers.gymnasium_vector_env:make_vector'
)
NAMESPACE = 'dmc_multimode'
_VERSION = 0
SEEDS = 2**32  # Seeds of a RandomState.


class GymnasiumEnv(gymnasium.Env[np.ndarray, Any]):
  """One task of the suite behind Gymnasium's interface.

  Observations are flat, float32 [D], their parts in the order of the task's
  `observation_spec`. Actions are the task's: joint targets in radians, float32
  [J], or the index of a mode.
  """

  metadata: dict[str, Any] = {'render_modes': list(frames.View.MODES)}

  def __init__(
    self,
    environment: dm_env.Environment,
    render_mode: str | None = None,
    width: int = 640,
    height: int = 480,
    camera: str = 'walker/side',
  ):
    """Wraps an environment and takes ownership of it.

    Args:
      environment: as `suite.load` returns it, of a task of ours.
      render_mode: None or 'rgb_array'.
      width, height: of the frames, pixels, up to 4096.
      camera: of the model, whose view is rendered.

    Raises:
      OSError: there is no OpenGL here to render with.
      ValueError: the render mode or camera is unknown, or the size is none.
    """
    self._environment, self._task = environment, environment.task
    self._view = frames.View(self._task, render_mode, width, height, camera)
    self.render_mode = render_mode
    self._episodes = self._task.episodes.state()
    self._over, self._closed = True, False
    self._spec: Any = None
    rate = round(1 / environment.control_timestep())
    self.metadata = {**self.metadata, 'render_fps': rate}
    parts = environment.observation_spec().values()
    size = sum(math.prod(part.shape) for part in parts)
    self.observation_space = gymnasium.spaces.Box(
      -np.inf, np.inf, (size,), np.float32
    )
    self.action_space = space(environment.action_spec())

  @property
  def spec(self) -> Any:
    """Gymnasium's `EnvSpec`, with the steps to the time limit; or None."""
    return self._spec

  @spec.setter
  def spec(self, spec: Any) -> None:
    self._spec = limited(spec, most_steps(self._environment))

  def reset(
    self, *, seed: int | None = None, options: dict[str, Any] | None = None
  ) -> tuple[np.ndarray, dict[str, Any]]:
    """Begins an episode; see `gymnasium.Env.reset`.

    Args:
      seed: of everything random from here on. What an adaptive sampler has
        learned is forgotten as well, so that equal seeds and actions lead to
        equal episodes.
      options: none are known.

    Raises:
      gymnasium.error.ClosedEnvironmentError: after `close`.
    """
    self._check_open()
    super().reset(seed=seed, options=options)
    if seed is not None:
      # Ends the running episode first: its update of the sampler must come
      # before the sampler is reset.
      self._environment.reset()
      self._task.episodes.restore(self._episodes)
      self._environment.random_state.seed(self.np_random.integers(SEEDS))
    self._over = False
    return self._see(self._environment.reset())

  def step(
    self, action: Any
  ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
    """Applies an action of `action_space`; see `gymnasium.Env.step`.

    Raises:
      gymnasium.error.ClosedEnvironmentError: after `close`.
      gymnasium.error.ResetNeeded: no episode is running.
      ValueError: the action is none of the space.
    """
    self._check_open()
    if self._over:
      raise gymnasium.error.ResetNeeded('Call reset() to begin an episode.')
    timestep = self._environment.step(self._checked(action))
    self._over = timestep.last()
    terminated = self._over and timestep.discount == 0.0
    truncated = self._over and not terminated
    observation, info = self._see(timestep)
    return observation, float(timestep.reward), terminated, truncated, info

  def _checked(self, action: Any) -> Any:
    """Returns the action; a number that is no index is none of a `Discrete`."""
    is_index = isinstance(self.action_space, gymnasium.spaces.Discrete)
    if is_index and action not in self.action_space:
      raise ValueError(
        f'An action is the index of a mode, below {len(self.mode_names)}, got '
        f'{action!r}.'
      )
    return action

  def _check_open(self) -> None:
    if self._closed:
      raise closed()

  def _see(
    self, timestep: dm_env.TimeStep
  ) -> tuple[np.ndarray, dict[str, Any]]:
    """Returns the flat observation and the info."""
    # Not by `observations.flatten`: parts may have a buffer's axis.
    parts = [np.ravel(part) for part in timestep.observation.values()]
    flat = np.concatenate(parts, dtype=np.float32, casting='unsafe')
    return flat, {'mode': int(self._task.core.tracker.state.mode[0])}

  @property
  def mode_names(self) -> tuple[str, ...]:
    """Names of the modes, in the order of the indices in `infos['mode']`."""
    return self._task.mode_set.names

  def render(self) -> np.ndarray | None:
    """Returns a frame, uint8 [height, width, 3]; None without render mode.

    Raises:
      gymnasium.error.ClosedEnvironmentError: after `close`.
    """
    self._check_open()
    if self.render_mode is None:
      return None
    return self._view.draw(self._environment.physics)

  def close(self) -> None:
    """Frees the physics; doing so again is harmless."""
    if not self._closed:
      self._closed = True
      self._environment.close()


def closed() -> Exception:
  """Returns the error of using an environment that has been closed."""
  return gymnasium.error.ClosedEnvironmentError(
    'The environment is closed: make another.'
  )


def most_steps(environment: Any) -> int | None:
  """Returns the steps of the longest episode, for `limited`.

  Args:
    environment: of a task of ours, possibly within a wrapper of dm_control's.
  """
  if hasattr(environment, 'most_knots'):
    return environment.most_knots
  return environment.task.config.horizon


def limited(spec: Any, steps: int | None) -> Any:
  """Returns a copy of an `EnvSpec` with these steps in an episode.

  Args:
    spec: or None.
    steps: None or `durations.UNBOUNDED` where there is no bound.
  """
  if spec is not None and steps not in (None, durations.UNBOUNDED):
    spec = copy.copy(spec)
    spec.max_episode_steps = steps
  return spec


def space(spec: specs.BoundedArray) -> gymnasium.Space[Any]:
  """Returns the space of the actions that a specification allows."""
  if isinstance(spec, specs.DiscreteArray):
    return gymnasium.spaces.Discrete(spec.num_values)
  low, high = (
    bound.astype(np.float32) for bound in (spec.minimum, spec.maximum)
  )
  return gymnasium.spaces.Box(low, high)


def make(
  task: str,
  render_mode: str | None = None,
  time_limit: float | None = None,
  task_kwargs: Mapping[str, Any] | None = None,
  robot: multimode_biped.RobotLike = None,
  **kwargs: Any,
) -> GymnasiumEnv:
  """Loads a task of the suite; the entry point of Gymnasium's registry.

  Args:
    task: of the domain `multimode_biped`.
    render_mode: None or 'rgb_array'.
    time_limit: length of an episode, seconds; the task's own by default.
    task_kwargs: further arguments of the task's factory, such as `policy`.
    robot: declared robot, its file or its name, of modes and sets; the mini
      biped by default.
    **kwargs: further arguments of `GymnasiumEnv`.

  Raises:
    ValueError: the task or the render mode is unknown, or the robot is invalid.
  """
  environment = load(task, time_limit, task_kwargs, robot)
  return GymnasiumEnv(environment, render_mode, **kwargs)


def load(
  task: str,
  time_limit: float | None,
  task_kwargs: Mapping[str, Any] | None,
  robot: multimode_biped.RobotLike,
) -> Any:
  """Loads a task of the suite; see `make`."""
  kwargs = {'time_limit': time_limit, **(task_kwargs or {})}
  if robot is not None:
    kwargs['robot'] = robot
  return suite.load(suite.DOMAIN, task, kwargs)


def environment_id(task: str) -> str:
  """Returns the name of a task in Gymnasium's registry."""
  return f'{NAMESPACE}/{task}-v{_VERSION}'


def register() -> None:
  """Puts all tasks into Gymnasium's registry; doing so again is harmless."""
  reaching = multimode_biped.SUITE.tagged('reaching')
  names = [*(task for _, task in suite.ALL_TASKS), *suite.FOUR_FOOTED]
  for task in names:
    if environment_id(task) not in gymnasium.registry:
      vector = None if task in reaching else _VECTOR_ENTRY_POINT
      gymnasium.register(
        environment_id(task),
        entry_point=f'{__name__}:{make.__name__}',
        vector_entry_point=vector,
        kwargs={'task': task},
      )


register()
