r"""Makes a shipped policy of a training run.

    python -m benchmarks.release.ship --run_dir=runs/pi3 --name=pi3

Copies the policy and the encoder to `dmc_multimode/pretrained/NAME`, the
learning curves with fewer rows, and evaluates the policy there. With --steps it
is one of those that the run kept (--keep_every) instead of the last.
"""

import pathlib
import subprocess
import sys
import tempfile
from typing import Sequence

from absl import flags

from benchmarks.release import shipping
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.pretrained import policy as policy_lib

_RUN_DIR = flags.DEFINE_string('run_dir', None, 'The run.', required=True)
_NAME = flags.DEFINE_string('name', None, 'Of the policy.', required=True)
_STEPS = flags.DEFINE_integer(
  'steps', None, 'Which of the policies that the run kept; its last if none.'
)
_CURVE_EVERY = flags.DEFINE_integer(
  'curve_every', 100_000, 'Control steps between rows of the curves.', 1
)
_EPISODES = flags.DEFINE_integer('episodes', 4, 'Like those of `evaluate`.', 1)


def main(argv: Sequence[str]) -> None:
  """Copies, then evaluates."""
  del argv
  run = pathlib.Path(_RUN_DIR.value)
  policy = run / policy_lib.RUN_SUBFOLDER
  if _STEPS.value is not None:
    policy = run / 'policies' / str(_STEPS.value)
  if not _NAME.value.isidentifier():
    raise ValueError(f'--name={_NAME.value} is no name for a folder.')
  files = shipping.gather(run, policy, _CURVE_EVERY.value)
  pretrained.load(policy)  # Raises where it is damaged.
  with tempfile.TemporaryDirectory() as scratch:
    report = pathlib.Path(scratch) / policy_lib.METRICS_FILE
    subprocess.run(
      [
        *(sys.executable, '-m', 'dmc_multimode.bin.evaluate'),
        f'--policy={policy}',
        f'--episodes={_EPISODES.value}',
        f'--out={report}',
      ],
      check=True,
    )
    files[report.name] = report.read_bytes()
  # Only now: what was shipped before stays until all is there.
  folder = shipping.folder(_NAME.value)
  shipping.write(files, folder)
  print(f'Shipped in {folder}')


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
