r"""Searches settings of a training, by Optuna (extra `sweep`).

  python -m dmc_multimode.bin.sweep --flagfile=flags/quickstart.flags \
    --steps=1000000 --search=ppo_learning_rate:1e-4..1e-3 \
    --search="ppo_activation:elu|silu" --trials=20 --run_dir=runs/sweep

trains 20 policies, scores each by a deterministic evaluation, and writes
sweep.csv, sweep.txt and sweep.png into the folder, best first. All other flags
are those of `train`. The same command goes on with a sweep that was stopped;
given a second time at once, also on another machine that shares the folder and
locks its files, it is a second worker.
"""

from typing import Sequence

from absl import flags

from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library

_RUN_DIR = config_flags.define_path(
  'run_dir', None, 'Where the sweep lives.', required=True
)
_SEARCH = flags.DEFINE_multi_string(
  'search',
  None,
  'NAME:LOW..HIGH or NAME:A|B|C, of a flag of `train`; may be given again.',
  required=True,
)
_TRIALS = flags.DEFINE_integer(
  'trials', 20, 'Trainings in all, of all workers.', lower_bound=1
)
_OBJECTIVE = flags.DEFINE_string(
  'objective',
  'mra_transitions',
  'Score to maximise: mra_transitions, mra_modes, survival_transitions or '
  'survival_modes.',
)
_EPISODES = flags.DEFINE_integer(
  'episodes', 1, 'Of the evaluation, as in `evaluate`.', lower_bound=1
)
_SAMPLER_SEED = flags.DEFINE_integer('sampler_seed', 0, "Of Optuna's sampler.")
_MODES = flags.DEFINE_string(
  'modes', None, 'Name of a mode set, or comma-separated modes.'
)
_MODE_FILE = config_flags.define_path(
  'mode_file', None, 'YAML or JSON file of further modes.'
)
_ROBOT = config_flags.define_path(
  'robot', None, 'File of a robot; the mini biped by default.'
)


def _check_modes() -> None:
  """Raises ValueError for unknown modes."""
  known = mode_files.load(_MODE_FILE.value) if _MODE_FILE.value else ()
  if _MODES.value:
    library.resolve(_MODES.value, known)


def _define_settings() -> None:
  """Defines the flags of the fields of `RunConfig`."""
  config_flags.define_settings()


def main(argv: Sequence[str]) -> None:
  """Searches; `argv` holds no flags."""
  del argv
  from dmc_multimode.experiments import sweeping

  sweeping.sweep(
    _RUN_DIR.value,
    _SEARCH.value,
    _TRIALS.value,
    _OBJECTIVE.value,
    _EPISODES.value,
    _SAMPLER_SEED.value,
    modes=_MODES.value,
    mode_file=_MODE_FILE.value or None,
    robot=_ROBOT.value or None,
    **config_flags.given_settings(),
  )


def cli() -> None:
  """Console script."""
  app.run(main, check=_check_modes, define=_define_settings)


if __name__ == '__main__':
  cli()
