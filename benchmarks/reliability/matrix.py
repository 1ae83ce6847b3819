"""The lowest and the newest versions that setup.cfg allows: do the tests pass?

    python -m benchmarks.reliability.matrix --out=matrix.json

Each row is a fresh virtual environment in a temporary folder, with the versions
of the row and pytest, in which `--tests` run on this checkout. `newest` takes
what pip finds within the bounds of setup.cfg, `lowest` every lower bound, and
`lowest_core` those of mujoco, dm-control and numpy with the newest of the rest.
torch is `--torch` in all of them, for a bare `torch` brings gigabytes of CUDA;
`lowest_torch` tries the lowest one, without the packages of CUDA that its wheel
asks for: it is skipped where it cannot be imported so. A row whose versions
cannot be installed together says what pip said. Ends with 3 if a row failed.
"""

import configparser
import json
import pathlib
import re
import subprocess
import sys
import tempfile
import time
from typing import Any, Mapping, Sequence
import venv

from absl import flags

from benchmarks import common
from dmc_multimode.bin import app

_ROWS = ('newest', 'lowest_core', 'lowest', 'lowest_torch')
_CORE = ('mujoco', 'dm-control', 'numpy')
_SHOWN = (*_CORE, 'torch', 'scipy', 'safetensors')
_NO_CUDA = ('filelock', 'fsspec', 'jinja2', 'networkx', 'sympy')
_ROOT = pathlib.Path(__file__).parents[2]

_ONLY = flags.DEFINE_list('only', list(_ROWS), 'Rows.')
_TORCH = flags.DEFINE_string('torch', 'torch==2.13.0', 'What pip installs.')
_TESTS = flags.DEFINE_list(
  'tests',
  ['tests/agents', 'tests/arenas', 'tests/modes', 'tests/planner']
  + ['tests/pretrained', 'tests/suite', 'tests/utils/files_test.py'],
  'What pytest is given.',
)
_FOLDER = flags.DEFINE_string('folder', None, 'Where; else a temporary folder.')
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')

_REQUIREMENT = re.compile(r'(?P<name>[\w-]+)>=(?P<low>[\d.]+)(?P<rest>.*)')
_VERSIONS = """
import importlib.metadata, json, sys
print(json.dumps({n: importlib.metadata.version(n) for n in sys.argv[1:]}))
"""

Row = dict[str, Any]


def requirements(kind: str) -> list[str]:
  """Returns what pip is to install for a row, without torch.

  Raises:
    ValueError: setup.cfg has a requirement without a lower bound.
  """
  parser = configparser.ConfigParser()
  parser.read(_ROOT / 'setup.cfg', encoding='utf-8')
  found = []
  for line in parser['options']['install_requires'].split():
    match = _REQUIREMENT.fullmatch(line)
    if match is None:
      raise ValueError(f'setup.cfg: {line} has no lower bound.')
    is_core = match['name'] in _CORE
    if match['name'] == 'torch':
      continue
    is_low = kind == 'lowest' or (is_core and kind.startswith('lowest'))
    found.append(f'{match["name"]}=={match["low"]}' if is_low else line)
  return found


def lowest_torch() -> str:
  """Returns the lowest version of torch that setup.cfg allows."""
  text = (_ROOT / 'setup.cfg').read_text(encoding='utf-8')
  match = re.search(r'^\s*torch>=([\d.]+)', text, re.MULTILINE)
  if match is None:
    raise ValueError('setup.cfg: torch has no lower bound.')
  bound = match[1]
  return bound if bound.count('.') == 2 else f'{bound}.0'


class _Environment:
  """A fresh virtual environment."""

  def __init__(self, folder: pathlib.Path):
    venv.create(folder, with_pip=True)
    self._python = str(folder / 'bin' / 'python')

  def run(self, *args: str) -> subprocess.CompletedProcess[str]:
    """Runs Python in it, in the checkout."""
    return subprocess.run(
      [self._python, *args],
      capture_output=True,
      text=True,
      cwd=_ROOT,
      errors='replace',
    )

  def install(self, *what: str) -> str:
    """Installs; returns pip's error, empty if there was none."""
    done = self.run(
      *('-m', 'pip', 'install', '--quiet', '--no-compile'),
      *('--disable-pip-version-check', *what),
    )
    lines = [x for x in done.stderr.splitlines() if x.startswith('ERROR')]
    return '' if done.returncode == 0 else (lines or [done.stderr[-300:]])[0]


def _torch(environment: _Environment, kind: str) -> str:
  """Installs torch; returns why it cannot be had."""
  if kind != 'lowest_torch':
    return environment.install(_TORCH.value, 'numpy')
  version = f'torch=={lowest_torch()}'
  error = environment.install('--no-deps', version)
  error = error or environment.install(*_NO_CUDA, 'typing-extensions')
  done = environment.run('-c', 'import torch')
  if not error and done.returncode:
    words = done.stderr.strip().splitlines()[-1]
    error = f'{version} without its packages of CUDA: {words}'
  return error


def test(kind: str, folder: pathlib.Path) -> Row:
  """Returns one row of the table."""
  began = time.monotonic()
  row: Row = {'row': kind, 'versions': {}, 'result': '', 'ok': None}
  environment = _Environment(folder)
  needed = requirements(kind)
  error = _torch(environment, kind)
  if error:
    return {**row, 'result': f'skipped: {error}'}
  error = environment.install(*needed, 'pytest>=8', 'hypothesis>=6.100')
  if error:
    return {**row, 'result': f'not installable: {error}', 'ok': False}
  versions = environment.run('-c', _VERSIONS, *_SHOWN)
  row['versions'] = json.loads(versions.stdout)
  done = environment.run(
    *('-m', 'pytest', '-q', '-p', 'no:cacheprovider', *_TESTS.value)
  )
  lines = done.stdout.strip().splitlines() or [done.stderr[-300:]]
  failed = [line for line in lines if line.startswith(('FAILED', 'ERROR'))]
  return {
    **row,
    'result': lines[-1].strip('= '),
    'ok': done.returncode == 0,
    'failed': failed[:10],
    'seconds': time.monotonic() - began,
  }


def _print(row: Mapping[str, Any]) -> None:
  versions = ''.join(f'{row["versions"].get(n, "-"):>13}' for n in _SHOWN)
  print(f'{row["row"]:14}{versions}  {row["result"]}', flush=True)
  for line in row.get('failed', ()):
    print(f'  {line}')


def main(argv: Sequence[str]) -> int:
  """Runs the rows, prints, writes; returns whether all that ran passed."""
  del argv
  out = common.out_path(_OUT.value)
  unknown = set(_ONLY.value) - set(_ROWS)
  if unknown:
    raise ValueError(f'--only: there are {", ".join(_ROWS)}.')
  print(f'{"row":14}' + ''.join(f'{name:>13}' for name in _SHOWN) + '  result')
  rows = []
  for kind in _ONLY.value:
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as folder:
      rows.append(test(kind, pathlib.Path(folder) / kind))
    _print(rows[-1])
  common.write_report(
    out,
    {
      'benchmark': 'matrix',
      'table': rows,
      'tests': _TESTS.value,
      'of': sys.version.split()[0],
    },
  )
  failed = any(row['ok'] is False for row in rows)
  return app.EXIT_UNSOLVED if failed else 0


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
