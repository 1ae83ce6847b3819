r"""Makes a shipped policy of a training run.

    python -m benchmarks.release.ship --run_dir=runs/pi3 --name=pi3

Copies the policy and the encoder to `dmc_multimode/pretrained/NAME`, the
learning curves with fewer rows, evaluates the policy there, and writes its
card, README.md. With --steps it is one of those that the run kept
(--keep_every) instead of the last.

    python -m benchmarks.release.ship --selector --run_dir=RUN --name=pi2

copies the selector that `train_selector` made for the shipped pi2 beside it. A
policy that is shipped anew has none: a selector fits one policy.
"""

import csv
import functools
import io
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile
from typing import Sequence

from absl import flags

from benchmarks.release import cards
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import run_folder
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import steering
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.utils import files as files_lib

_RUN_DIR = config_flags.define_path('run_dir', None, 'The run.', required=True)
_NAME = flags.DEFINE_string('name', None, 'Of the policy.', required=True)
_STEPS = flags.DEFINE_integer(
  'steps', None, 'Which of the policies that the run kept; its last if none.'
)
_CURVE_EVERY = flags.DEFINE_integer(
  'curve_every', 100_000, 'Control steps between rows of the curves.', 1
)
_EPISODES = flags.DEFINE_integer('episodes', 4, 'Like those of `evaluate`.', 1)
_SELECTOR = flags.DEFINE_bool('selector', False, 'A selector, and no policy.')
TRAINING_FILE = 'training.csv'
_DIGITS = 4  # Significant ones of a curve.
_IDENTITY = ('modes', 'seed', 'one_hot')  # What no run changes on its way.


def shipped_folder(name: str) -> pathlib.Path:
  """Returns where a policy of that name is shipped, or will be."""
  return pathlib.Path(pretrained.__file__).parent / name


def thinned(text: str, every: int, until: int) -> str:
  """Returns the metrics of a run with fewer rows and digits.

  Args:
    text: of a `metrics.csv`, with a column `steps`.
    every: control steps between two rows; the last row always stays.
    until: control steps of the policy; rows from after it are left out.

  Raises:
    ValueError: the text holds no such metrics.
  """
  header, *rows = list(csv.reader(io.StringIO(text))) or [[]]
  known = header[:1] == ['steps']
  rows = [row for row in rows if known and float(row[0]) <= until]
  if not rows:
    raise ValueError('These are not the metrics of a run.')
  kept, due = [header], 0.0
  for row in rows:
    if float(row[0]) >= due or row is rows[-1]:
      kept.append([row[0], *(f'{float(cell):.{_DIGITS}g}' for cell in row[1:])])
      due = float(row[0]) + every
  written = io.StringIO()
  csv.writer(written, lineterminator='\n').writerows(kept)
  return written.getvalue()


def gather(
  run: pathlib.Path, policy: pathlib.Path, every: int
) -> dict[str, bytes]:
  """Returns the files of a shipped policy by name, but for its metrics.

  Args:
    run: folder of the training run.
    policy: folder of the policy, the run's last or one that it kept.
    every: as for `thinned`.

  Raises:
    FileNotFoundError: the run or the policy lacks a file.
    ValueError: the policy is of another run, or the curves are damaged.
  """
  files = {
    path.name: path.read_bytes()
    for part in (policy, run / 'encoder')
    if part.is_dir()
    for path in sorted(part.iterdir())
    if path.suffix in ('.json', '.safetensors')
  }
  if 'policy.json' not in files:
    raise FileNotFoundError(f'{policy} holds no policy.')
  provenance = json.loads(files['policy.json'])['provenance']
  described = (run / run_folder.CONFIG_FILE).read_text(encoding='utf-8')
  config = json.loads(described)['run']
  # Other fields may have been changed along the run; the policy knows its own.
  if any(provenance['run'][name] != config[name] for name in _IDENTITY):
    raise ValueError(f'{policy} is not a policy of the run in {run}.')
  text = (run / 'metrics.csv').read_text(encoding='utf-8')
  files[TRAINING_FILE] = thinned(text, every, provenance['steps']).encode()
  return files


def write(files: dict[str, bytes], place: pathlib.Path) -> None:
  """Writes the files, each whole or not at all, and nothing else stays."""
  place.mkdir(parents=True, exist_ok=True)
  for path in place.iterdir():
    if path.is_dir():
      shutil.rmtree(path)
    elif path.name not in files:
      path.unlink()
  for name, content in files.items():
    files_lib.write(place / name, content)


def ship_selector(run: pathlib.Path, name: str) -> pathlib.Path:
  """Copies a run's selector beside the policy `name`; returns the folder.

  Raises:
    FileNotFoundError: the run or the policy lacks a file.
    ValueError: the selector is damaged or of another policy.
  """
  found = selector_lib.load(run / steering.BESIDE)
  if found.policy != name:
    raise ValueError(
      f'The selector in {run} was trained with {found.policy}, not {name}.'
    )
  curves = (run / 'metrics.csv').read_bytes()
  place = shipped_folder(name) / steering.BESIDE
  found.save(place)
  files_lib.write(place / TRAINING_FILE, curves)
  files_lib.write(place.parent / cards.CARD_FILE, cards.read(name).encode())
  return place


def main(argv: Sequence[str]) -> None:
  """Copies, then evaluates."""
  del argv
  run = pathlib.Path(_RUN_DIR.value)
  if _SELECTOR.value:
    print(f'Shipped in {ship_selector(run, _NAME.value)}')
    return
  policy = run / policy_lib.RUN_SUBFOLDER
  if _STEPS.value is not None:
    policy = run / 'policies' / str(_STEPS.value)
  if not _NAME.value.isidentifier():
    raise ValueError(f'--name={_NAME.value} is no name for a folder.')
  files = gather(run, policy, _CURVE_EVERY.value)
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
  files[cards.CARD_FILE] = cards.card(
    _NAME.value,
    json.loads(files[policy_lib.DESCRIPTION_FILE]),
    json.loads(files[policy_lib.METRICS_FILE]),
  ).encode()
  # Only now: what was shipped before stays until all is there.
  folder = shipped_folder(_NAME.value)
  write(files, folder)
  print(f'Shipped in {folder}')


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
