"""Trains a policy, in a new or a resumed run.

`python -m dmc_multimode.bin.train` as a function.
"""

import dataclasses
import json
import math
import os
import sys
from typing import Any, Mapping, Sequence

import torch

from dmc_multimode.agents import distributed
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import fine_tuning
from dmc_multimode.experiments import launch
from dmc_multimode.experiments import run_folder
from dmc_multimode.experiments import setup
from dmc_multimode.experiments import signals
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import training as encoder_training
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import symmetry as task_symmetry
from dmc_multimode.utils import files
from dmc_multimode.walkers import robot as robot_lib

Path = str | os.PathLike[str]
Motions = tuple[motion_lib.ReferenceMotion, ...]
Modes = str | mode_set_lib.ModeSet | Sequence[str | motion_lib.ReferenceMotion]

# More or fewer threads split the work elsewhere, and so round otherwise.
_OTHER_THREADS = (
  'To go on with {threads}, though not bit for bit, write "threads": {threads} '
  'into {config} of a copy of the folder, and resume that.'
)


def train(
  run_dir: Path,
  modes: Modes | None = None,
  steps: int | None = None,
  *,
  resume: bool = False,
  init_from: Path | None = None,
  mode_file: Path | None = None,
  encoder: Path | None = None,
  robot: robot_lib.Robot | Path | None = None,
  minutes: float = math.inf,
  keep_every: int = 0,
  device: str | torch.device = 'cpu',
  wandb_project: str | None = None,
  communicator: distributed.Communicator = distributed.LOCAL,
  **overrides: Any,
) -> policy_lib.Policy:
  """Trains up to `steps`, the time limit or a signal.

  Args:
    run_dir: folder of the run; see `run_folder`.
    modes: name of a mode set, names of modes, or `ReferenceMotion`s, for which
      an encoder makes latents; by default those of `quickstart`, or with
      `init_from` those of the policy and of `mode_file`.
    steps: environment steps, summed over all worlds, since the start; by
      default 12,000,000, or those of the run that is resumed. Other ones are
      the resumed run's from then on.
    resume: continues the run in the folder, bit for bit.
    init_from: initial policy, a shipped one or a folder; its network and its
      task, without pushes, disturbances and sensor noise, become defaults.
    mode_file: YAML or JSON file of further modes.
    encoder: folder of a trained encoder; trained first by default.
    robot: declared robot, or its file; the mini biped by default, or that of
      the initial policy or of the run that is resumed, which must be this one.
      Lengths and times of defaults and of the library's modes are scaled to it.
    minutes: wall-clock limit; training ends where steps or minutes do. A robot
      may fall without the noise of its actions until that has faded: schedule
      `ppo_std_floor` for the steps that these minutes allow.
    keep_every: environment steps between policies that are kept permanently; 0
      keeps none.
    device: of the networks.
    wandb_project: project of Weights and Biases to log to.
    communicator: of the ranks that train together; each calls this, and rank 0
      alone writes and prints.
    **overrides: other settings, named as the flags are that `train --help`
      lists: `seed=0`, `num_worlds=1024`, `threads` (those of the machine) and
      `one_hot=False`, which are the defaults; those of the learner, the fields
      of `PPOConfig`, as `ppo_discount=0.98`; of the commands `sampling_...`,
      the fields of `SamplingConfig`; and of the task `task_...`, those of
      `ImitationConfig`, whose parts go on likewise:
      `task_events_push_speed='0:0.5@8e6'` is none, and from 8 million steps on
      0.5 m/s.

  Returns:
    The policy, also written to the run's folder.

  Raises:
    FileNotFoundError: the run to resume or the policy does not exist.
    ValueError: in one line, a setting is wrong, contradicts the run that is
      resumed, or the folder already holds one.
    FloatingPointError: a rollout or an update is not finite.
  """
  # By name, which is how an error calls them.
  length = runner.TrainingConfig(
    steps=run_config.RunConfig().steps if steps is None else steps,
    minutes=minutes,
    keep_every=keep_every,
  )
  names, motions = named(modes)
  request = _Request(
    run_folder.RunFolder(run_dir),
    names,
    motions,
    steps,
    None if init_from is None else files.expand(init_from),
    mode_file,
    encoder,
    robot,
    overrides,
  )
  if wandb_project and communicator.rank == 0:
    loggers.check_wandb()
  run = _build(request, resume, torch.device(device), communicator)
  length = dataclasses.replace(length, steps=run.config.steps)
  return _run(run, request.folder, length, wandb_project, communicator)


def named(modes: Modes | None) -> tuple[str | None, Motions]:
  """Returns mode names, comma-separated, and the motions among `modes`."""
  if modes is None or isinstance(modes, str):
    return modes, ()
  if isinstance(modes, mode_set_lib.ModeSet):
    modes = modes.motions
  names = [mode if isinstance(mode, str) else mode.name for mode in modes]
  own = (mode for mode in modes if isinstance(mode, motion_lib.ReferenceMotion))
  return ','.join(names), tuple(own)


@dataclasses.dataclass(frozen=True)
class _Request:
  """Arguments of `train`."""

  folder: run_folder.RunFolder
  modes: str | None
  motions: Motions
  steps: int | None
  init_from: str | None
  mode_file: Path | None
  encoder: Path | None
  robot: robot_lib.Robot | Path | None
  overrides: Mapping[str, Any]

  def configure(
    self, start: fine_tuning.Start | None
  ) -> tuple[run_config.RunConfig, Motions]:
    """Returns the configuration and modes of a new run."""
    config = run_config.RunConfig()
    if self.steps is not None:
      config = dataclasses.replace(config, steps=self.steps)
    robot = None if self.robot is None else robot_lib.find(self.robot)
    if robot:
      config = run_config.for_robot(config, robot)
    known = start.policy.config.robot if start else config.task.robot
    extra = self.motions
    motions: Motions = ()
    if self.mode_file:
      extra = (*extra, *mode_files.load(self.mode_file, known.stand_height))
    if start:
      if robot:
        policy_lib.check_robot(start.policy, robot, start.name)
      motions = start.modes(self.modes, extra)
      config = start.config(motions, config.steps)
    threads = {'threads': distributed.local_cores()}
    config = run_config.overridden(config, {**threads, **self.overrides})
    if start:
      start.check(config)
      return config, motions
    config = dataclasses.replace(config, modes=self.modes or config.modes)
    height = config.task.robot.stand_height
    return config, library.resolve(config.modes, extra, height)

  def begin(self, ranks: int) -> run_folder.Description:
    """Checks everything, then makes the folder and encoder of a new run."""
    start = None
    if self.init_from:
      start = fine_tuning.load(
        self.init_from, None if self.encoder is None else str(self.encoder)
      )
    config, motions = self.configure(start)
    setup.check_ranks(config, ranks)
    mode_set = mode_set_lib.one_hot(motions)
    mode_set = mode_set.for_feet(config.task.robot.num_feet)
    config.task.check_modes(motions)
    if config.ppo.symmetry != 'none':
      # Raises without one.
      task_symmetry.mirror_image(mode_set, robot=config.task.robot)
    encoder = None
    if self.encoder and not start and not config.one_hot:
      encoder = mode_encoder.load(self.encoder)
      encoder.codebook().subset(mode_set.names)
    folder = self.folder
    if folder.holds_run():
      raise ValueError(
        f'{folder.path} already holds a run: add --resume (from Python '
        'resume=True), or name another folder.'
      )
    if start:
      print('Extending the mode encoder.', flush=True)
      encoder, mode_set = start.encode(motions)
    folder.path.mkdir(parents=True, exist_ok=True)
    if start:
      start.policy.save(folder.initial)
    elif not config.one_hot:
      encoder = encoder or _train_encoder(motions, config.seed)
      codebook = encoder.codebook().subset(mode_set.names)
      mode_set = mode_set_lib.ModeSet(motions, codebook)
    if encoder:
      encoder.save(folder.encoder)
    return config, mode_set

  def resume(self, ranks: int) -> run_folder.Description:
    """Reads a run; arguments that contradict it raise ValueError.

    But for `steps`, which are the run's from now on.
    """
    config, mode_set = self.folder.load()
    given = dict(self.overrides)
    given |= {
      name: value
      for name, value in (
        ('modes', self.modes),
        ('init_from', self.init_from),
      )
      if value is not None
    }
    if self.robot is not None:
      given['task_robot'] = robot_lib.find(self.robot)
    asked = run_config.overridden(config, given)
    for name, stored, wanted in run_config.differences(config, asked):
      hint = 'Leave that out to resume it, or name another folder.'
      if name == 'threads':
        hint += ' ' + self._other_threads(wanted)
      raise ValueError(
        f'The run in {self.folder.path} has {name}={stored}, not {wanted}. '
        f'{hint}'
      )
    setup.check_ranks(config, ranks)
    if self.steps is not None:
      config = dataclasses.replace(config, steps=self.steps)
    return config, mode_set

  def warn(self, config: run_config.RunConfig) -> None:
    """Warns of more threads than there are cores, on stderr."""
    cores = distributed.local_cores()
    if config.threads > cores:
      print(
        f'warning: {config.threads} threads have {cores} core'
        f'{"s" * (cores > 1)} here, which is many times slower than '
        f'threads={cores}, and stays so in this run. '
        f'{self._other_threads(cores)}',
        file=sys.stderr,
        flush=True,
      )

  def _other_threads(self, threads: int) -> str:
    """Returns the way to go on with another number of threads."""
    name = self.folder.config.name
    return _OTHER_THREADS.format(threads=threads, config=name)


def _train_encoder(motions: Motions, seed: int) -> mode_encoder.ModeEncoder:
  print('Training the mode encoder.', flush=True)
  return encoder_training.train_for(motions, seed)


@dataclasses.dataclass(frozen=True)
class _Opened:
  """A new or resumed run; complete at rank 0 only."""

  description: run_folder.Description
  has_checkpoint: bool
  is_new: bool = False
  is_changed: bool = False
  initial: policy_lib.Policy | None = None
  tensors: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
  values: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def _open(
  request: _Request, resume: bool, communicator: distributed.Communicator
) -> _Opened:
  """Opens the run at rank 0, and broadcasts its configuration."""
  folder, opened = request.folder, []

  def at_first() -> str:
    files.output_folder('run_dir', folder.path)
    is_restart = folder.config.is_file() and launch.is_restart(folder.launch)
    is_new = not (resume or is_restart)
    prepare = request.begin if is_new else request.resume
    description = prepare(communicator.size)
    request.warn(description[0])
    is_changed = is_new or description[0] != folder.load()[0]
    initial = folder.load_initial(description[0])
    tensors: Mapping[str, torch.Tensor] = {}
    values: Mapping[str, Any] = {}
    if folder.checkpointer.exists():
      tensors, values, note = folder.checkpointer.load()
      print(note or f'Resuming at {values["steps"]:,} steps.', flush=True)
    opened.append(
      _Opened(
        description, bool(values), is_new, is_changed, initial, tensors, values
      )
    )
    return json.dumps([bool(values), run_folder.describe(*description)])

  has_checkpoint, text = json.loads(
    distributed.from_first(communicator, at_first)
  )
  if opened:
    return opened[0]
  return _Opened(run_folder.parse(text), has_checkpoint)


def _build(
  request: _Request,
  resume: bool,
  device: torch.device,
  communicator: distributed.Communicator,
) -> setup.Run:
  """Builds this rank's part of a new or resumed run."""
  opened = _open(request, resume, communicator)
  run = setup.build(*opened.description, communicator, device, opened.initial)
  if opened.is_new:
    launch.note(request.folder.launch)
  if opened.is_changed:
    request.folder.save(*opened.description)
  if opened.has_checkpoint:
    run.loop.restore(opened.tensors, opened.values)
  return run


def _run(
  run: setup.Run,
  folder: run_folder.RunFolder,
  length: runner.TrainingConfig,
  wandb_project: str | None,
  communicator: distributed.Communicator,
) -> policy_lib.Policy:
  """Trains; rank 0 alone writes and prints."""
  is_first = communicator.rank == 0

  def save() -> None:
    state = run.loop.state()
    if is_first:
      folder.checkpointer.save(*state)
      run.policy().save(folder.policy)

  def keep() -> None:
    if is_first:
      run.policy().save(folder.kept_policy(run.loop.steps))

  logger = loggers.Dispatcher([])
  if is_first:
    logger = _make_logger(folder, run, length, wandb_project)
  try:
    with signals.Stop() as stop:
      run.loop.run(length, logger, save, stop, keep)
  finally:
    logger.close()
  if is_first:
    print(f'{run.loop.steps:,} steps; the policy is in {folder.policy}')
    floor = run.config.ppo.std_floor
    if run.loop.steps < floor.end:
      least, _ = run.config.ppo.std_bounds(run.loop.steps)
      print(
        f'Its actions still have a noise of at least {least:.2g} rad, which '
        f'falls to {floor.last:g} until {floor.end:,} steps (ppo_std_floor): '
        'without noise, the robot may fall. Resume it, or train anew with a '
        'schedule that ends in time.',
        file=sys.stderr,
      )
  return run.policy()


def _make_logger(
  folder: run_folder.RunFolder,
  run: setup.Run,
  length: runner.TrainingConfig,
  wandb_project: str | None,
) -> loggers.Dispatcher:
  now = run.loop.steps
  parts: list[loggers.Logger] = [
    loggers.ProgressLogger(length.steps, now, length.minutes),
    loggers.CSVLogger(folder.metrics, now),
    loggers.TensorBoardLogger(folder.tensorboard, now),
  ]
  if wandb_project:
    values = run_config.to_dict(run.config)
    parts.append(loggers.WandbLogger(folder.path, wandb_project, values))
  return loggers.Dispatcher(parts)
