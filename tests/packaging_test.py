"""Tests of the wheel's and the sdist's content, and of installs by users."""

import configparser
import email
import os
import pathlib
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile

import pytest

_ROOT = pathlib.Path(__file__).resolve().parent.parent
_DATA = {  # Folder -> pattern of the files that must be shipped.
  'xml': '*.*ml',
  'flags': '*.flags',
  'pretrained': '**/*',
  'evaluation': '*.j2',
  'viewer': '*.js',
}
_USER = _ROOT / 'tests' / 'typing' / 'user_script.py'


def _list(section: str, option: str) -> list[str]:
  config = configparser.ConfigParser(interpolation=None)
  config.read(_ROOT / 'setup.cfg')
  return config[section][option].strip().splitlines()


def _run(*command: str | pathlib.Path) -> str:
  done = subprocess.run(
    list(map(str, command)), capture_output=True, text=True, cwd='/'
  )
  assert done.returncode == 0, done.stdout + done.stderr
  return done.stdout


def test_mujoco_stays_below_4() -> None:
  assert 'mujoco>=3.17,<4' in _list('options', 'install_requires')


def test_scripts_name_modules_with_a_cli() -> None:
  for line in _list('options.entry_points', 'console_scripts'):
    script, target = line.split(' = ')
    module, function = target.split(':')
    name = module.rpartition('.')[2]
    assert script == f'dmc-multimode-{name}'
    assert function == 'cli'
    source = (_ROOT / 'dmc_multimode' / 'bin' / f'{name}.py').read_text()
    assert 'def cli() -> None:' in source
    assert 'def main(' in source


def test_the_checkout_does_not_hide_the_standard_library() -> None:
  """`xml/__init__.py` would: the root is first on the path of `python -m`."""
  code = 'import xml.etree.ElementTree as t; print(t.__file__)'
  found = subprocess.check_output(
    [sys.executable, '-c', code], cwd=_ROOT, text=True
  )
  assert not pathlib.Path(found.strip()).is_relative_to(_ROOT)


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """A copy of the checkout: builds leave files in their tree."""
  pytest.importorskip('setuptools', minversion='77')
  folder = tmp_path_factory.mktemp('source') / 'checkout'
  not_ours = ['.git', '.venv', '.*_cache', '.hypothesis', '__pycache__']
  not_ours += ['*.egg-info', 'build', 'dist', 'out', 'runs']
  ignore = shutil.ignore_patterns(*not_ours)
  shutil.copytree(_ROOT, folder, symlinks=True, ignore=ignore)
  return folder


@pytest.fixture(scope='module')
def wheel(
  source: pathlib.Path, tmp_path_factory: pytest.TempPathFactory
) -> pathlib.Path:
  folder = tmp_path_factory.mktemp('wheel')
  command = [sys.executable, '-m', 'pip', 'wheel', '--no-deps', '--no-index']
  _run(*command, '--no-build-isolation', '-w', folder, source)
  [built] = folder.glob('dmc_multimode-*.whl')
  return built


@pytest.mark.slow
def test_wheel_holds_code_and_data(wheel: pathlib.Path) -> None:
  with zipfile.ZipFile(wheel) as archive:
    held = set(archive.namelist())
  code = {
    path.relative_to(_ROOT).as_posix()
    for path in (_ROOT / 'dmc_multimode').rglob('*.py')
  }
  package = _ROOT / 'dmc_multimode'
  data = {
    path.relative_to(_ROOT).as_posix()
    for folder, pattern in _DATA.items()
    for path in (package / folder).glob(pattern)
    if path.is_file() and path.suffix not in ('.py', '.pyc')
  }
  assert 'dmc_multimode/xml/scene.xml' in data
  assert 'dmc_multimode/xml/mini_biped.yaml' in data
  assert 'dmc_multimode/flags/pi2.flags' in data
  assert code | data | {'dmc_multimode/py.typed'} <= held
  tops = {name.split('/')[0] for name in held}
  assert tops == {'dmc_multimode', next(t for t in tops if 'dist-info' in t)}
  assert any(name.endswith('LICENSE') for name in held)


@pytest.mark.slow
def test_the_index_shows_links_that_lead_somewhere(wheel: pathlib.Path) -> None:
  with zipfile.ZipFile(wheel) as archive:
    (name,) = (n for n in archive.namelist() if n.endswith('/METADATA'))
    shown = email.message_from_bytes(archive.read(name))
  assert shown['Author'] == 'The dmc_multimode authors'
  urls = shown.get_all('Project-URL') or []
  (home,) = {url for url in urls if url.startswith('Source')}
  ours = re.compile(
    re.escape(home.removeprefix('Source, ')) + '/(raw|blob)/main/(.*)'
  )
  links = re.findall(r'(!?)\[[^\]]*\]\(([^)]*)\)', str(shown.get_payload()))
  assert {kind for kind, _ in links} == {'!', ''}
  for kind, link in links:
    assert link.startswith('https://'), link
    if found := ours.fullmatch(link):
      assert found[1] == ('raw' if kind else 'blob')
      assert (_ROOT / found[2].partition('#')[0]).exists(), link


@pytest.mark.slow
def test_sdist_holds_the_checkout(
  source: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  """And so the tests, and all that they read."""
  code = f'from setuptools import build_meta as b; b.build_sdist("{tmp_path}")'
  command = f'import os; os.chdir("{source}"); {code}'
  _run(sys.executable, '-c', command)
  (built,) = tmp_path.glob('*.tar.gz')
  with tarfile.open(built) as archive:
    held = {name.partition('/')[2] for name in archive.getnames()}
  files = {
    os.path.relpath(os.path.join(folder, name), source)
    for folder, _, names in os.walk(source, followlinks=True)
    for name in names
  }
  made = re.compile(r'build/|[^/]*\.egg-info/')  # By the build of the wheel.
  missing = {name for name in files - held if not made.match(name)}
  assert len(files) > 300 and not missing


@pytest.fixture(scope='module', params=['wheel', 'editable'])
def python(
  request: pytest.FixtureRequest,
  source: pathlib.Path,
  tmp_path_factory: pytest.TempPathFactory,
) -> pathlib.Path:
  """The interpreter of a fresh environment with the package in it.

  It sees what this environment has, but for the package that is tested.
  """
  folder = tmp_path_factory.mktemp('environment')
  _run(sys.executable, '-m', 'venv', '--without-pip', folder)
  python = folder / 'bin' / 'python'
  code = 'import sysconfig; print(sysconfig.get_path("purelib"))'
  site = pathlib.Path(_run(python, '-c', code).strip())
  (site / 'rest.pth').write_text(sysconfig.get_path('purelib'))
  install: list[str | pathlib.Path] = [sys.executable, '-m', 'pip']
  install += ['--python', python, 'install']
  what: list[str | pathlib.Path] = (
    [request.getfixturevalue('wheel')]
    if request.param == 'wheel'
    else ['--no-build-isolation', '--editable', source]
  )
  _run(*install, '--ignore-installed', '--no-deps', '--no-index', *what)
  code = 'import dmc_multimode; print(dmc_multimode.__file__)'
  found = pathlib.Path(_run(python, '-c', code).strip())
  assert found.is_relative_to(site if request.param == 'wheel' else source)
  return python


@pytest.mark.slow
def test_resources_are_found(python: pathlib.Path) -> None:
  code = (
    'from dmc_multimode.utils import resources as r; '
    "print(r.path('xml', 'mini_biped.xml').is_file(), *r.names('flags'))"
  )
  found, *flags = _run(python, '-c', code).split()
  assert found == 'True'
  assert flags == sorted(path.name for path in (_ROOT / 'flags').glob('*'))


@pytest.fixture(scope='module')
def cache(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """Of mypy, for whatever is the same in all environments."""
  return tmp_path_factory.mktemp('cache')


@pytest.mark.slow
def test_mypy_checks_a_users_script(
  python: pathlib.Path, cache: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  pytest.importorskip('mypy')
  shutil.copy(_USER, tmp_path)
  # No type of theirs is asked for, and to read them takes most of the time.
  (tmp_path / 'mypy.ini').write_text(
    '[mypy]\n[mypy-matplotlib.*,PIL.*,torch.*]\nfollow_imports = skip\n'
  )
  _run(
    *(sys.executable, '-m', 'mypy', '--strict', f'--cache-dir={cache}'),
    *(
      f'--config-file={tmp_path / "mypy.ini"}',
      f'--python-executable={python}',
    ),
    tmp_path / _USER.name,
  )


@pytest.mark.slow
def test_pyright_checks_a_users_script(
  python: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  pytest.importorskip('pyright')
  if os.system(f'{sys.executable} -m pyright --version >/dev/null 2>&1'):
    pytest.skip('pyright cannot fetch what it runs on.')
  shutil.copy(_USER, tmp_path)
  _run(
    *(sys.executable, '-m', 'pyright', '--pythonpath', python),
    tmp_path / _USER.name,
  )
