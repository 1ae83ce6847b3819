"""The domain `multimode_biped`: tasks for modes, mode sets and tracks.

One task a mode, one for each of the paper's mode sets, and one for each track
that is to be crossed by mode commands. Factories have the signature of
dm_control's own: `time_limit` in seconds, `random` (a seed or a `RandomState`)
and `environment_kwargs` for the `composer.Environment`; some take more.

Composer, robot and tracks are imported by the functions that need them: to load
the suite should take hardly longer than to load dm_control's.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any, Callable, Mapping, Sequence, TYPE_CHECKING

from dm_control.utils import containers
import dm_env
import numpy as np

from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import durations
from dmc_multimode.walkers import robot as robot_lib

if TYPE_CHECKING:
  from dm_control import composer

  from dmc_multimode.arenas import terrain as terrain_lib
  from dmc_multimode.arenas import track
  from dmc_multimode.suite.imitation import composer_task
  from dmc_multimode.suite.reaching import environment as reaching_env

RobotLike = robot_lib.Robot | str | os.PathLike[str] | None
SUITE = containers.TaggedTasks()

_DEFAULT_GAINS = rewards.RewardGains()
_WITH_CONTACT = _DEFAULT_GAINS.with_weights(
  position=0.35, orientation=0.35, contact=0.3
)
# Table I: only pi3 is rewarded for its contacts; pi_all has its walk and hop,
# which differ in nothing else.
REWARD_GAINS: Mapping[str, rewards.RewardGains] = {
  'pi3': _WITH_CONTACT,
  'pi_all': _WITH_CONTACT,
  'pi_parkour': _WITH_CONTACT,
}


def make_task(
  mode_set: str | Sequence[str] | mode_set_lib.ModeSet,
  episodes: episodes_lib.EpisodeInitialiser | None = None,
  arena: str | track.Track = 'flat',
  config: task_config.ImitationConfig | None = None,
) -> composer_task.Imitation:
  """Builds an imitation task: the one place where its parts meet.

  Args:
    mode_set: the modes, or names of the library's: see `library.mode_set`.
    episodes: the episodes; Algorithm 1 by default.
    arena: a track or the name of one.
    config: of the task and its robot.

  Raises:
    ValueError: the arena or a mode is unknown, or the modes are not for the
      feet of the robot.
  """
  from dmc_multimode.arenas import track
  from dmc_multimode.suite.imitation import composer_task
  from dmc_multimode.walkers import robot_walker

  config = config or task_config.ImitationConfig()
  if not isinstance(mode_set, mode_set_lib.ModeSet):
    height = config.robot.stand_height
    mode_set = library.mode_set(mode_set, stand_height=height)
  if isinstance(arena, str):
    arena = track.make(arena)
  if episodes is None:
    episodes = episodes_lib.TransitionEpisodes(mode_set)
  return composer_task.Imitation(
    robot_walker.RobotWalker(config.robot),
    arena,
    mode_set,
    episodes,
    config,
  )


def make_environment(
  task: composer_task.Imitation,
  random: int | np.random.RandomState | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
) -> composer.Environment:
  """Wraps a task in an environment with the task's own time limit.

  Args:
    task: must not change its model between episodes.
    random: a seed, or the source of all randomness.
    environment_kwargs: for the `composer.Environment`; override ours. A
      `time_limit` in it becomes the task's.

  Raises:
    ValueError: the time limit is invalid.
  """
  from dm_control import composer

  kwargs: dict[str, Any] = {
    'recompile_mjcf_every_episode': False,
    'strip_singleton_obs_buffer_dim': True,
    **(environment_kwargs or {}),
  }
  if 'time_limit' in kwargs:
    limit = kwargs['time_limit']
    task.config = dataclasses.replace(task.config, time_limit=limit)
  kwargs['time_limit'] = durations.dm_control_limit(
    task.config.horizon, task.config.control_timestep
  )
  return composer.Environment(task, random_state=random, **kwargs)


def config_for(
  robot: RobotLike,
  config: task_config.ImitationConfig | None = None,
  gains: rewards.RewardGains = _DEFAULT_GAINS,
) -> task_config.ImitationConfig:
  """Returns a configuration that is given, or the default one of a robot.

  Args:
    robot: declared robot, or its file; None for that of `config`, or else the
      mini biped.
    config: of the task.
    gains: of the default one.

  Raises:
    OSError, ValueError: the robot's file cannot be read, or is invalid; or the
      robot is given beside a configuration of another.
  """
  if config is None:
    default = task_config.ImitationConfig(gains=gains)
    return task_config.for_robot(default, robot_lib.find(robot))
  if robot is not None and robot_lib.find(robot) != config.robot:
    raise ValueError(
      f'the config is of the robot {config.robot}: make it by config.for_robot.'
    )
  return config


def make_modes_task(
  modes: str | Sequence[str],
  time_limit: float | None = None,
  config: task_config.ImitationConfig | None = None,
  arena: str | track.Track = 'flat',
  robot: RobotLike = None,
) -> composer_task.Imitation:
  """Builds the task of a mode or a set of modes of the library.

  One mode is commanded throughout; with several, Algorithm 1 draws the modes
  and transitions.

  Args:
    modes: names, as `library.mode_set` takes them.
    time_limit: seconds; the configuration's by default.
    config: of the task; the default has the paper's reward weights for the set.
    arena: a track or the name of one.
    robot: declared robot, or its file; that of `config`, or the mini biped, by
      default. The modes are scaled to it.

  Raises:
    OSError: the robot's file cannot be read.
    ValueError: the arena or a mode is unknown, the time limit invalid, or the
      robot is; or it is given beside a `config`, which has one.
  """
  gains = REWARD_GAINS.get(str(modes), _DEFAULT_GAINS)
  config = config_for(robot, config, gains)
  if time_limit is not None:
    config = dataclasses.replace(config, time_limit=time_limit)
  mode_set = library.mode_set(modes, stand_height=config.robot.stand_height)
  episodes = _first() if len(mode_set) == 1 else None
  return make_task(mode_set, episodes, arena, config)


def imitation(
  modes: str | Sequence[str],
  time_limit: float | None = None,
  random: int | np.random.RandomState | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
  config: task_config.ImitationConfig | None = None,
  arena: str | track.Track = 'flat',
  robot: RobotLike = None,
) -> composer.Environment:
  """Returns an environment of `make_modes_task`."""
  task = make_modes_task(modes, time_limit, config, arena, robot)
  return make_environment(task, random, environment_kwargs)


def _first() -> episodes_lib.ScheduledEpisodes:
  """Returns episodes of the first mode alone."""
  return episodes_lib.ScheduledEpisodes(
    schedule_lib.single(np.zeros(1, dtype=np.int64))
  )


def reach(
  track_name: str,
  time_limit: float | None = None,
  random: int | np.random.RandomState | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
  policy: str | os.PathLike[str] | reaching.Policy = 'pi2',
  sizes: Mapping[str, float] | None = None,
) -> reaching_env.ReachingEnvironment:
  """Returns an environment of mode commands across a track.

  An action is the mode that is commanded for a knot. With a seed for `random`,
  the first episode, its track included, is the problem that a planner gets for
  this seed.

  Args:
    track_name: one of `reaching.TRACKS`.
    time_limit: seconds: as many knots as fit; the problem's own if None.
    random: a seed, or the source of all randomness.
    environment_kwargs: for the `composer.Environment`.
    policy: turns modes into motion: name of a shipped policy, a folder, or a
      `reaching.Policy`.
    sizes: of the track, where they are not its defaults; see its function in
      `arenas.layouts`.

  Raises:
    FileNotFoundError, TypeError: `policy` is not a policy.
    ValueError: no knot fits into `time_limit`, or a size is unknown or invalid.
  """
  from dmc_multimode.arenas import track
  from dmc_multimode.suite.reaching import environment as reaching_env

  policy = reaching_env.load_policy(policy)
  arena = track.make(track_name, sizes=sizes)
  kwargs = dict(environment_kwargs or {})
  time_limit = kwargs.pop('time_limit', time_limit)

  def problem(terrain: terrain_lib.Terrain) -> reaching.ReachingConfig:
    return reaching.within(reaching.problem(track_name, terrain), time_limit)

  first = problem(arena.generate(np.random.RandomState(0)))
  task = make_task(
    policy.mode_set,
    _first(),
    arena,
    reaching.task_config(policy, first),
  )
  # Knots end the episode, and random tracks differ in their number.
  kwargs['time_limit'] = np.inf
  environment = make_environment(task, random, kwargs)
  varies = arena.is_random and time_limit is None
  most_knots = None if varies else first.knots
  return reaching_env.ReachingEnvironment(
    environment, policy, problem, most_knots
  )


def _register(
  name: str,
  factory: Callable[..., dm_env.Environment],
  subject: str,
  *tags: str,
) -> None:
  """Adds a factory, applied to its subject, to SUITE under a name."""

  def make(
    time_limit: float | None = None,
    random: int | np.random.RandomState | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    **more: Any,
  ) -> dm_env.Environment:
    return factory(subject, time_limit, random, environment_kwargs, **more)

  make.__name__ = name
  make.__doc__ = f'Returns the {name} task; see `{factory.__name__}`.'
  SUITE.add(*tags)(make)


_EASY = ('idle', 'walk_forward')
# Rewards are shown in the eye's colour, not in those of dm_control's common
# materials, which its tests and demonstrations look at.
_EVERY = ('no_reward_visualization',)
# Not 'benchmarking': dm_control promises actions in [-1, 1] for these, and its
# benchmark is a fixed set.
for _mode in library.modes():
  _level = 'easy' if _mode in _EASY else 'hard'
  _register(_mode, imitation, _mode, _level, *_EVERY)
for _set in ('pi1', 'pi2', 'pi3', 'pi_all', 'pi_parkour'):
  _register(_set, imitation, _set, 'hard', 'multimode', *_EVERY)
for _track in reaching.TRACKS:
  _register(f'reach_{_track}', reach, _track, 'hard', 'reaching', *_EVERY)
