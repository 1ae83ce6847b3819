"""Every table and figure of the paper, from the shipped policies.

    python -m benchmarks.paper.reproduce --out=out/reproduction

Runs the binaries and benchmarks whose commands docs/REPRODUCTION.md gives, one
after the other, leaves their reports, figures and logs in --out, and ends with
the paper's figures beside ours. What has run already is not run again, so that
the command goes on where it was interrupted.
"""

import json
from typing import Sequence

from absl import flags

from benchmarks.paper import experiments
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.utils import files

_OUT = flags.DEFINE_string(
  'out', 'out/reproduction', 'Folder for reports, figures and logs.'
)
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Like those of `evaluate`.', lower_bound=1
)
_DONE = '.done'


def main(argv: Sequence[str]) -> None:
  """Runs what has not run, then prints Table II and where all else is."""
  del argv
  out = files.output_folder('out', _OUT.value)
  if out is None:
    raise ValueError('Say where to write: --out=FOLDER.')
  out.mkdir(parents=True, exist_ok=True)
  shipped = set(pretrained.names())
  for part in experiments.parts(_EPISODES.value):
    missing = sorted(set(part.needs) - shipped)
    done = out / f'{part.name}{_DONE}'
    if missing:
      print(f'{part.name:16} left out: no policy {", ".join(missing)}')
    elif done.exists():
      print(f'{part.name:16} has run before')
    else:
      seconds = experiments.run(part, out)
      files.write(done, b'')
      print(f'{part.name:16} {seconds:6.1f} s', flush=True)
  reports = {
    name: json.loads((out / f'{name}.json').read_text(encoding='utf-8'))
    for name in experiments.PAPER
    if name in shipped
  }
  print('\n'.join(['', *experiments.table_two(reports)]))
  print(f'\nReports, figures and logs are in {out}')


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
