"""The suite's tasks as Gymnasium environments; needs the extra `gym`.

    import gymnasium
    from dmc_multimode.suite.wrappers import gymnasium_env
    env = gymnasium.make('dmc_multimode/walk_forward-v0')
    envs = gymnasium.make_vec('dmc_multimode/walk_forward-v0', num_envs=64)

Importing this module registers every task of the suite. Many environments of an
imitation task are one batch of worlds, stepped in one call (see
`gymnasium_vector_env`); `make_vec` with `vectorization_mode='sync'` or
`'async'` makes as many single ones instead.
"""

from typing import Any, Mapping

import dm_env
from dm_env import specs
import numpy as np

from dmc_multimode import suite
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import observations

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
  [10], or the index of a mode.
  """

  metadata: dict[str, Any] = {'render_modes': ['rgb_array']}

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
      width, height: of the frames, pixels.
      camera: of the model, whose view is rendered.

    Raises:
      ValueError: the render mode is unknown.
    """
    if render_mode not in (None, *self.metadata['render_modes']):
      raise ValueError(
        f'Unknown render mode {render_mode!r}: use None or "rgb_array".'
      )
    self._environment, self._task = environment, environment.task
    self._episodes = self._task.episodes.state()
    self._over, self._closed = True, False
    self.render_mode = render_mode
    self._view = {'width': width, 'height': height, 'camera_id': camera}
    rate = round(1 / environment.control_timestep())
    self.metadata = {**self.metadata, 'render_fps': rate}
    parts = environment.observation_spec().values()
    self.observation_space = gymnasium.spaces.Box(
      -np.inf, np.inf, (sum(part.shape[0] for part in parts),), np.float32
    )
    self.action_space = space(environment.action_spec())

  def reset(
    self, *, seed: int | None = None, options: dict[str, Any] | None = None
  ) -> tuple[np.ndarray, dict[str, Any]]:
    """Begins an episode; see `gymnasium.Env.reset`.

    Args:
      seed: of everything random from here on. What an adaptive sampler has
        learned is forgotten as well, so that equal seeds and actions lead to
        equal episodes.
      options: none are known.
    """
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
      gymnasium.error.ResetNeeded: no episode is running.
    """
    if self._over:
      raise gymnasium.error.ResetNeeded('Call reset() to begin an episode.')
    timestep = self._environment.step(np.asarray(action))
    self._over = timestep.last()
    terminated = self._over and timestep.discount == 0.0
    truncated = self._over and not terminated
    observation, info = self._see(timestep)
    return observation, float(timestep.reward), terminated, truncated, info

  def _see(
    self, timestep: dm_env.TimeStep
  ) -> tuple[np.ndarray, dict[str, Any]]:
    """Returns the flat observation and the info."""
    flat = observations.flatten(timestep.observation)
    return flat, {'mode': self._task.mode}

  def render(self) -> np.ndarray | None:
    """Returns a frame, uint8 [height, width, 3]; None without render mode."""
    if self.render_mode is None:
      return None
    return self._environment.physics.render(**self._view)

  def close(self) -> None:
    """Frees the physics; doing so again is harmless."""
    if not self._closed:
      self._closed = True
      self._environment.close()


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
  **kwargs: Any,
) -> GymnasiumEnv:
  """Loads a task of the suite; the entry point of Gymnasium's registry.

  Args:
    task: of the domain `multimode_biped`.
    render_mode: None or 'rgb_array'.
    time_limit: length of an episode, seconds; the task's own by default.
    task_kwargs: further arguments of the task's factory, such as `policy`.
    **kwargs: further arguments of `GymnasiumEnv`.

  Raises:
    ValueError: the task or the render mode is unknown.
  """
  environment = suite.load(
    suite.DOMAIN, task, {'time_limit': time_limit, **(task_kwargs or {})}
  )
  return GymnasiumEnv(environment, render_mode, **kwargs)


def environment_id(task: str) -> str:
  """Returns the name of a task in Gymnasium's registry."""
  return f'{NAMESPACE}/{task}-v{_VERSION}'


def register() -> None:
  """Puts all tasks into Gymnasium's registry; doing so again is harmless."""
  reaching = multimode_biped.SUITE.tagged('reaching')
  for _, task in suite.ALL_TASKS:
    if environment_id(task) not in gymnasium.registry:
      vector = None if task in reaching else _VECTOR_ENTRY_POINT
      gymnasium.register(
        environment_id(task),
        entry_point=f'{__name__}:{make.__name__}',
        vector_entry_point=vector,
        kwargs={'task': task},
      )


register()
