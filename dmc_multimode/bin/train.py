r"""Trains a policy.

    python -m dmc_multimode.bin.train \
      --flagfile=flags/quickstart.flags --run_dir=runs/quickstart

Every field of the configurations is a flag, which --helpfull explains: --ppo_*,
--sampling_*, --task_*. A value that changes along the training is a schedule
`FIRST[:LAST][@START[:END]]` over environment steps, such as 0:0.5@8e6.
Ctrl-C stops after the current iteration, with a checkpoint; --resume continues
from the last checkpoint, bit for bit.

    python -m dmc_multimode.bin.train --init_from=pi2 \
      --mode_file=docs/squat.yaml --steps=4000000 --run_dir=runs/squat

fine-tunes a policy with new modes: see docs/ADD_A_MODE.md.

Under `torchrun` in place of `python`, several processes train one policy, each
with a share of the worlds: see docs/SCALING.md.
"""

import functools
from typing import Any, Sequence

from absl import flags
import torch

from dmc_multimode.agents import distributed
from dmc_multimode.agents import runner
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import launch
from dmc_multimode.experiments import training

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
_STEPS = flags.DEFINE_integer(
  'steps', _LENGTH.steps, 'Environment steps in all.'
)
_MINUTES = flags.DEFINE_float(
  'minutes', _LENGTH.minutes, 'Stop after this time, with a checkpoint.'
)
_KEEP_EVERY = flags.DEFINE_integer(
  'keep_every',
  _LENGTH.keep_every,
  'Environment steps between policies kept in RUN_DIR/policies; 0: none.',
)
# Fields of `RunConfig` that are one flag, and nested configurations, whose
# fields are flags.
_SIMPLE = ('seed', 'num_worlds', 'threads', 'one_hot')
_PARTS = ('ppo', 'sampling', 'task')
for _part in _PARTS:
  config_flags.define(getattr(_DEFAULTS, _part), _part)


def _given() -> dict[str, Any]:
  """Returns the values of the given flags of `RunConfig`."""
  values = {
    name: flags.FLAGS[name].value
    for name in ('modes', *_SIMPLE)
    if flags.FLAGS[name].present
  }
  for part in _PARTS:
    values |= config_flags.given(getattr(_DEFAULTS, part), part)
  return values


def _train(
  device: torch.device, communicator: distributed.Communicator
) -> None:
  if not _RUN_DIR.value:
    raise ValueError('--run_dir must name a folder.')
  training.train(
    _RUN_DIR.value,
    steps=_STEPS.value,
    resume=_RESUME.value,
    init_from=_INIT_FROM.value or None,
    mode_file=_MODE_FILE.value or None,
    encoder=_ENCODER.value or None,
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
  device = distributed.find_device(_DEVICE.value)
  return launch.run(functools.partial(_train, device), device)


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
