"""Multimodal bipedal locomotion for dm_control.

    import dmc_multimode as dmm

    env = dmm.load('walk_forward')
    policy = dmm.load_policy('pi2')
    worlds = dmm.make_worlds(policy, num_worlds=512, seed=0)
    mine = dmm.train('runs/mine', modes='pi2', steps=10_000_000)
    report = dmm.evaluate(policy, seed=0)
    result = dmm.plan(policy, arena='gap', seed=0)
    dmm.record(policy, schedule='walk_forward:2,launch:2', out='video.mp4')

What lies before a policy, and what is drawn of it:

    modes = dmm.load_modes('pi2')
    path = dmm.sample_reference(modes.motions[1], phases=[0.0, 0.5])
    encoder = dmm.train_encoder('pi2')
    curves = dmm.read_metrics('runs/mine')
    trace = dmm.trace(policy, schedule='walk_forward:2,launch:2')
    figure = dmm.draw_plan(result)

Modes, policies and tracks are given by name or as objects, files and folders as
`str` or `os.PathLike`. Importing this module loads nothing but itself.
"""

import os
from typing import Any, Literal, Mapping, overload, Sequence, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  import dm_env
  import numpy as np

  from dmc_multimode.arenas.track import Track
  from dmc_multimode.evaluation.plan_figures import draw as draw_plan
  from dmc_multimode.evaluation.scores import evaluate
  from dmc_multimode.evaluation.training_figures import read as read_metrics
  from dmc_multimode.experiments.training import train
  from dmc_multimode.modes.encoder.mode_encoder import ModeEncoder
  from dmc_multimode.modes.library import mode_set as load_modes
  from dmc_multimode.modes.mode_set import ModeSet
  from dmc_multimode.modes.motion import ReferenceMotion
  from dmc_multimode.modes.reference import sample as sample_reference
  from dmc_multimode.planner.replanning import solve as plan
  from dmc_multimode.pretrained.policy import load as load_policy
  from dmc_multimode.pretrained.policy import Policy
  from dmc_multimode.suite.imitation.batched_env import BatchedImitation
  from dmc_multimode.suite.imitation.config import ImitationConfig
  from dmc_multimode.suite.reaching.worlds import ReachingWorlds
  from dmc_multimode.viewer.recording import record
  from dmc_multimode.viewer.recording import RecordingConfig
  from dmc_multimode.viewer.tracing import trace
  from dmc_multimode.walkers.robot import Robot

__version__ = '0.2.0'
__all__ = [
  'ModeSet',
  'Policy',
  'RecordingConfig',
  'ReferenceMotion',
  'draw_plan',
  'evaluate',
  'load',
  'load_modes',
  'load_policy',
  'make_worlds',
  'plan',
  'read_metrics',
  'record',
  'sample_reference',
  'trace',
  'train',
  'train_encoder',
]

_REACHING = 'reach_'
# Name -> module, and its name there if that is another.
_HOMES = {
  'ModeSet': 'modes.mode_set',
  'Policy': 'pretrained.policy',
  'RecordingConfig': 'viewer.recording',
  'ReferenceMotion': 'modes.motion',
  'draw_plan': 'evaluation.plan_figures:draw',
  'evaluate': 'evaluation.scores',
  'load_modes': 'modes.library:mode_set',
  'load_policy': 'pretrained.policy:load',
  'plan': 'planner.replanning:solve',
  'read_metrics': 'evaluation.training_figures:read',
  'record': 'viewer.recording',
  'sample_reference': 'modes.reference:sample',
  'trace': 'viewer.tracing',
  'train': 'experiments.training',
}


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)


def __dir__() -> list[str]:
  return sorted({*globals(), *__all__})


def load(task: str, **task_kwargs: Any) -> 'dm_env.Environment':
  """Returns the environment of a task; see `suite.load`.

  The default `config` of modes and sets is made for training: half of the
  episodes start mid-stride, on the reference at a random phase, and the edges
  of ledges are noisy. For episodes from rest, as in evaluations, pass
  `config=config.ImitationConfig(events=events.NONE)`, with the modules `config`
  and `events` of `dmc_multimode.suite.imitation`.

  Args:
    task: name of a mode, a set of modes, or `reach_` and a track. A name
      such as 'pi2' is that of the set of modes, with the default task; the
      shipped policy of this name has modes and a task of its own, which
      `suite.multimode_biped.make_task(policy.mode_set, config=policy.config)`
      makes and `make_environment` there wraps.
    **task_kwargs: for the task's factory: `random`, a seed; `time_limit`,
      seconds; `environment_kwargs`; `config`, `arena` and `robot`, a declared
      robot or its file, of modes and sets;
      `policy` of the tasks `reach_*`.

  Raises:
    ValueError: the task is unknown; the message lists all tasks.
  """
  from dmc_multimode import suite

  return suite.load(suite.DOMAIN, task, task_kwargs)


def train_encoder(
  modes: 'str | ModeSet | Sequence[str | ReferenceMotion]' = 'pi2',
  seed: int = 0,
) -> 'ModeEncoder':
  """Trains the encoder that turns motions into latents, in seconds.

  `train` does so by itself; this is to look at latents.

  Args:
    modes: name of a mode set, names of modes, or motions of your own.
    seed: of the initial weights.

  Raises:
    ValueError: a name is unknown, two motions are alike, or the training did
      not converge.
  """
  from dmc_multimode.experiments import training
  from dmc_multimode.modes import library
  from dmc_multimode.modes.encoder import training as encoder_training

  names, own = training.named(modes)
  return encoder_training.train_for(library.resolve(names or '', own), seed)


_Reaching = Literal[
  'reach_gap',
  'reach_plateau',
  'reach_gap_block',
  'reach_parkour',
  'reach_block',
  'reach_block_down',
  'reach_stairs',
  'reach_stepping_stones',
  'reach_slope',
  'reach_rough',
  'reach_obstacle_course',
  'reach_gaps_and_blocks',
]


@overload
def make_worlds(  # type: ignore[overload-overlap]
  modes: _Reaching,
  num_worlds: int,
  seed: int = 0,
  *,
  policy: 'str | os.PathLike[str] | Policy' = 'pi2',
  sizes: 'Mapping[str, float] | None' = None,
  num_threads: int = 0,
  auto_reset: bool = True,
) -> 'ReachingWorlds': ...


@overload
def make_worlds(
  modes: 'str | Sequence[str] | ModeSet | Policy | os.PathLike[str]',
  num_worlds: int,
  seed: 'int | np.random.RandomState' = 0,
  config: 'ImitationConfig | None' = None,
  arena: 'str | Track' = 'flat',
  num_threads: int = 0,
  auto_reset: bool = True,
  privileged: bool = False,
  *,
  robot: 'str | os.PathLike[str] | Robot | None' = None,
) -> 'BatchedImitation': ...


def make_worlds(
  modes: 'str | Sequence[str] | ModeSet | Policy | os.PathLike[str]',
  num_worlds: int,
  seed: 'int | np.random.RandomState' = 0,
  config: 'ImitationConfig | None' = None,
  arena: 'str | Track' = 'flat',
  num_threads: int = 0,
  auto_reset: bool = True,
  privileged: bool = False,
  policy: 'str | os.PathLike[str] | Policy' = 'pi2',
  sizes: 'Mapping[str, float] | None' = None,
  robot: 'str | os.PathLike[str] | Robot | None' = None,
) -> 'BatchedImitation | ReachingWorlds':
  """Returns many worlds of one task, stepped together; call `reset` first.

  Args:
    modes: names, as `dmc_multimode.modes.library.mode_set` takes them: one mode
      is commanded throughout; of several, Algorithm 1 chooses. Or a `ModeSet`.
      Or a policy, or its folder as an `os.PathLike`: its modes and its task.
      Or the name of a task `reach_*`, whose actions are modes; see
      `ReachingWorlds`. A name such as 'pi2' is that of a mode set, with the
      default task, whose observations are others than those of the shipped
      policy of this name: for that, pass `load_policy('pi2')`.
    num_worlds: B.
    seed: of all randomness.
    config: of the task; that of a policy is by default the one with which it is
      evaluated.
    arena: a track or the name of one: flat, gap, plateau, block, block_down,
      gap_block, stairs, stepping_stones, slope, rough, parkour,
      obstacle_course or gaps_and_blocks.
    num_threads: of the physics; 0 takes every core.
    auto_reset: resets a world in the step that ends its episode.
    privileged: appends the privileged critic observations.
    policy: of a task `reach_*`: turns modes into motion.
    sizes: of its track, where they are not its defaults.
    robot: declared robot, or its file, for named modes and for a `ModeSet`
      without a `config`; the mini biped by default. A policy's must be this.

  Raises:
    FileNotFoundError, TypeError: `modes` or `policy` is not a policy.
    ValueError: a mode or the arena is unknown, or a number out of bounds.
  """
  from dmc_multimode.modes import mode_set as mode_set_lib
  from dmc_multimode.suite import multimode_biped
  from dmc_multimode.suite.imitation import batched_env
  from dmc_multimode.suite.imitation import config as task_config
  from dmc_multimode.suite.reaching import environment as reaching_env
  from dmc_multimode.walkers import robot as robot_lib

  if isinstance(modes, str) and modes.startswith(_REACHING):
    from dmc_multimode.suite.reaching import worlds

    if not robot_lib.find(robot).is_mini_biped:
      raise ValueError('Tracks are crossed by the mini biped alone.')
    return worlds.ReachingWorlds(
      reaching_env.load_policy(policy),
      modes.removeprefix(_REACHING),
      num_worlds,
      seed if isinstance(seed, int) else seed.randint(2**31),
      num_threads,
      sizes,
      auto_reset=auto_reset,
    )
  if isinstance(modes, mode_set_lib.ModeSet):
    config = multimode_biped.config_for(robot, config)
    task = multimode_biped.make_task(modes, arena=arena, config=config)
  elif isinstance(modes, Sequence):
    task = multimode_biped.make_modes_task(
      modes, config=config, arena=arena, robot=robot
    )
  else:
    named = reaching_env.load_policy(modes)
    if robot is not None and robot_lib.find(robot) != named.config.robot:
      raise ValueError(f'The policy is of the robot {named.config.robot}.')
    config = config or task_config.evaluated(named.config)
    task = multimode_biped.make_task(named.mode_set, arena=arena, config=config)
  return batched_env.BatchedImitation(
    task, num_worlds, seed, num_threads, auto_reset, privileged
  )
