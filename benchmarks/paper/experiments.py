"""The experiments of the paper as commands, and its Table II beside ours."""

import pathlib
import subprocess
import sys
import time
from typing import Any, NamedTuple

from benchmarks.release import shipping
from dmc_multimode import pretrained

# Table II: MRA over modes and over transitions, mean and standard deviation.
PAPER: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
  'pi1_uniform': ((0.81, 0.06), (0.71, 0.09)),
  'pi1': ((0.87, 0.04), (0.77, 0.05)),
  'pi2_uniform': ((0.87, 0.10), (0.64, 0.18)),
  'pi2': ((0.91, 0.05), (0.79, 0.24)),
}


class Part(NamedTuple):
  """One command.

  Attributes:
    name: of its log and report.
    command: arguments of python; `{out}` stands for the folder.
    needs: policies that it evaluates.
  """

  name: str
  command: tuple[str, ...]
  needs: tuple[str, ...]


def parts(episodes: int) -> list[Part]:
  """Returns everything that there is to run."""
  return [
    *(_evaluation(name, episodes) for name in pretrained.names()),
    *(_curves(name) for name in ('pi1', 'pi2')),
    *_comparisons(),
    *_showings(),
    _benchmark('planning', ('pi2',), '--random=0'),
    _benchmark('robustness', ('pi2',), '--episodes=1'),
  ]


def _evaluation(name: str, episodes: int) -> Part:
  """The scores and figures of one policy."""
  command = (
    *('-m', 'dmc_multimode.bin.evaluate', f'--policy={name}'),
    *(f'--episodes={episodes}', '--clock_rates=1,2,3'),
    *(f'--out={{out}}/{name}.json', f'--figures={{out}}/{name}'),
  )
  return Part(name, command, (name,))


def _curves(name: str) -> Part:
  """How a policy and its uniform baseline were learned."""
  needs = name, f'{name}_uniform'
  runs = (
    f'--run={label}={shipping.folder(policy) / shipping.TRAINING_FILE}'
    for label, policy in zip(('adaptive', 'uniform'), needs, strict=True)
  )
  command = '-m', 'dmc_multimode.bin.curves', f'--out={{out}}/curves_{name}'
  return Part(f'curves_{name}', (*command, *runs), needs)


def _benchmark(name: str, needs: tuple[str, ...], *more: str) -> Part:
  """A benchmark that writes a report of its own name."""
  command = '-m', f'benchmarks.{name}', f'--out={{out}}/{name}.json', *more
  return Part(name, command, needs)


def _policies(names: tuple[str, ...]) -> tuple[str, ...]:
  return tuple(f'--policy={name}' for name in names)


def _comparisons() -> list[Part]:
  """Ours beside the paper's baselines."""
  drawing = '--figures={out}'
  # The baselines were trained for less: beside them, ours of as many steps.
  aliasing = 'pi2_18m', 'pi2_one_hot'
  collapse = 'pi1_21m', 'pi1_uniform'
  return [
    _benchmark('aliasing', aliasing, *_policies(aliasing), drawing),
    # A mode that has collapsed keeps the height of a robot that stands.
    Part(
      'collapse',
      (
        *('-m', 'benchmarks.paper.aliasing', '--modes=idle,leap_left'),
        *_policies(collapse),
        *('--out={out}/collapse.json', '--figures={out}/collapse'),
      ),
      collapse,
    ),
    _benchmark(
      'switching', ('pi2', 'unimodal_walk', 'unimodal_launch'), drawing
    ),
  ]


def _showings() -> list[Part]:
  """What the paper shows of the encoding and of the modes."""
  return [
    Part(
      'encoding',
      (
        *('-m', 'dmc_multimode.bin.train_encoder'),
        *('--modes=pi2', '--out={out}/encoding'),
      ),
      (),
    ),
    Part(
      'modes',
      (
        *('-m', 'dmc_multimode.bin.record', '--policy=pi2', '--arena=flat'),
        '--schedule=walk_forward:2.4,leap_forward:2.4,launch:2',
        '--out={out}/modes.mp4',
      ),
      ('pi2',),
    ),
  ]


def run(part: Part, out: pathlib.Path) -> float:
  """Runs a command with its output in a log; returns seconds.

  Raises:
    ChildProcessError: it failed.
  """
  began = time.monotonic()
  log = out / f'{part.name}.log'
  command = [word.format(out=out) for word in part.command]
  with open(log, 'w', encoding='utf-8') as file:
    done = subprocess.run(
      [sys.executable, *command], stdout=file, stderr=subprocess.STDOUT
    )
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
