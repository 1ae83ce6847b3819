r"""Trains a policy.

    python -m dmc_multimode.bin.train \
      --flagfile=flags/quickstart.flags --run_dir=runs/quickstart

Every field of the configurations is a flag: --ppo_*, --sampling_*, --task_*.
Ctrl-C stops after the current iteration, with a checkpoint; --resume goes on
from the last checkpoint as if nothing had happened.
"""

import os
import pathlib
import signal
from typing import Any, Sequence

from absl import flags

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import loggers
from dmc_multimode.agents import training
from dmc_multimode.bin import app
from dmc_multimode.bin import config_flags
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
  'num_worlds', _DEFAULTS.num_worlds, 'Worlds that are stepped together.'
)
_THREADS = flags.DEFINE_integer(
  'threads', os.cpu_count() or 1, 'Threads of the physics and of torch.'
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

_Ingredients = tuple[
  run_setup.RunConfig,
  tuple[reference.ReferenceMotion, ...],
  codebook_lib.Codebook,
]


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


def _begin(directory: pathlib.Path) -> _Ingredients:
  """Checks everything, then makes the folder and the encoder of a new run."""
  config = _config_from_flags()
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


def _continue(directory: pathlib.Path) -> _Ingredients:
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
  return config, motions, codebook


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


def main(argv: Sequence[str]) -> None:
  """Trains or resumes."""
  del argv
  length = training.TrainingConfig(
    _STEPS.value, _MINUTES.value, keep_every=_KEEP_EVERY.value
  )
  if not _RUN_DIR.value:
    raise ValueError('--run_dir must name a folder.')
  directory = pathlib.Path(_RUN_DIR.value)
  config, motions, codebook = (
    _continue(directory) if _RESUME.value else _begin(directory)
  )
  run = run_setup.build(config, motions, codebook)
  if not _RESUME.value:
    run_setup.save_run(directory, config, motions, codebook)
  checkpointer = checkpointing.Checkpointer(directory)
  if checkpointer.exists():
    tensors, values, note = checkpointer.load()
    print(note or f'Resuming at {values["steps"]:,} steps.', flush=True)
    run.loop.restore(tensors, values)

  def save() -> None:
    checkpointer.save(*run.loop.state())
    run.policy().save(directory / 'policy')

  def keep() -> None:
    run.policy().save(directory / 'policies' / str(run.loop.steps))

  stop = _Stop()
  logger = _make_logger(directory, run.loop.steps)
  try:
    run.loop.run(length, logger, save, stop, keep)
  finally:
    logger.close()
  print(f'{run.loop.steps:,} steps; the policy is in {directory / "policy"}')


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
