"""Many worlds of a task as one vector environment of Gymnasium's.

    import gymnasium
    from dmc_multimode.suite.wrappers import gymnasium_env
    envs = gymnasium.make_vec('dmc_multimode/walk_forward-v0', num_envs=64)

Some of Gymnasium's own wrappers, and some libraries, know but one way in which
the next episode begins: `autoreset_mode` has all three.
"""

import dataclasses
from typing import Any, Mapping

from dm_control import mjcf
import gymnasium
import numpy as np

from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.wrappers import frames
from dmc_multimode.suite.wrappers import gymnasium_env

AutoresetMode = gymnasium.vector.AutoresetMode
_MASK = 'reset_mask'


class BatchedVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
  """The worlds of one `BatchedImitation` behind Gymnasium's vector interface.

  Observations are float32 [B, D], actions joint targets in radians, float32
  [B, J]. What becomes of a world whose episode ends is `autoreset_mode`:

    SameStep: it is reset in the same step. `final_obs` of the infos, float32
      [B, D], is what the step led to: the last observations of the worlds that
      ended, which `_final_obs` marks, and those of the others.
    NextStep: the next step resets it, whatever its action, with reward 0.
    Disabled: the caller resets it, by `options={'reset_mask': MASK}`, before
      the next step.

  The infos are arrays: `mode`, int64 [B], is an index into `mode_names`.

  Attributes:
    autoreset_mode: of the three.
    mode_names: of the modes, in the order of their indices.
  """

  metadata: dict[str, Any] = {
    'autoreset_mode': AutoresetMode.SAME_STEP,
    'render_modes': list(frames.View.MODES),
  }

  def __init__(
    self,
    task: composer_task.Imitation,
    num_envs: int,
    autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    render_mode: str | None = None,
    width: int = 640,
    height: int = 480,
    camera: str = 'walker/side',
    render_worlds: int | None = None,
    render_grid: bool = False,
  ):
    """Compiles the task's model for B worlds.

    Args:
      task: its own physics is not touched.
      num_envs: B.
      autoreset_mode: see the class.
      render_mode: None or 'rgb_array'.
      width, height: of a world's picture, pixels, up to 4096.
      camera: of the model, whose view is rendered.
      render_worlds: how many worlds are rendered, the first ones; all if None.
      render_grid: renders them as one picture, as square as can be.

    Raises:
      OSError: there is no OpenGL here to render with.
      ValueError: `num_envs` is not positive, or an argument is unknown or out
        of bounds.
    """
    if num_envs < 1:
      raise ValueError(f'num_envs must be positive, got {num_envs}.')
    self.num_envs = num_envs
    self.autoreset_mode = _autoreset_mode(autoreset_mode)
    self._view = frames.View(task, render_mode, width, height, camera)
    self.render_mode = render_mode
    self._drawn = num_envs if render_worlds is None else render_worlds
    if not 0 < self._drawn <= num_envs:
      raise ValueError(
        f'render_worlds must be from 1 to num_envs, {num_envs}, got '
        f'{render_worlds}.'
      )
    self._grid = render_grid
    self.metadata = {
      **self.metadata,
      'autoreset_mode': self.autoreset_mode,
      'render_fps': round(1 / task.config.control_timestep),
    }
    # The worlds draw from this generator, and `reset` seeds it.
    self._random_state = np.random.RandomState()
    self._task = task
    self._physics: Any = None  # To be seen; made for the first frame.
    self._worlds = batched_env.BatchedImitation(
      task,
      num_envs,
      self._random_state,
      auto_reset=self.autoreset_mode is AutoresetMode.SAME_STEP,
    )
    self._untaught, self._begun = self._worlds.state(), False
    self._episodes = task.episodes.state()
    self._over = np.zeros(num_envs, dtype=bool)
    self._spec: Any = None
    self.mode_names = task.mode_set.names
    self._declare_spaces()

  def _declare_spaces(self) -> None:
    """Declares the spaces of one world and of all."""
    self.single_observation_space = gymnasium.spaces.Box(
      -np.inf, np.inf, self._worlds.observation_spec().shape, np.float32
    )
    self.single_action_space = gymnasium_env.space(self._worlds.action_spec())
    self.observation_space, self.action_space = (
      gymnasium.vector.utils.batch_space(space, self.num_envs)
      for space in (self.single_observation_space, self.single_action_space)
    )

  @property
  def spec(self) -> Any:
    """Gymnasium's `EnvSpec`, with the steps to the time limit; or None."""
    return self._spec

  @spec.setter
  def spec(self, spec: Any) -> None:
    self._spec = gymnasium_env.limited(spec, self._task.config.horizon)

  def reset(
    self, *, seed: int | None = None, options: dict[str, Any] | None = None
  ) -> tuple[np.ndarray, dict[str, Any]]:
    """Begins an episode in every world; see `gymnasium.vector.VectorEnv`.

    Args:
      seed: of everything random from here on, in all worlds together. What an
        adaptive sampler has learned is forgotten as well.
      options: `reset_mask`, bool [B], begins an episode in these worlds alone.

    Raises:
      gymnasium.error.ClosedEnvironmentError: after `close`.
      gymnasium.error.ResetNeeded: the first reset has a mask.
      TypeError, ValueError: the mask is none.
    """
    self._check_open()
    worlds = self._masked(options)
    super().reset(seed=seed, options=options)
    if seed is not None:
      if worlds is None:
        self._worlds.restore(self._untaught)
      self._worlds.episodes.restore(self._episodes)
      self._random_state.seed(self.np_random.integers(gymnasium_env.SEEDS))
    self._begun = True
    self._over[slice(None) if worlds is None else worlds] = False
    return self._worlds.reset(worlds), self._modes()

  def _masked(self, options: dict[str, Any] | None) -> np.ndarray | None:
    """Returns the worlds of the mask in the options; None without one."""
    mask = (options or {}).get(_MASK)
    if mask is None:
      return None
    if not isinstance(mask, np.ndarray) or mask.dtype != bool:
      kind = getattr(mask, 'dtype', type(mask).__name__)
      raise TypeError(f'{_MASK} must be an array of bool, got {kind}.')
    if mask.shape != (self.num_envs,) or not mask.any():
      raise ValueError(
        f'{_MASK} must have shape ({self.num_envs},) and a world in it, got '
        f'{mask}.'
      )
    if not self._begun:
      raise gymnasium.error.ResetNeeded('Call reset() of all worlds first.')
    return np.flatnonzero(mask)

  def step(
    self, actions: Any
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """Applies actions of `action_space`; see `gymnasium.vector.VectorEnv`.

    Raises:
      gymnasium.error.ClosedEnvironmentError: after `close`.
      gymnasium.error.ResetNeeded: `reset` has not been called, or not in a
        world that ended and that nothing else resets.
      ValueError: the actions are none of the space.
    """
    self._check_open()
    if not self._begun:
      raise gymnasium.error.ResetNeeded('Call reset() to begin episodes.')
    begins, ended = self._over.any(), np.flatnonzero(self._over)
    if begins and self.autoreset_mode is AutoresetMode.DISABLED:
      raise gymnasium.error.ResetNeeded(
        f'The episodes of worlds {ended.tolist()} are over: call '
        f'reset(options={{"{_MASK}": mask}}).'
      )
    # Nothing moves where the next episode is about to begin.
    self._worlds.moving[:] = ~self._over
    before = self._modes()['mode']
    step = self._worlds.step(actions)
    last, observation, reward = step.last, step.observation, step.reward
    if begins:
      observation = self._worlds.reset(ended)
      reward[ended] = 0.0
    infos, final = self._modes(), observation.copy()
    final[last] = step.final_observation  # Finite, whatever the physics did.
    if self.autoreset_mode is not AutoresetMode.SAME_STEP:
      observation, self._over = final, last.copy()
    elif last.any():
      infos |= {
        'final_obs': final,
        '_final_obs': last.copy(),
        'final_info': {'mode': before, '_mode': last.copy()},
        '_final_info': last.copy(),
      }
    terminated = last & (step.discount == 0.0)
    return observation, reward, terminated, last & ~terminated, infos

  def _modes(self) -> dict[str, Any]:
    """Returns the infos that every step has: the running modes, [B]."""
    modes = self._worlds.core.tracker.state.mode.astype(np.int64)
    return {'mode': modes, '_mode': np.ones(self.num_envs, dtype=bool)}

  def render(self) -> tuple[np.ndarray, ...] | None:
    """Returns frames, uint8 [height, width, 3]; None without render mode.

    Returns:
      One frame a world that is rendered; with `render_grid` a single one of
      [rows * height, columns * width, 3].

    Raises:
      gymnasium.error.ClosedEnvironmentError: after `close`.
    """
    self._check_open()
    if self.render_mode is None:
      return None
    if self._physics is None:  # The worlds' own model has nothing visual.
      root = self._task.root_entity.mjcf_model
      self._physics = mjcf.Physics.from_mjcf_model(root)
    drawn = [self._draw(world) for world in range(self._drawn)]
    return (frames.grid(drawn),) if self._grid else tuple(drawn)

  def _draw(self, world: int) -> np.ndarray:
    """Returns a frame of one world."""
    physics, worlds = self._physics, self._worlds
    terrain = worlds.core.terrain.rows(np.array([world]))
    self._task.root_entity.apply(physics, terrain)
    physics.data.qpos[:] = worlds.qpos[world]
    physics.forward()
    return self._view.draw(physics)

  def _check_open(self) -> None:
    if self.closed:
      raise gymnasium_env.closed()

  def close_extras(self, **kwargs: Any) -> None:
    """Frees the worlds."""
    del kwargs, self._worlds
    if self._physics is not None:
      self._physics.free()


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
  """Returns the mode of a name; raises ValueError if there is none."""
  try:
    return AutoresetMode(mode)
  except ValueError:
    names = ', '.join(repr(known.value) for known in AutoresetMode)
    raise ValueError(
      f'Unknown autoreset_mode {mode!r}; there are {names}.'
    ) from None


def make_vector(
  task: str,
  num_envs: int = 1,
  time_limit: float | None = None,
  task_kwargs: Mapping[str, Any] | None = None,
  max_episode_steps: int | None = None,
  robot: multimode_biped.RobotLike = None,
  **kwargs: Any,
) -> BatchedVectorEnv:
  """Loads many worlds of a task; the vector entry point of the registry.

  Args:
    task: of the domain `multimode_biped`, whose actions are joint targets.
    num_envs: B.
    time_limit: length of an episode, seconds; the task's own by default.
    task_kwargs: further arguments of the task's factory, such as `config`.
    max_episode_steps: ends episodes after so many steps, as Gymnasium's
      `TimeLimit` does for one world; None and -1 leave the time limit alone.
    robot: declared robot, its file or its name; the mini biped by default.
    **kwargs: further arguments of `BatchedVectorEnv`, such as
      `autoreset_mode`.

  Raises:
    OSError: there is no OpenGL here to render with.
    ValueError: the task is unknown, or an argument unknown or out of bounds.
  """
  environment = gymnasium_env.load(task, time_limit, task_kwargs, robot)
  built: composer_task.Imitation = environment.task
  if max_episode_steps not in (None, -1):
    config = built.config
    if not 0 < max_episode_steps <= config.horizon:
      raise ValueError(
        f'max_episode_steps must be from 1 to the {config.horizon} steps of '
        f'the time limit, got {max_episode_steps}: time_limit=SECONDS is what '
        'makes episodes longer.'
      )
    limit = max_episode_steps * config.control_timestep
    built.config = dataclasses.replace(config, time_limit=limit)
  return BatchedVectorEnv(built, num_envs, **kwargs)
