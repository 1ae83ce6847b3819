"""Builds wheel and sdist, and tries each in an environment of its own.

    python -m benchmarks.release.release --out=out/release

1. The version is the same in `dmc_multimode.__version__`, CHANGELOG.md,
   CITATION.cff and, if HEAD has one, the tag `vVERSION`.
2. `build` makes both; `twine check --strict` reads their metadata.
3. The wheel is installed into a fresh environment, which runs `doctor`, the
   tour and tests without the source of the package beside them.
4. The sdist is, too, and its own tests run in what it unpacks to.

The extra `release` has build and twine. Nothing is uploaded. --only=build stops
after 2; the rest takes a download of everything that the package needs.
"""

import functools
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tarfile
from typing import Sequence

from absl import flags
import yaml

import dmc_multimode
from dmc_multimode.bin import app
from dmc_multimode.utils import files

_ROOT = pathlib.Path(__file__).resolve().parents[2]
_PACKAGE = 'dmc_multimode'
# What the tests of the wheel need of the checkout: all but the package.
_BESIDE = (
  'docs',
  'examples',
  'flags',
  'tests',
  'xml',
  'setup.cfg',
  'README.md',
)
# The tour, and the rooms whose tests take no extra.
_WHEEL_TESTS = (
  *('tests/docs_test.py', 'tests/agents', 'tests/arenas', 'tests/modes'),
  *('tests/planner', 'tests/suite', 'tests/utils'),
)
# Of documents that name files of the checkout alone, and of the package.
_CHECKOUT_TESTS = (
  'tests/docs_test.py::test_links_lead_somewhere',
  'tests/docs_test.py::test_citation',
)
_TORCH = os.environ.get('TORCH', 'torch==2.13.0')

_OUT = flags.DEFINE_string('out', 'out/release', 'Folder to build in.')
_ONLY = flags.DEFINE_enum(
  'only', None, ['build', 'wheel', 'sdist'], 'Stop after build, or try one.'
)
flags.disclaim_key_flags()


def versions(root: pathlib.Path = _ROOT) -> dict[str, str]:
  """Returns the version by each place that states it.

  Raises:
    ValueError: CHANGELOG.md does not begin with a version.
  """
  changes = (root / 'CHANGELOG.md').read_text(encoding='utf-8')
  newest = re.search(r'^## (\d+\.\d+\.\d+)', changes, re.MULTILINE)
  if not newest:
    raise ValueError('CHANGELOG.md has no heading `## VERSION - DATE`.')
  citation = (root / 'CITATION.cff').read_text(encoding='utf-8')
  return {
    f'{_PACKAGE}.__version__': dmc_multimode.__version__,
    'CHANGELOG.md': newest[1],
    'CITATION.cff': str(yaml.safe_load(citation)['version']),
  }


def check_versions() -> str:
  """Returns the version; raises ValueError where two places differ."""
  found = versions()
  tags = subprocess.run(
    ['git', 'tag', '--points-at', 'HEAD', '--list', 'v*'],
    cwd=_ROOT,
    capture_output=True,
    text=True,
  ).stdout.split()
  found |= {f'tag {tag}': tag.removeprefix('v') for tag in tags}
  if len(set(found.values())) > 1:
    raise ValueError(f'The versions differ: {found}.')
  return found[f'{_PACKAGE}.__version__']


def build(out: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
  """Builds wheel and sdist and checks their metadata; returns their files."""
  for old in out.glob(f'{_PACKAGE}-*'):
    old.unlink()
  _run(sys.executable, '-m', 'build', '--outdir', out, _ROOT)
  (wheel,), (sdist,) = out.glob('*.whl'), out.glob('*.tar.gz')
  _run(sys.executable, '-m', 'twine', 'check', '--strict', wheel, sdist)
  return wheel, sdist


def try_wheel(wheel: pathlib.Path, sdist: pathlib.Path) -> None:
  """Tests an installed wheel by the sdist's tests, without its source."""
  python = _environment(wheel, 'dev')
  tree = _unpack(sdist, wheel.parent / 'beside')
  for path in tree.iterdir():
    if path.name not in _BESIDE:
      shutil.rmtree(path) if path.is_dir() else path.unlink()
  _run(python, '-m', f'{_PACKAGE}.bin.doctor', cwd=tree)
  left_out = [f'--deselect={name}' for name in _CHECKOUT_TESTS]
  _run(python, '-m', 'pytest', '-q', *_WHEEL_TESTS, *left_out, cwd=tree)


def try_sdist(sdist: pathlib.Path) -> None:
  """Runs the tests that an sdist has, in what it unpacks to."""
  python = _environment(sdist, 'dev,export,gym')
  tree = _unpack(sdist, sdist.parent / 'unpacked')
  _run(python, '-m', 'pytest', '-q', '-m', 'not slow', cwd=tree)


def _environment(artefact: pathlib.Path, extras: str) -> pathlib.Path:
  """Returns the interpreter of a fresh environment that has an artefact."""
  kind = 'wheel' if artefact.suffix == '.whl' else 'sdist'
  folder = artefact.parent / f'environment_{kind}'
  shutil.rmtree(folder, ignore_errors=True)
  _run(sys.executable, '-m', 'venv', folder)
  python = folder / 'bin' / 'python'
  install = [str(python), '-m', 'pip', 'install', '--quiet']
  _run(*install, *_TORCH.split())  # Apart: a bare `torch` brings CUDA.
  _run(*install, f'{artefact}[{extras}]')
  return python


def _unpack(sdist: pathlib.Path, folder: pathlib.Path) -> pathlib.Path:
  """Returns the folder in an sdist, unpacked anew."""
  shutil.rmtree(folder, ignore_errors=True)
  with tarfile.open(sdist) as archive:
    archive.extractall(folder, filter='data')
  (tree,) = folder.iterdir()
  return tree


def _run(*command: str | pathlib.Path, cwd: pathlib.Path | None = None) -> None:
  """Runs a command that says what it does.

  Raises:
    ChildProcessError: it failed.
  """
  words = list(map(str, command))
  print('$', *words, flush=True)
  done = subprocess.run(words, cwd=cwd)
  if done.returncode:
    raise ChildProcessError(f'`{" ".join(words)}` failed.')


def main(argv: Sequence[str]) -> None:
  """Makes a release; `argv` holds no flags."""
  del argv
  version = check_versions()
  out = files.output_folder('out', _OUT.value)
  if out is None:
    raise ValueError('Say where to build: --out=FOLDER.')
  out = out.resolve()
  out.mkdir(parents=True, exist_ok=True)
  wheel, sdist = build(out)
  if _ONLY.value in (None, 'wheel'):
    try_wheel(wheel, sdist)
  if _ONLY.value in (None, 'sdist'):
    try_sdist(sdist)
  print(f'{wheel}\n{sdist}\nTo release: git tag v{version} && git push --tags')


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
