"""What a shipped policy consists of, made from a training run."""

import csv
import io
import json
import pathlib

from dmc_multimode import pretrained
from dmc_multimode.experiments import setup
from dmc_multimode.utils import files as atomic

TRAINING_FILE = 'training.csv'
_DIGITS = 4  # Significant ones of a curve.
_IDENTITY = ('modes', 'seed', 'one_hot')  # What no run changes on its way.


def folder(name: str) -> pathlib.Path:
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
  described = (run / setup.CONFIG_FILE).read_text(encoding='utf-8')
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
    if path.name not in files:
      path.unlink()
  for name, content in files.items():
    atomic.write(place / name, content)
