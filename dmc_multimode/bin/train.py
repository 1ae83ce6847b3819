r"""Trains a policy.

    python -m dmc_multimode.bin.train \
      --flagfile=flags/quickstart.flags --run_dir=runs/quickstart

Every field of the configurations is a flag: --ppo_*, --sampling_*, --task_*.
Ctrl-C stops after the current iteration, with a checkpoint; --resume goes on
from the last checkpoint as if nothing had happened.

    python -m dmc_multimode.bin.train --init_from=pi2 \
      --mode_file=docs/squat.yaml --steps=4000000 --run_dir=runs/squat

begins with a policy, which gains modes: see docs/ADD_A_MODE.md.

Under `torchrun` in place of `python`, several processes train one policy, each
in its share of the worlds: see docs/SCALING.md.
"""

import dataclasses
import functools
import json
import pathlib
import signal
from typing import Any, Mapping, NamedTuple, Sequence

from absl import flags
import torch

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import distributed
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import fine_tuning
from dmc_multimode.experiments import launch
from dmc_multimode.experiments import ranks
from dmc_multimode.experiments import setup
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import training as encoder_training
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import symmetry as task_symmetry

_DEFAULTS = run_config.RunConfig()
_RUN_DIR = flags.DEFINE_string(
  'run_dir', None, 'Where the run lives.', required=True
)
_RESUME = flags.DEFINE_bool('resume', False, 'Go on with the run in --run_dir.')
_INIT_FROM = flags.DEFINE_string(
  'init_from',
  _DEFAULTS.init_from,
  'A policy to begin with, shipped or a folder; its task and network become '
  'defaults.',
)
_MODE_FILE = flags.DEFINE_string(
  'mode_file', None, 'YAML or JSON file of further modes.'
)
_ENCODER = flags.DEFINE_string(
  'encoder',
  None,
  'Folder of a trained encoder; trained first if not given. With --init_from '
  'that of the policy, by default the one that is beside it.',
)
_MODES = flags.DEFINE_string(
  'modes',
  _DEFAULTS.modes,
  'Name of a mode set, or comma-separated modes. With --init_from by default '
  'those of the policy and of --mode_file.',
)
_SEED = flags.DEFINE_integer('seed', _DEFAULTS.seed, 'Of all randomness.')
_NUM_WORLDS = flags.DEFINE_integer(
  'num_worlds',
  _DEFAULTS.num_worlds,
  'Worlds that are stepped together, by all processes.',
)
_THREADS = flags.DEFINE_integer(
  'threads',
  distributed.local_cores(),
  'Threads of the physics and of torch, in each process.',
)
_DEVICE = flags.DEFINE_enum(
  'device', 'cpu', ['cpu', 'cuda'], 'Where networks are, and learn.'
)
_ONE_HOT = flags.DEFINE_bool(
  'one_hot', _DEFAULTS.one_hot, 'One-hot commands instead of latents.'
)
_WANDB_PROJECT = flags.DEFINE_string(
  'wandb_project', None, 'Also log to this project of Weights and Biases.'
)
_LENGTH = runner.TrainingConfig()
_STEPS = flags.DEFINE_integer('steps', _LENGTH.steps, 'Control steps in all.')
_MINUTES = flags.DEFINE_float(
  'minutes', _LENGTH.minutes, 'Stop after this time, with a checkpoint.'
)
_KEEP_EVERY = flags.DEFINE_integer(
  'keep_every',
  _LENGTH.keep_every,
  'Control steps between policies kept in RUN_DIR/policies; 0: none.',
)
# Fields of `RunConfig`: those that are one flag, and those of many fields, each
# of which is one.
_SIMPLE = ('modes', 'seed', 'num_worlds', 'threads', 'one_hot', 'init_from')
_PARTS = ('ppo', 'sampling', 'task')
for _part in _PARTS:
  config_flags.define(getattr(_DEFAULTS, _part), _part)


def _with_flags(config: run_config.RunConfig) -> run_config.RunConfig:
  """Returns a configuration with what the flags that were given say."""
  given: dict[str, Any] = {
    part: config_flags.read(getattr(config, part), part) for part in _PARTS
  }
  for name in _SIMPLE:
    if flags.FLAGS[name].present:
      given[name] = flags.FLAGS[name].value
  return dataclasses.replace(config, **given)


def _configure(
  start: fine_tuning.Start | None,
) -> tuple[run_config.RunConfig, tuple[motion_lib.ReferenceMotion, ...]]:
  """Returns configuration and modes of a new run, as the flags say."""
  extra = mode_files.load(_MODE_FILE.value) if _MODE_FILE.value else ()
  defaults = _DEFAULTS
  if start:
    spec = _MODES.value if flags.FLAGS['modes'].present else None
    motions = start.modes(spec, extra)
    defaults = start.config(motions, _STEPS.value)
  config = _with_flags(dataclasses.replace(defaults, threads=_THREADS.value))
  if start:
    start.check(config)
    return config, motions
  return config, library.resolve(config.modes, extra)


def _begin(directory: pathlib.Path, size: int) -> setup.Ingredients:
  """Checks everything, then makes the folder and the encoder of a new run."""
  start = None
  if _INIT_FROM.value:
    start = fine_tuning.load(_INIT_FROM.value, _ENCODER.value)
  config, motions = _configure(start)
  setup.check_ranks(config, size)
  mode_set = mode_set_lib.one_hot(motions)
  if config.ppo.symmetry != 'none':
    task_symmetry.mirror_image(mode_set)  # Raises where there is none.
  encoder = None
  if _ENCODER.value and not start and not config.one_hot:
    encoder = mode_encoder.load(_ENCODER.value)
    encoder.codebook().subset(mode_set.names)
  if (directory / setup.CONFIG_FILE).exists() or checkpointing.Checkpointer(
    directory
  ).exists():
    raise ValueError(
      f'{directory} already holds a run: add --resume, or name another folder.'
    )
  if start:
    print('Extending the mode encoder.', flush=True)
    encoder, mode_set = start.encode(motions)
  directory.mkdir(parents=True, exist_ok=True)
  if start:
    start.policy.save(directory / setup.INITIAL)
  elif not config.one_hot:
    encoder = encoder or _train_encoder(motions, config.seed)
    codebook = encoder.codebook().subset(mode_set.names)
    mode_set = mode_set_lib.ModeSet(motions, codebook)
  if encoder:
    encoder.save(directory / setup.ENCODER)
  return config, mode_set


def _train_encoder(
  motions: tuple[motion_lib.ReferenceMotion, ...], seed: int
) -> mode_encoder.ModeEncoder:
  print('Training the mode encoder.', flush=True)
  contacts = encoder_training.needs_contacts(motions)
  return encoder_training.train(
    motions, mode_encoder.EncoderConfig(use_contacts=contacts, seed=seed)
  )


def _continue(directory: pathlib.Path, size: int) -> setup.Ingredients:
  """Reads a run back; flags that contradict it are an error."""
  config, mode_set = setup.load_run(directory)
  stored = run_config.to_dict(config)
  wanted = run_config.to_dict(_with_flags(config))
  for name, value in wanted.items():
    if value != stored[name]:
      raise ValueError(
        f'The run in {directory} has another {name} than these flags say: '
        'leave them out to resume it, or name another folder.'
      )
  setup.check_ranks(config, size)
  return config, mode_set


class _Opened(NamedTuple):
  """A run that begins or goes on; rank 0 alone knows all of it."""

  ingredients: setup.Ingredients
  has_checkpoint: bool
  is_new: bool = False
  initial: policy_lib.Policy | None = None
  tensors: Mapping[str, torch.Tensor] = {}
  values: Mapping[str, Any] = {}


def _open(
  directory: pathlib.Path, communicator: distributed.Communicator
) -> _Opened:
  """Opens the run at rank 0, which tells the others what they need of it."""
  opened = []

  def at_first() -> str:
    if _WANDB_PROJECT.value:
      loggers.check_wandb()
    is_new = not (_RESUME.value or launch.is_restart(directory))
    prepare = _begin if is_new else _continue
    ingredients = prepare(directory, communicator.size)
    initial = setup.load_initial(directory, ingredients[0])
    tensors: Mapping[str, torch.Tensor] = {}
    values: Mapping[str, Any] = {}
    checkpointer = checkpointing.Checkpointer(directory)
    if checkpointer.exists():
      tensors, values, note = checkpointer.load()
      print(note or f'Resuming at {values["steps"]:,} steps.', flush=True)
    opened.append(
      _Opened(ingredients, bool(values), is_new, initial, tensors, values)
    )
    return json.dumps([bool(values), setup.describe(*ingredients)])

  has_checkpoint, text = json.loads(
    distributed.from_first(communicator, at_first)
  )
  if opened:
    return opened[0]
  return _Opened(setup.parse(text), has_checkpoint)


class _Stop:
  """Asks the loop to end at the first SIGINT or SIGTERM."""

  def __init__(self) -> None:
    self.asked = False
    for number in (signal.SIGINT, signal.SIGTERM):
      signal.signal(number, self._handle)

  def _handle(self, number: int, frame: Any) -> None:
    del frame
    self.asked = True
    # A second signal ends the process at once.
    signal.signal(number, signal.SIG_DFL)

  def __call__(self) -> bool:
    return self.asked


def _make_logger(directory: pathlib.Path, run: setup.Run) -> loggers.Dispatcher:
  steps = run.loop.steps
  parts: list[loggers.Logger] = [
    loggers.ProgressLogger(_STEPS.value, steps),
    loggers.CSVLogger(directory / 'metrics.csv', steps),
    loggers.TensorBoardLogger(directory / 'tensorboard', steps),
  ]
  if _WANDB_PROJECT.value:
    parts.append(
      loggers.WandbLogger(
        directory, _WANDB_PROJECT.value, run_config.to_dict(run.config)
      )
    )
  return loggers.Dispatcher(parts)


def _build(
  directory: pathlib.Path,
  device: torch.device,
  communicator: distributed.Communicator,
) -> setup.Run:
  """Builds this rank's part of a new run, or of one that goes on."""
  opened = _open(directory, communicator)
  run = setup.build(*opened.ingredients, communicator, device, opened.initial)
  if opened.is_new:
    launch.note(directory)
    setup.save_run(directory, *opened.ingredients)
  if opened.has_checkpoint:
    run.loop.restore(opened.tensors, opened.values)
  return run


def _train(
  device: torch.device, communicator: distributed.Communicator
) -> None:
  """Trains or resumes; rank 0 alone writes and prints."""
  length = runner.TrainingConfig(
    _STEPS.value, _MINUTES.value, keep_every=_KEEP_EVERY.value
  )
  if not _RUN_DIR.value:
    raise ValueError('--run_dir must name a folder.')
  directory = pathlib.Path(_RUN_DIR.value)
  run = _build(directory, device, communicator)
  is_first = communicator.rank == 0
  checkpointer = checkpointing.Checkpointer(directory)

  def save() -> None:
    state = run.loop.state()
    if is_first:
      checkpointer.save(*state)
      run.policy().save(directory / 'policy')

  def keep() -> None:
    if is_first:
      run.policy().save(directory / 'policies' / str(run.loop.steps))

  stop = _Stop()
  logger = loggers.Dispatcher([])
  if is_first:
    logger = _make_logger(directory, run)
  try:
    run.loop.run(length, logger, save, stop, keep)
  finally:
    logger.close()
  if is_first:
    print(f'{run.loop.steps:,} steps; the policy is in {directory / "policy"}')


def main(argv: Sequence[str]) -> int:
  """Trains or resumes, with the other ranks if there are any."""
  del argv
  device = distributed.find_device(_DEVICE.value)
  return ranks.run(functools.partial(_train, device), device)


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
