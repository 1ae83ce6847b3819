"""The domain `multimode_biped`: one task a mode, and the paper's mode sets.

Factories have the signature of dm_control's own: `time_limit` in seconds,
`random` (a seed or a `RandomState`) and `environment_kwargs` for the
`composer.Environment`.
"""

import dataclasses
import functools
from typing import Any, Callable, Mapping, Sequence

from dm_control import composer
from dm_control.utils import containers
import numpy as np

from dmc_multimode import resources
from dmc_multimode.arenas import track
from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import library
from dmc_multimode.modes import reference
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes as episodes_lib
from dmc_multimode.suite import imitation
from dmc_multimode.suite import mini_biped
from dmc_multimode.suite import rewards

SUITE = containers.TaggedTasks()

_DEFAULT_GAINS = rewards.RewardGains()
# Table I: only pi3 is rewarded for its contacts.
REWARD_GAINS: Mapping[str, rewards.RewardGains] = {
  'pi3': rewards.RewardGains(0.35, 0.35, 0.3),
}


@functools.cache
def library_codebook() -> codebook_lib.Codebook:
  """Returns the shipped latents of all modes of the library."""
  return codebook_lib.load(
    resources.path('pretrained', 'library') / codebook_lib.FILE
  )


def make_task(
  motions: Sequence[reference.ReferenceMotion],
  codebook: codebook_lib.Codebook | None = None,
  episodes: episodes_lib.EpisodeInitialiser | None = None,
  arena: str | track.Track = 'flat',
  config: config_lib.ImitationConfig | None = None,
) -> imitation.Imitation:
  """Builds an imitation task: the one place where its parts meet.

  Args:
    motions: the mode set.
    codebook: latents of these modes; the shipped ones by default.
    episodes: the episodes; Algorithm 1 by default.
    arena: a track or the name of one.
    config: of the task.

  Raises:
    ValueError: unknown arena, or modes that the codebook does not encode.
  """
  names = tuple(motion.name for motion in motions)
  if isinstance(arena, str):
    arena = track.make(arena)
  if episodes is None:
    episodes = episodes_lib.TransitionEpisodes(reference.ReferenceBank(motions))
  return imitation.Imitation(
    mini_biped.MiniBiped(),
    arena,
    tuple(motions),
    (codebook or library_codebook()).subset(names),
    episodes,
    config,
  )


def make_environment(
  task: imitation.Imitation,
  random: int | np.random.RandomState | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
) -> composer.Environment:
  """Makes a task an environment with the task's own time limit.

  Args:
    task: whose model does not change between episodes.
    random: a seed, or the source of all randomness.
    environment_kwargs: for the `composer.Environment`.
  """
  kwargs: dict[str, Any] = {
    'recompile_mjcf_every_episode': False,
    'strip_singleton_obs_buffer_dim': True,
    **(environment_kwargs or {}),
  }
  # Half a physics step early: the physics' clock adds up rounding errors, and
  # an episode would last one control step too long.
  time_limit = task.config.time_limit - task.config.physics_timestep / 2
  return composer.Environment(
    task, time_limit=time_limit, random_state=random, **kwargs
  )


def multimode(
  modes: str | Sequence[str],
  time_limit: float | None = None,
  random: int | np.random.RandomState | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
  config: config_lib.ImitationConfig | None = None,
) -> composer.Environment:
  """A set of modes and all their transitions, sampled by Algorithm 1."""
  config = config or config_lib.ImitationConfig(
    gains=REWARD_GAINS.get(str(modes), _DEFAULT_GAINS)
  )
  if time_limit is not None:
    config = dataclasses.replace(config, time_limit=time_limit)
  task = make_task(library.resolve(modes), config=config)
  return make_environment(task, random, environment_kwargs)


def single_mode(
  mode: str,
  time_limit: float | None = None,
  random: int | np.random.RandomState | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
) -> composer.Environment:
  """One mode, commanded throughout."""
  config = config_lib.ImitationConfig()
  if time_limit is not None:
    config = dataclasses.replace(config, time_limit=time_limit)
  episodes = episodes_lib.ScheduledEpisodes(
    schedule_lib.single(np.zeros(1, dtype=np.int64))
  )
  task = make_task(library.resolve([mode]), episodes=episodes, config=config)
  return make_environment(task, random, environment_kwargs)


def _register(
  name: str, factory: Callable[..., composer.Environment], *tags: str
) -> None:
  """Adds a factory to SUITE under a name of its own."""
  partial = functools.partial(factory, name)

  def make(
    time_limit: float | None = None,
    random: int | np.random.RandomState | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
  ) -> composer.Environment:
    return partial(time_limit, random, environment_kwargs)

  make.__name__ = name
  make.__doc__ = f'Returns the {name} task; see `{factory.__name__}`.'
  SUITE.add(*tags)(make)


_EASY = ('idle', 'walk_forward')
# Not 'benchmarking': dm_control promises actions in [-1, 1] for these, and its
# benchmark is a fixed set.
for _mode in library.modes():
  _register(_mode, single_mode, 'easy' if _mode in _EASY else 'hard')
for _set in ('pi1', 'pi2', 'pi3'):
  _register(_set, multimode, 'hard', 'multimode')
