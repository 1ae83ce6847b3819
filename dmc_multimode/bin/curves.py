r"""Draws training curves: returns of groups of runs, and sampling.

python -m dmc_multimode.bin.curves --out=figures \
  --run=adaptive=runs/pi2_0 --run=adaptive=runs/pi2_1 \
  --run=uniform=runs/pi2_uniform_0 --run=uniform=runs/pi2_uniform_1

Runs of one label are seeds of one setting: a line is their mean, a band their
range.
"""

import pathlib
from typing import Sequence

from absl import flags

from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import training_figures
from dmc_multimode.utils import files

_RUN = flags.DEFINE_multi_string(
  'run', [], 'LABEL=FOLDER of a run, or of its metrics.csv; many times.'
)
_OUT = config_flags.define_path(
  'out', None, 'Folder to draw into.', required=True
)

RETURNS_FILE, SAMPLING_FILE = 'returns.png', 'sampling.png'


def _groups(items: Sequence[str]) -> dict[str, list[training_figures.Curves]]:
  """Returns the runs of --run by label."""
  if not items:
    raise ValueError('Name a run: --run=LABEL=FOLDER.')
  groups: dict[str, list[training_figures.Curves]] = {}
  for item in items:
    label, equals, folder = item.partition('=')
    if not (label and equals and folder):
      raise ValueError(f'--run={item} is not LABEL=FOLDER.')
    curves = training_figures.read(pathlib.Path(files.expand(folder)))
    groups.setdefault(label, []).append(curves)
  return groups


def main(argv: Sequence[str]) -> None:
  """Reads the runs and draws their curves."""
  del argv
  out = files.output_folder('out', _OUT.value)
  if out is None:
    raise ValueError('Say where to draw: --out=FOLDER.')
  groups = _groups(_RUN.value)
  drawn = {RETURNS_FILE: training_figures.draw_returns(groups)}
  for label, (first, *_) in groups.items():
    name = SAMPLING_FILE if len(groups) == 1 else f'{label}_{SAMPLING_FILE}'
    drawn[name] = training_figures.draw_sampling(first)
  for name, figure in drawn.items():
    figures.save(out / name, figure)
    print(f'wrote {out / name}')


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
