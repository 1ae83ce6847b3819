"""The reaching problem as an environment, for planners of any kind.

    env = suite.load('multimode_biped', 'reach_gap')
    timestep = env.reset()
    while not timestep.last():
      timestep = env.step(env.mode_names.index('leap_forward'))

The policy that turns commands into motion is part of the environment.
"""

import os
import pathlib
from typing import Any, Callable

from dm_control import composer
import dm_env
from dm_env import specs
import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.reaching import problem as reaching

_NEEDED = ('mode_set', 'config', 'select_action')


def load_policy(
  policy: str | os.PathLike[str] | reaching.Policy,
) -> reaching.Policy:
  """Returns the policy of a name or folder, or checks a policy object.

  Args:
    policy: name of a shipped policy, a folder, or a policy object.

  Raises:
    FileNotFoundError: there is no such policy; the message lists those there
      are.
    TypeError: the object lacks a part of `reaching.Policy`.
    ValueError: the policy's files are damaged.
  """
  if isinstance(policy, (str, os.PathLike)):
    # The only import of trained policies in the suite: an environment loaded by
    # name has to find its policy. It is late: loading the suite needs no torch.
    from dmc_multimode import pretrained

    return pretrained.load(policy)
  lacking = [name for name in _NEEDED if not hasattr(policy, name)]
  if lacking:
    raise TypeError(
      f'policy must be the name of a shipped policy, a folder, or an object '
      f'with {", ".join(_NEEDED)}; {policy!r} has no {", ".join(lacking)}.'
    )
  return policy


def find_policy(policy: str | os.PathLike[str]) -> pathlib.Path:
  """Returns the folder of a policy's files.

  Raises:
    FileNotFoundError: there is no such policy.
  """
  from dmc_multimode.pretrained import folder  # Late: see `load_policy`.

  return folder.find(policy)


class ReachingEnvironment(dm_env.Environment):
  """One step commands one mode for one knot; a policy moves the robot.

  An action is the index of a mode, see `mode_names`. Policies for dm_control's
  suite draw floating-point numbers between the bounds of any specification;
  such a number is rounded. The reward is the sum of exp(-|goal - p|) over the
  knot's control steps, p being the position of the trunk in metres, and zero
  from a fall on. An episode ends with the last knot, with discount 1, or with a
  fall, with discount 0.

  Observations are float64 and of the end of a knot. With M modes:

    goal [3]: from the trunk to the goal, world frame, metres
    clock [2]: sine and cosine of 2 pi times the running mode's phase
    height [1]: of the trunk over its support plane, metres
    orientation [4]: quaternion (w, x, y, z) of the trunk, w >= 0, relative to
      the commanded heading, which is the world's unless a mode turns
    joints_pos [10]: radians
    velocity [3]: of the trunk, trunk frame, m/s
    angular_velocity [3]: of the trunk, trunk frame, rad/s
    joints_vel [10]: rad/s
    mode [M]: 1 for the running mode, 0 for the others
    knots_left [1]: share of the episode's knots that are left, 1 to 0
    ground [30]: height of the ground 0.05, 0.1, ... 1.5 m ahead of the trunk
      along the track (the world's x) over the support plane, metres; -1 over a
      gap

  The paper's planner sees none of it.

  Attributes that it lacks are those of the `composer.Environment` inside, as
  for dm_control's own wrappers.

  Attributes:
    most_knots: the most knots of any episode; None if unknown.
  """

  def __init__(
    self,
    environment: composer.Environment,
    policy: reaching.Policy,
    problem: Callable[[terrain_lib.Terrain], reaching.ReachingConfig],
    most_knots: int | None = None,
  ):
    """Takes over an environment.

    Args:
      environment: of an `Imitation` task made for `policy`, whose schedule
        holds one command and whose episodes no time limit ends.
      policy: turns commands into motion.
      problem: returns the problem on a terrain (a batch of one). Its knot
        duration must not vary; the number of knots and the goal may, from
        episode to episode. Its seed is not used.
      most_knots: the most knots of any episode, if that is known.

    Raises:
      ValueError: a knot is not a whole number of control steps, or the goal not
        over the track.
    """
    self.most_knots = most_knots
    # By this name wrappers of dm_control's environments find the innermost.
    self._env, self._policy = environment, policy
    self._task: composer_task.Imitation = environment.task
    self._problem = problem
    self._pose_problem()
    self._knot_steps = reaching.knot_steps(
      self._config, environment.control_timestep()
    )
    self._knot, self._over = 0, True

  def _pose_problem(self) -> None:
    """Builds the goal and knots for the current terrain."""
    self._config = self._problem(self._terrain)
    reaching.check_goal(self._config.goal, self._terrain)

  @property
  def _terrain(self) -> terrain_lib.Terrain:
    return self._task.root_entity.terrain

  @property
  def inner(self) -> composer.Environment:
    """Environment of the control steps, for videos."""
    return self._env

  @property
  def task(self) -> composer_task.Imitation:
    """The low-level policy's task."""
    return self._task

  @property
  def physics(self) -> Any:
    """A weak proxy of the physics; renders."""
    return self._env.physics

  @property
  def random_state(self) -> np.random.RandomState:
    """Source of all randomness."""
    return self._env.random_state

  @property
  def _random_state(self) -> np.random.RandomState:
    """The same, by the name under which others seed Composer environments."""
    return self._env._random_state

  @_random_state.setter
  def _random_state(self, random_state: np.random.RandomState) -> None:
    self._env._random_state = random_state

  def __getattr__(self, name: str) -> Any:
    if name.startswith('_'):
      raise AttributeError(name)
    return getattr(self._env, name)

  @property
  def mode_names(self) -> tuple[str, ...]:
    """Names of the modes in the order of their indices."""
    return self._policy.mode_set.names

  @property
  def goal(self) -> np.ndarray:
    """Goal of the trunk in this episode, world metres, [3]."""
    return np.array(self._config.goal)

  @property
  def knots(self) -> int:
    """Steps of this episode if the robot does not fall."""
    return self._config.knots

  @property
  def reached(self) -> bool:
    """True while the robot stands at the goal; see `reaching.reached`."""
    data = self.physics.data
    return bool(
      reaching.reached(
        data.qpos[None], data.qvel[None], self._terrain, self.goal
      )[0]
    )

  def control_timestep(self) -> float:
    """Duration of a knot, seconds."""
    return self._config.knot_duration

  def action_spec(self) -> specs.DiscreteArray:
    """The index of a mode."""
    return specs.DiscreteArray(len(self.mode_names), name='mode')

  def reward_spec(self) -> specs.BoundedArray:
    """From 0 to the number of control steps in a knot."""
    return specs.BoundedArray((), float, 0.0, self._knot_steps, 'reward')

  def observation_spec(self) -> dict[str, specs.Array]:
    """Float64 arrays by name; see the class."""
    return {
      name: specs.Array(part.shape, part.dtype, name)
      for name, part in self._observe().items()
    }

  def reset(self) -> dm_env.TimeStep:
    """Begins an episode."""
    self._env.reset()
    self._pose_problem()
    self._knot, self._over = 0, False
    return dm_env.restart(self._observe())

  def step(self, action: int | np.ndarray) -> dm_env.TimeStep:
    """Commands a mode and runs one knot; after an episode's end, resets.

    Args:
      action: index of the mode; see the class for other numbers.

    Raises:
      ValueError: it is no number, or out of range.
    """
    if self._over:
      return self.reset()
    mode = self._checked(action)
    self._task.command(self.physics, mode, self.random_state)
    reward, end = self._run_knot()
    self._knot += 1
    self._over = end.last() or self._knot >= self._config.knots
    kind = dm_env.StepType.LAST if self._over else dm_env.StepType.MID
    return dm_env.TimeStep(kind, reward, end.discount, self._observe())

  def _checked(self, action: int | np.ndarray) -> int:
    index, names = np.asarray(action), self.mode_names
    is_number = index.shape == () and index.dtype.kind in 'iuf'
    if not (is_number and 0 <= index <= len(names) - 1):
      listed = ', '.join(f'{i} {name}' for i, name in enumerate(names))
      raise ValueError(
        f'An action is the index of a mode ({listed}), got {action!r}.'
      )
    return int(np.rint(index))

  def _run_knot(self) -> tuple[float, dm_env.TimeStep]:
    """Returns the reward, and the time step of the last control step."""
    reward = 0.0
    for _ in range(self._knot_steps):
      seen = observations.flatten(self._task.observation)
      action = np.asarray(self._policy.select_action(seen))[0]
      timestep = self._env.step(action)
      if timestep.discount:
        position = self.physics.data.qpos[None, :3]
        reward += float(reaching.rewards(position, self.goal)[0])
      if timestep.last():
        break
    return reward, timestep

  def _observe(self) -> dict[str, np.ndarray]:
    """Returns copies of the policy's parts, and the mode, knots and ground."""
    parts = self._task.observation
    parts.pop('command')
    position = self.physics.data.qpos[:3]
    running = self.mode_names.index(self._task.mode)
    return {
      'goal': self.goal - position,
      **{name: part[0].copy() for name, part in parts.items()},
      'mode': np.eye(len(self.mode_names))[running],
      'knots_left': np.array([1 - self._knot / self._config.knots]),
      'ground': reaching.ground_ahead(self._terrain, position[:1])[0],
    }

  def close(self) -> None:
    """Frees the physics."""
    self._env.close()
