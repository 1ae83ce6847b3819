r"""Trains a policy.

    python -m dmc_multimode.bin.train \
      --flagfile=flags/quickstart.flags --run_dir=runs/quickstart

Every field of the configurations is a flag, which --help explains: --ppo_*,
--sampling_*, --task_*. A value that changes along the training is a schedule
`FIRST[:LAST][@START[:END]]` over environment steps, such as 0:0.5@8e6.
Ctrl-C stops after the current iteration, with a checkpoint; --resume continues
from the last checkpoint, bit for bit, to the length that the run was given, or
is now by --steps.

    python -m dmc_multimode.bin.train --init_from=pi2 \
      --mode_file=docs/squat.yaml --steps=4000000 --run_dir=runs/squat

fine-tunes a policy with new modes: see docs/ADD_A_MODE.md.

Under `torchrun` in place of `python`, several processes train one policy, each
with a share of the worlds: see docs/SCALING.md.
"""

import functools
import math
from typing import Any, Sequence, TYPE_CHECKING

from absl import flags

from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.pretrained import folder

if TYPE_CHECKING:
  import torch

  from dmc_multimode.agents import distributed

_RUN_DIR = config_flags.define_path(
  'run_dir', None, 'Where the run lives.', required=True
)
_RESUME = flags.DEFINE_bool('resume', False, 'Go on with the run in --run_dir.')
_INIT_FROM = config_flags.define_path(
  'init_from',
  None,
  'A policy to begin with, shipped or a folder; its network and its task, '
  'without pushes, disturbances and sensor noise, become defaults.',
)
_MODE_FILE = config_flags.define_path(
  'mode_file', None, 'YAML or JSON file of further modes.'
)
_ENCODER = config_flags.define_path(
  'encoder',
  None,
  'Folder of a trained encoder; trained first if not given. With --init_from '
  'that of the policy, by default the one that is beside it.',
)
_MODES = flags.DEFINE_string(
  'modes',
  None,
  'Name of a mode set, or comma-separated modes; quickstart by default. With '
  '--init_from by default those of the policy and of --mode_file.',
)
_ROBOT = config_flags.define_path(
  'robot',
  None,
  'YAML or JSON file of a robot; the mini biped by default, or that of the '
  'policy or run to go on with.',
)
_DEVICE = flags.DEFINE_enum(
  'device', 'cpu', ['cpu', 'cuda'], 'Where networks are, and learn.'
)
_WANDB_PROJECT = flags.DEFINE_string(
  'wandb_project', None, 'Also log to this project of Weights and Biases.'
)
_MINUTES = flags.DEFINE_float(
  'minutes',
  math.inf,
  'Stop after this time, with a checkpoint; see --ppo_std_floor.',
)
_KEEP_EVERY = flags.DEFINE_integer(
  'keep_every',
  0,
  'Environment steps between policies kept in RUN_DIR/policies; 0: none.',
)


def _check_modes() -> None:
  """Raises ValueError for unknown modes."""
  known = mode_files.load(_MODE_FILE.value) if _MODE_FILE.value else ()
  if _INIT_FROM.value:
    known += folder.mode_set(_INIT_FROM.value).motions
  if _MODES.value and not _RESUME.value:
    library.resolve(_MODES.value, known)


def _define_settings() -> None:
  """Defines the flags of the fields of `RunConfig`."""
  config_flags.define_settings()


def _given() -> dict[str, Any]:
  """Returns the values of the given flags of `RunConfig`."""
  values = config_flags.given_settings()
  return values | ({'modes': _MODES.value} if _MODES.value else {})


def _train(
  device: 'torch.device', communicator: 'distributed.Communicator'
) -> None:
  from dmc_multimode.experiments import training

  training.train(
    _RUN_DIR.value,
    resume=_RESUME.value,
    init_from=_INIT_FROM.value or None,
    mode_file=_MODE_FILE.value or None,
    encoder=_ENCODER.value or None,
    robot=_ROBOT.value or None,
    minutes=_MINUTES.value,
    keep_every=_KEEP_EVERY.value,
    device=device,
    wandb_project=_WANDB_PROJECT.value,
    communicator=communicator,
    **_given(),
  )


def main(argv: Sequence[str]) -> int:
  """Trains or resumes, with the other ranks if there are any."""
  del argv
  if not _RUN_DIR.value:
    raise ValueError('--run_dir must name a folder.')
  # Late, as they import torch.
  from dmc_multimode.agents import distributed
  from dmc_multimode.experiments import launch

  device = distributed.find_device(_DEVICE.value)
  return launch.run(functools.partial(_train, device), device)


def cli() -> None:
  """Console script."""
  app.run(main, check=_check_modes, define=_define_settings)


if __name__ == '__main__':
  cli()
