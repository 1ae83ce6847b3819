"""Makes every table and figure of the paper from the shipped policies.

    python -m benchmarks.paper.reproduce --out=out/reproduction

Runs the commands and benchmarks that docs/REPRODUCTION.md gives, one after the
other, leaves their reports, figures and logs in --out, and ends with the
paper's figures beside ours. What has run already is not run again, so that the
command goes on where it was interrupted.
"""

import functools
import itertools
import json
import pathlib
import re
import subprocess
import sys
import time
from typing import Any, NamedTuple, Sequence

from absl import flags

from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import files

_OUT = config_flags.define_path(
  'out', 'out/reproduction', 'Folder for reports, figures and logs.'
)
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Like those of `evaluate`.', lower_bound=1
)
_DONE = '.done'
# Table II: MRA over modes and over transitions, mean and standard deviation.
PAPER: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
  'pi1_uniform': ((0.81, 0.06), (0.71, 0.09)),
  'pi1_paper': ((0.87, 0.04), (0.77, 0.05)),
  'pi1': ((0.87, 0.04), (0.77, 0.05)),
  'pi2_uniform': ((0.87, 0.10), (0.64, 0.18)),
  'pi2_paper': ((0.91, 0.05), (0.79, 0.24)),
  'pi2': ((0.91, 0.05), (0.79, 0.24)),
}


class Part(NamedTuple):
  """Describes one command.

  Attributes:
    name: of its log and report.
    words: what comes after `python -m`; `{out}` stands for the
      folder, `{shipped}` for that of the policies.
  """

  name: str
  words: str

  @property
  def needs(self) -> set[str]:
    """Policies that it evaluates."""
    named = r'--(?:policy|before|after)=(\w+)|{shipped}/(\w+)/'
    return {a or b for a, b in re.findall(named, self.words)}


_EVALUATION = """dmc_multimode.bin.evaluate --policy={name}
  --episodes={episodes} --clock_rates=1,2,3 --out={{out}}/{name}.json
  --figures={{out}}/{name}"""
_CURVES = """dmc_multimode.bin.curves --out={{out}}/curves_{name}
  --run=adaptive={{shipped}}/{name}/training.csv
  --run=uniform={{shipped}}/{uniform}/training.csv"""
_COMPARED = {'pi1_paper': 'pi1_uniform', 'pi2_paper': 'pi2_uniform'}
# The baselines were trained for less: beside them, ours of as many steps. A
# mode that has collapsed keeps the height of a robot that stands.
_SHOWN = {
  'aliasing': """benchmarks.paper.aliasing --out={out}/aliasing.json
    --policy=pi2_18m --policy=pi2_one_hot --figures={out}""",
  'collapse': """benchmarks.paper.aliasing --out={out}/collapse.json
    --policy=pi1_21m --policy=pi1_uniform --modes=idle,leap_left
    --figures={out}/collapse""",
  'blending': """benchmarks.paper.blending --out={out}/blending.json
    --policy=pi1 --figures={out}""",
  'switching': """benchmarks.paper.switching --out={out}/switching.json
    --figures={out} --policy=pi2_paper --before=unimodal_walk
    --after=unimodal_launch""",
  'encoding': """dmc_multimode.bin.train_encoder --modes=pi2
    --out={out}/encoding""",
  'modes': """dmc_multimode.bin.record --policy=pi2 --arena=flat
    --schedule=walk_forward:2.4,leap_forward:2.4,launch:2
    --out={out}/modes.mp4""",
  'planning': """benchmarks.paper.planning --policy=pi2 --random=0
    --out={out}/planning.json""",
  'robustness': """benchmarks.reliability.robustness --policy=pi2
    --episodes=1 --out={out}/robustness.json""",
}


def parts(episodes: int) -> list[Part]:
  """Returns everything that there is to run."""
  return [
    *(
      Part(name, _EVALUATION.format(name=name, episodes=episodes))
      for name in pretrained.names('mini_biped')
    ),
    *(
      Part(f'curves_{name}', _CURVES.format(name=name, uniform=uniform))
      for name, uniform in _COMPARED.items()
    ),
    *itertools.starmap(Part, _SHOWN.items()),
  ]


def run(part: Part, out: pathlib.Path) -> float:
  """Runs a command with its output in a log; returns seconds.

  Raises:
    ChildProcessError: it failed.
  """
  began, log = time.monotonic(), out / f'{part.name}.log'
  shipped = pathlib.Path(pretrained.__file__).parent
  words = [x.format(out=out, shipped=shipped) for x in part.words.split()]
  with open(log, 'w', encoding='utf-8') as file:
    command = [sys.executable, '-m', *words]
    done = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT)
  if done.returncode:
    raise ChildProcessError(f'{part.name} failed: see {log}.')
  return time.monotonic() - began


def table_two(reports: dict[str, dict[str, Any]]) -> list[str]:
  """Returns the lines of Table II, the paper's figures beside ours."""
  lines = [
    f'{"":14}{"MRA modes":>30}{"MRA transitions":>30}',
    f'{"":14}{"paper":>14}{"ours":>16}{"paper":>14}{"ours":>16}',
  ]
  for name, (modes, transitions) in PAPER.items():
    line = f'{name:14}'
    for kind, paper in (('modes', modes), ('transitions', transitions)):
      line += f'{f"{paper[0]:.2f} +- {paper[1]:.2f}":>14}'
      mine = '(not shipped)'
      if name in reports:
        mra = reports[name][f'mra_{kind}']
        mine = f'{mra["mean"]:.3f} +- {mra["std"]:.3f}'
      line += f'{mine:>16}'
    lines.append(line)
  return lines


def main(argv: Sequence[str]) -> None:
  """Runs what has not run, then prints Table II and where all else is."""
  del argv
  out = files.output_folder('out', _OUT.value)
  if out is None:
    raise ValueError('Say where to write: --out=FOLDER.')
  out.mkdir(parents=True, exist_ok=True)
  shipped = set(pretrained.names())
  for part in parts(_EPISODES.value):
    missing = sorted(part.needs - shipped)
    done = out / f'{part.name}{_DONE}'
    if missing:
      print(f'{part.name:16} left out: no policy {", ".join(missing)}')
    elif done.exists():
      print(f'{part.name:16} has run before')
    else:
      seconds = run(part, out)
      files.write(done, b'')
      print(f'{part.name:16} {seconds:6.1f} s', flush=True)
  reports = {
    name: json.loads((out / f'{name}.json').read_text(encoding='utf-8'))
    for name in PAPER
    if name in shipped
  }
  print('\n'.join(['', *table_two(reports)]))
  print(f'\nReports, figures and logs are in {out}')


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
