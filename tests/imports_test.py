"""The arrows between the parts of the package point one way.

`modes`, `arenas` <- `suite` <- `planner`; `agents` stands alone; `bin` alone
puts the parts together.
"""

import ast
import pathlib
import subprocess
import sys
from typing import Iterator

import pytest

_PACKAGE = 'dmc_multimode'
_ROOT = pathlib.Path(__file__).resolve().parent.parent

_BIN_ONLY = {'bin'}
# Part -> the parts that it may import. A part is the first name below the
# package; the package's own `__init__` is the part ''.
_ALLOWED = {
  '': set[str](),
  'resources': set[str](),
  'atomic': set[str](),
  'typed': set[str](),
  'pretrained': {
    'pretrained',
    'atomic',
    'modes',
    'suite',
    'agents',
    'resources',
  },
  'modes': {'atomic', 'modes', 'typed'},
  'arenas': {'arenas', 'modes'},
  'suite': {'suite', 'modes', 'arenas', 'resources', 'typed'},
  'agents': {'atomic', 'agents'},
  'planner': {'planner', 'suite', 'modes', 'arenas', 'agents'},
}
_ALLOWED['bin'] = {*_ALLOWED, *_BIN_ONLY} - {''}

# Module -> the parts that it may import besides, but only inside functions. The
# suite's reaching tasks have a trained policy in them, and are loaded by name
# as every task is: so the suite must find policies, which know the suite.
_LATE = {f'{_PACKAGE}.suite.reaching_env': {'pretrained'}}

# Part -> (what it may not import, the modules that may).
_FOREIGN = {
  'modes': (
    {'torch'},
    {
      f'{_PACKAGE}.modes.{name}'
      for name in ('autoencoder', 'encoder', 'extension')
    },
  ),
  'suite': ({'torch'}, set[str]()),
}


def _imported(
  module: str, source: str, is_package: bool
) -> Iterator[tuple[str, bool]]:
  """Dotted names that a module imports, and whether inside a function."""
  tree = ast.parse(source)
  late = {
    node
    for function in ast.walk(tree)
    if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
    for node in ast.walk(function)
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
  """Imports of a module that its part may not have, as lines to read."""
  part = (module.split('.') + [''])[1]
  if part not in _ALLOWED:
    return [f'{module}: add the part {part!r} to the table of this test']
  foreign, exempt = _FOREIGN.get(part, (set[str](), set[str]()))
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
      is_wrong = top in foreign and module not in exempt
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
    ('dmc_multimode.modes.reference', 'import torch'),
    ('dmc_multimode.modes.reference', 'from torch import nn'),
    ('dmc_multimode.arenas.track', 'from dmc_multimode import suite'),
    ('dmc_multimode.suite.batched', 'from dmc_multimode import agents'),
    ('dmc_multimode.suite.batched', 'from .. import planner'),
    ('dmc_multimode.suite.batched', 'import torch'),
    ('dmc_multimode.suite.batched', _LATE_IMPORT),
    ('dmc_multimode.suite', _LATE_IMPORT),
    ('dmc_multimode.suite.reaching', _LATE_IMPORT),
    ('dmc_multimode.suite.reaching_env', _EARLY_IMPORT),
    ('dmc_multimode.suite.reaching_env', f'class A:\n  {_EARLY_IMPORT}'),
    ('dmc_multimode.suite.reaching_env', f'if True:\n  {_EARLY_IMPORT}'),
    (
      'dmc_multimode.suite.reaching_env',
      'def f():\n  from dmc_multimode import agents',
    ),
    ('dmc_multimode.agents.sampling', 'from dmc_multimode import modes'),
    ('dmc_multimode.agents.ppo.losses', 'from ...suite import rewards'),
    ('dmc_multimode.planner.plan', 'def f():\n  from dmc_multimode import bin'),
    ('dmc_multimode.resources', 'from dmc_multimode.bin import app'),
    ('dmc_multimode', 'from dmc_multimode import suite'),
    ('dmc_multimode.novelty', 'import os'),
  ],
)
def test_a_wrong_arrow_is_seen(module: str, source: str) -> None:
  assert len(_wrong_arrows(module, source)) == 1


@pytest.mark.parametrize(
  ('module', 'source'),
  [
    ('dmc_multimode.modes.encoder', 'import torch'),
    ('dmc_multimode.modes.library', 'from . import reference'),
    ('dmc_multimode.suite.batched', 'from dmc_multimode import resources'),
    ('dmc_multimode.suite.reaching_env', _LATE_IMPORT),
    ('dmc_multimode.suite.reaching_env', f'async {_LATE_IMPORT}'),
    ('dmc_multimode.planner.plan', 'from ..suite import batched'),
    ('dmc_multimode.agents.sampling', 'import torch\nimport dmc_multimode'),
    ('dmc_multimode.bin.train', 'from dmc_multimode import agents, planner'),
  ],
)
def test_a_right_arrow_passes(module: str, source: str) -> None:
  assert not _wrong_arrows(module, source)


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
