r"""Trains a mode selector: a network that commands modes from what it sees.

    python -m dmc_multimode.bin.train_selector --policy=pi2 --arena=parkour \
      --run_dir=runs/selector

A low-level policy turns modes into motion on random tracks; the selector learns
by PPO to command it to the goal. `plan --planner=selector` runs it. Every field
of the configurations is a flag, which --help explains: --learning_*,
--task_*. Ctrl-C ends it, and --resume continues from the last checkpoint.
"""

import math
from typing import Any, Sequence

from absl import flags

from dmc_multimode.arenas import layouts
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags

_RUN_DIR = config_flags.define_path(
  'run_dir', None, 'Where the run lives.', required=True
)
_RESUME = flags.DEFINE_bool('resume', False, 'Go on with the run in --run_dir.')
_MINUTES = flags.DEFINE_float(
  'minutes', math.inf, 'Stop after this time, with a checkpoint.'
)
_POLICY = config_flags.define_path(
  'policy', 'pi2', 'Name of a shipped low-level policy, or a folder.'
)
_ARENA = flags.DEFINE_string(
  'arena',
  'parkour',
  f'{", ".join(layouts.NAMES)}; or several, joined by +, one an episode.',
)
_SIZES = config_flags.define_sizes()
_INIT_FROM = config_flags.define_path(
  'init_from', '', 'Folder of a selector to go on from; from scratch if none.'
)
# Fields of `SelectorConfig` that are one flag, and nested configurations.
_SIMPLE = (
  *('policy', 'arena', 'decisions', 'seed', 'num_worlds', 'threads'),
  'init_from',
)
_PARTS = ('learning', 'task')


def _define_settings() -> None:
  """Defines the flags of the fields of `SelectorConfig`."""
  from dmc_multimode.experiments import selector_training

  defaults = selector_training.SelectorConfig()
  for name, text in (
    ('decisions', 'Choices of modes in all, summed over all worlds.'),
    ('seed', 'Of all randomness.'),
    ('num_worlds', 'Worlds that are stepped together.'),
    ('threads', 'Of the physics.'),
  ):
    flags.DEFINE_integer(name, getattr(defaults, name), text)
  for part in _PARTS:
    config_flags.define(getattr(defaults, part), part)


def _given() -> dict[str, Any]:
  """Returns the values of the given flags of `SelectorConfig`."""
  from dmc_multimode.experiments import selector_training

  values = {
    name: flags.FLAGS[name].value
    for name in _SIMPLE
    if flags.FLAGS[name].present
  }
  if _SIZES.present:
    values['sizes'] = config_flags.read_sizes(_SIZES.value)
  defaults = selector_training.SelectorConfig()
  for part in _PARTS:
    values |= config_flags.given(getattr(defaults, part), part)
  return values


def main(argv: Sequence[str]) -> None:
  """Trains or resumes; `argv` holds no flags."""
  del argv
  if not _RUN_DIR.value:
    raise ValueError('--run_dir must name a folder.')
  # Late, as it imports torch.
  from dmc_multimode.experiments import selector_training

  selector_training.train(
    _RUN_DIR.value,
    resume=_RESUME.value,
    minutes=_MINUTES.value,
    **_given(),
  )


def cli() -> None:
  """Runs as a console script."""
  app.run(main, define=_define_settings)


if __name__ == '__main__':
  cli()
