r"""Trains a policy.

    python -m dmc_multimode.bin.train \
      --flagfile=flags/quickstart.flags --run_dir=runs/quickstart

Every field of the configurations is a flag: --ppo_*, --sampling_*, --task_*.
Ctrl-C stops after the current iteration, with a checkpoint; --resume goes on
from the last checkpoint as if nothing had happened.

Under `torchrun` in place of `python`, several processes train one policy, each
in its share of the worlds: see docs/SCALING.md.
"""

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
from dmc_multimode.agents import training
from dmc_multimode.bin import app
from dmc_multimode.bin import config_flags
from dmc_multimode.bin import launches
from dmc_multimode.bin import ranks
from dmc_multimode.bin import run_setup
from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import encoder as encoder_lib
from dmc_multimode.modes import files
from dmc_multimode.modes import library
from dmc_multimode.modes import reference
from dmc_multimode.suite import mirror

_DEFAULTS = run_setup.RunConfig()
_RUN_DIR = flags.DEFINE_string(
  'run_dir', None, 'Where the run lives.', required=True
)
_RESUME = flags.DEFINE_bool('resume', False, 'Go on with the run in --run_dir.')
_MODE_FILE = flags.DEFINE_string(
  'mode_file', None, 'YAML or JSON file of further modes.'
)
_ENCODER = flags.DEFINE_string(
  'encoder', None, 'Folder of a trained encoder; trained first if not given.'
)
_MODES = flags.DEFINE_string(
  'modes', _DEFAULTS.modes, 'Name of a mode set, or comma-separated modes.'
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
_LENGTH = training.TrainingConfig()
_STEPS = flags.DEFINE_integer('steps', _LENGTH.steps, 'Control steps in all.')
_MINUTES = flags.DEFINE_float(
  'minutes', _LENGTH.minutes, 'Stop after this time, with a checkpoint.'
)
_KEEP_EVERY = flags.DEFINE_integer(
  'keep_every',
  _LENGTH.keep_every,
  'Control steps between policies kept in RUN_DIR/policies; 0: none.',
)
for _part in ('ppo', 'sampling', 'task'):
  config_flags.define(getattr(_DEFAULTS, _part), _part)


def _config_from_flags() -> run_setup.RunConfig:
  parts: dict[str, Any] = {
    part: config_flags.read(getattr(_DEFAULTS, part), part)
    for part in ('ppo', 'sampling', 'task')
  }
  return run_setup.RunConfig(
    modes=_MODES.value,
    seed=_SEED.value,
    num_worlds=_NUM_WORLDS.value,
    threads=int(_THREADS.value),
    one_hot=_ONE_HOT.value,
    **parts,
  )


def _begin(directory: pathlib.Path, size: int) -> run_setup.Ingredients:
  """Checks everything, then makes the folder and the encoder of a new run."""
  config = _config_from_flags()
  run_setup.check_ranks(config, size)
  extra = files.load(_MODE_FILE.value) if _MODE_FILE.value else ()
  motions = library.resolve(config.modes, extra)
  codebook = codebook_lib.one_hot(motions)
  if config.ppo.symmetry != 'none':
    mirror.mirror_image(motions, codebook)  # Raises where there is none.
  encoder = None
  if _ENCODER.value and not config.one_hot:
    encoder = encoder_lib.load(_ENCODER.value)
    encoder.codebook().subset(codebook.names)
  if (directory / run_setup.CONFIG_FILE).exists() or checkpointing.Checkpointer(
    directory
  ).exists():
    raise ValueError(
      f'{directory} already holds a run: add --resume, or name another folder.'
    )
  directory.mkdir(parents=True, exist_ok=True)
  if config.one_hot:
    return config, motions, codebook
  encoder = encoder or _train_encoder(motions, config.seed)
  encoder.save(directory / 'encoder')
  return config, motions, encoder.codebook().subset(codebook.names)


def _train_encoder(
  motions: tuple[reference.ReferenceMotion, ...], seed: int
) -> encoder_lib.ModeEncoder:
  print('Training the mode encoder.', flush=True)
  contacts = encoder_lib.needs_contacts(motions)
  return encoder_lib.train(
    motions, encoder_lib.EncoderConfig(use_contacts=contacts, seed=seed)
  )


def _continue(directory: pathlib.Path, size: int) -> run_setup.Ingredients:
  """Reads a run back; flags that contradict it are an error."""
  config, motions, codebook = run_setup.load_run(directory)
  wanted = run_setup.to_dict(_config_from_flags())
  stored = run_setup.to_dict(config)
  simple = ('modes', 'seed', 'num_worlds', 'threads', 'one_hot')
  different = [
    name
    for name in simple
    if flags.FLAGS[name].present and wanted[name] != stored[name]
  ]
  for part in ('ppo', 'sampling', 'task'):
    if config_flags.overrides(getattr(_DEFAULTS, part), part):
      different += [part] if wanted[part] != stored[part] else []
  if different:
    raise ValueError(
      f'The run in {directory} has another {different[0]} than these flags '
      'say: leave them out to resume it, or name another folder.'
    )
  run_setup.check_ranks(config, size)
  return config, motions, codebook


class _Opened(NamedTuple):
  """A run that begins or goes on; its checkpoint is known to rank 0 alone."""

  ingredients: run_setup.Ingredients
  is_new: bool
  has_checkpoint: bool
  tensors: Mapping[str, torch.Tensor]
  values: Mapping[str, Any]


def _open(
  directory: pathlib.Path, communicator: distributed.Communicator
) -> _Opened:
  """Opens the run at rank 0, which tells the others what they need of it."""
  opened = []

  def at_first() -> str:
    is_new = not (_RESUME.value or launches.is_restart(directory))
    prepare = _begin if is_new else _continue
    ingredients = prepare(directory, communicator.size)
    tensors: Mapping[str, torch.Tensor] = {}
    values: Mapping[str, Any] = {}
    checkpointer = checkpointing.Checkpointer(directory)
    if checkpointer.exists():
      tensors, values, note = checkpointer.load()
      print(note or f'Resuming at {values["steps"]:,} steps.', flush=True)
    opened.append(_Opened(ingredients, is_new, bool(values), tensors, values))
    return json.dumps([bool(values), run_setup.describe(*ingredients)])

  has_checkpoint, text = json.loads(
    distributed.from_first(communicator, at_first)
  )
  if opened:
    return opened[0]
  return _Opened(run_setup.parse(text), False, has_checkpoint, {}, {})


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


def _make_logger(directory: pathlib.Path, steps: int) -> loggers.Dispatcher:
  return loggers.Dispatcher(
    [
      loggers.ProgressLogger(_STEPS.value, steps),
      loggers.CSVLogger(directory / 'metrics.csv', steps),
      loggers.TensorBoardLogger(directory / 'tensorboard', steps),
    ]
  )


def _build(
  directory: pathlib.Path,
  device: torch.device,
  communicator: distributed.Communicator,
) -> run_setup.Run:
  """Builds this rank's part of a new run, or of one that goes on."""
  opened = _open(directory, communicator)
  run = run_setup.build(*opened.ingredients, communicator, device)
  if opened.is_new:
    launches.note(directory)
    run_setup.save_run(directory, *opened.ingredients)
  if opened.has_checkpoint:
    run.loop.restore(opened.tensors, opened.values)
  return run


def _train(
  device: torch.device, communicator: distributed.Communicator
) -> None:
  """Trains or resumes; rank 0 alone writes and prints."""
  length = training.TrainingConfig(
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
    logger = _make_logger(directory, run.loop.steps)
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
