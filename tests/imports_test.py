"""The arrows between the rooms of the package point one way.

utils <- modes, arenas, walkers <- suite <- planner, pretrained <- viewer <-
evaluation <- experiments <- bin; deployment is above planner and pretrained and
below bin; `agents` sees environments through protocols alone. Benchmarks and
documents import the library, and of `bin` only `app` and `flags`.
"""

import ast
import pathlib
import re
import subprocess
import sys
from typing import Iterator

import pytest

_PACKAGE = 'dmc_multimode'
_ROOT = pathlib.Path(__file__).resolve().parent.parent

_TASK = {'utils', 'modes', 'arenas', 'walkers', 'suite'}
# Room -> the rooms that it may import. A room is the first name below the
# package; the package's own `__init__`, the facade, is the room ''.
_ALLOWED: dict[str, set[str]] = {
  '': {'utils'},
  'utils': {'utils'},
  'modes': {'utils', 'modes'},
  'arenas': {'utils', 'modes', 'arenas'},
  'walkers': {'utils', 'modes', 'walkers'},
  'suite': _TASK,
  'agents': {'utils', 'agents'},
  'planner': {*_TASK, 'agents', 'planner'},
  'pretrained': {*_TASK, 'agents', 'pretrained'},
}
_ALLOWED['viewer'] = {*_ALLOWED, 'viewer'} - {''}
_ALLOWED['evaluation'] = {*_ALLOWED['viewer'], 'evaluation'}
_ALLOWED['experiments'] = {*_ALLOWED['evaluation'], 'experiments'}
_ALLOWED['deployment'] = {*_ALLOWED['planner'], 'pretrained', 'deployment'}
_ALLOWED['bin'] = {*_ALLOWED['experiments'], 'deployment', 'bin'}

# Module -> the rooms that it may import besides, but only inside functions, or
# for type checkers alone. The facade is lazy, so that importing it loads
# nothing heavy. The suite's reaching tasks have a trained policy in them, and
# are loaded by name as every task is: so the suite must find policies, which
# know the suite.
_LATE = {
  _PACKAGE: _ALLOWED['experiments'],
  f'{_PACKAGE}.suite.reaching.environment': {'pretrained'},
}

# Room -> (what it may not import, the sub-rooms and modules that may).
_FOREIGN: dict[str, tuple[set[str], tuple[str, ...]]] = {
  'utils': ({'torch'}, ()),
  'modes': ({'torch'}, (f'{_PACKAGE}.modes.encoder',)),
  'arenas': ({'torch'}, ()),
  'walkers': ({'torch'}, ()),
  'suite': ({'torch'}, (f'{_PACKAGE}.suite.wrappers',)),
}


_TYPES = 'TYPE_CHECKING'


def _imported(
  module: str, source: str, is_package: bool
) -> Iterator[tuple[str, bool]]:
  """Dotted names that a module imports, and whether not as it is loaded."""
  tree = ast.parse(source)
  late = {
    node
    for block in ast.walk(tree)
    if isinstance(block, (ast.FunctionDef, ast.AsyncFunctionDef))
    or (isinstance(block, ast.If) and ast.unparse(block.test) == _TYPES)
    for node in ast.walk(block)
  }
  for node in ast.walk(tree):
    if isinstance(node, ast.Import):
      yield from ((alias.name, node in late) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
      base = node.module or ''
      if node.level:
        above = node.level - is_package
        parents = module.split('.')[: -above or None]
        base = '.'.join(filter(None, [*parents, base]))
      yield from ((f'{base}.{a.name}', node in late) for a in node.names)


def _wrong_arrows(
  module: str, source: str, is_package: bool = False
) -> list[str]:
  """Returns imports that the module's room may not have, as lines to read."""
  part = (module.split('.') + [''])[1]
  if part not in _ALLOWED:
    return [f'{module}: add the room {part!r} to the table of this test']
  foreign, exempt = _FOREIGN.get(part, (set[str](), ()))
  wrong = []
  for name, is_late in _imported(module, source, is_package):
    top, *below = name.split('.')
    if top == _PACKAGE:
      allowed = _ALLOWED[part] | (
        _LATE.get(module, set()) if is_late else set()
      )
      # `import dmc_multimode` alone reaches no part.
      is_wrong = bool(below) and below[0] not in allowed
    else:
      is_wrong = top in foreign and not module.startswith(exempt)
    if is_wrong:
      wrong.append(f'{module} imports {name}')
  return wrong


def _modules() -> list[tuple[str, pathlib.Path]]:
  """Every module of the package: dotted name and file."""
  found = []
  for path in sorted((_ROOT / _PACKAGE).rglob('*.py')):
    parts = path.relative_to(_ROOT).with_suffix('').parts
    parts = parts[:-1] if parts[-1] == '__init__' else parts
    found.append(('.'.join(parts), path))
  return found


def test_the_package_has_no_wrong_arrow() -> None:
  modules = _modules()
  assert len(modules) > 10  # It looks in the right place.
  wrong = [
    arrow
    for name, path in modules
    for arrow in _wrong_arrows(
      name, path.read_text(), path.name == '__init__.py'
    )
  ]
  assert not wrong, '\n'.join(wrong)


_EARLY_IMPORT = 'from dmc_multimode import pretrained'
_LATE_IMPORT = f'def f():\n  {_EARLY_IMPORT}'


@pytest.mark.parametrize(
  ('module', 'source'),
  [
    ('dmc_multimode.modes.library', 'from dmc_multimode.suite import load'),
    ('dmc_multimode.modes.library', 'import dmc_multimode.arenas.track'),
    ('dmc_multimode.modes.reference', 'from torch import nn'),
    ('dmc_multimode.walkers.mini_biped', 'from dmc_multimode import suite'),
    ('dmc_multimode.suite.rewards', 'from .. import planner'),
    ('dmc_multimode.suite.rewards', 'import torch'),
    ('dmc_multimode.suite', _LATE_IMPORT),
    ('dmc_multimode.suite.reaching.problem', _LATE_IMPORT),
    ('dmc_multimode.suite.reaching.environment', _EARLY_IMPORT),
    (
      'dmc_multimode.suite.reaching.environment',
      f'if True:\n  {_EARLY_IMPORT}',
    ),
    (
      'dmc_multimode.suite.reaching.environment',
      'def f():\n  from dmc_multimode import agents',
    ),
    ('dmc_multimode.agents.core', 'from dmc_multimode import modes'),
    ('dmc_multimode.agents.ppo.losses', 'from ...suite import load'),
    ('dmc_multimode.planner.plan', 'def f():\n  from dmc_multimode import bin'),
    ('dmc_multimode.viewer.video', 'from dmc_multimode import evaluation'),
    ('dmc_multimode.experiments.setup', 'from dmc_multimode.bin import app'),
    ('dmc_multimode.viewer.video', 'from dmc_multimode import deployment'),
    ('dmc_multimode', 'from dmc_multimode import suite'),
    ('dmc_multimode.novelty', 'import os'),
  ],
)
def test_a_wrong_arrow_is_seen(module: str, source: str) -> None:
  assert len(_wrong_arrows(module, source)) == 1


@pytest.mark.parametrize(
  ('module', 'source'),
  [
    ('dmc_multimode.modes.encoder.training', 'import torch'),
    ('dmc_multimode.modes.library', 'from . import reference'),
    ('dmc_multimode.suite.reaching.environment', _LATE_IMPORT),
    ('dmc_multimode.suite.reaching.environment', f'async {_LATE_IMPORT}'),
    ('dmc_multimode.planner.plan', 'from ..suite import load'),
    ('dmc_multimode.agents.core', 'import torch\nimport dmc_multimode'),
    ('dmc_multimode', 'def f():\n  from dmc_multimode import experiments'),
    ('dmc_multimode', 'if TYPE_CHECKING:\n  from dmc_multimode import suite'),
    ('dmc_multimode.bin.train', 'from dmc_multimode import agents, planner'),
  ],
)
def test_a_right_arrow_passes(module: str, source: str) -> None:
  assert not _wrong_arrows(module, source)


# Commands that people type may stand anywhere.
_COMMAND = re.compile(r'(python3? -m |/python -m |-m )dmc_multimode\.bin\.\w+')
_BIN = re.compile(
  r'(from dmc_multimode\.bin import (?!app\b|flags\b)\w+'
  r'|import dmc_multimode\.bin)'
)


def test_only_commands_know_the_commands() -> None:
  wrong = []
  for folder in ('benchmarks', 'docs', 'examples', *_rooms_below_bin()):
    for path in sorted((_ROOT / folder).rglob('*')):
      if path.suffix in ('.py', '.md', '.ipynb'):
        text = _COMMAND.sub('', path.read_text(encoding='utf-8'))
        wrong += [f'{path}: {found[0]}' for found in _BIN.finditer(text)]
  assert not wrong, '\n'.join(wrong)


def _rooms_below_bin() -> list[str]:
  return [f'{_PACKAGE}/{room}' for room in _ALLOWED if room not in ('', 'bin')]


def test_the_suite_loads_without_torch() -> None:
  code = """if True:
    import sys
    from dmc_multimode import suite
    suite.load('multimode_biped', 'idle')
    print(*{'torch', 'dmc_multimode.pretrained'} & set(sys.modules))
  """
  run = subprocess.run(
    [sys.executable, '-c', code], cwd=_ROOT, capture_output=True, text=True
  )
  assert (run.returncode, run.stdout) == (0, '\n'), run.stderr


def test_relative_imports_of_a_package_start_at_itself() -> None:
  source = 'from . import rewards\nfrom .. import bin'
  assert _wrong_arrows('dmc_multimode.suite', source, is_package=True) == [
    'dmc_multimode.suite imports dmc_multimode.bin'
  ]
