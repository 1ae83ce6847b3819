"""What `setup.cfg` says is what is there, and what a wheel holds."""

import configparser
import os
import pathlib
import shutil
import subprocess
import sys
import zipfile

import pytest

_ROOT = pathlib.Path(__file__).resolve().parent.parent
_DATA = {  # Folder -> pattern of the files that must be shipped.
  'xml': '*.xml',
  'flags': '*.flags',
  'dmc_multimode/pretrained': '**/*',
}


def _config() -> configparser.ConfigParser:
  config = configparser.ConfigParser(interpolation=None)
  config.read(_ROOT / 'setup.cfg')
  return config


def _list(section: str, option: str) -> list[str]:
  return _config()[section][option].split()


def _data_files() -> set[str]:
  """Names that the files to ship have inside a wheel."""
  return {
    f'dmc_multimode/{path.relative_to((_ROOT / folder).parent).as_posix()}'
    for folder, pattern in _DATA.items()
    for path in (_ROOT / folder).glob(pattern)
    if path.is_file() and path.suffix not in ('.py', '.pyc')
  }


def test_every_subpackage_is_listed() -> None:
  found = {
    '.'.join(path.parent.relative_to(_ROOT).parts)
    for path in (_ROOT / 'dmc_multimode').rglob('__init__.py')
  }
  mapped = {'dmc_multimode.flags', 'dmc_multimode.xml'}
  assert set(_list('options', 'packages')) == found | mapped


def test_mujoco_stays_below_4() -> None:
  assert 'mujoco>=3.17,<4' in _list('options', 'install_requires')


def test_scripts_name_modules_with_a_cli() -> None:
  scripts = _config()['options.entry_points']['console_scripts']
  for line in scripts.strip().splitlines():
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
  result = subprocess.run(
    [sys.executable, '-c', code], cwd=_ROOT, capture_output=True, text=True
  )
  assert result.returncode == 0, result.stderr
  assert not pathlib.Path(result.stdout.strip()).is_relative_to(_ROOT / 'xml')


@pytest.fixture(scope='module')
def wheel(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """A wheel built from a copy: builds leave files in their tree."""
  pytest.importorskip('setuptools', minversion='77')
  folder = tmp_path_factory.mktemp('wheel')
  source = folder / 'source'
  source.mkdir()
  for name in ('dmc_multimode', 'flags', 'xml'):
    ignore = shutil.ignore_patterns('__pycache__')
    shutil.copytree(_ROOT / name, source / name, ignore=ignore)
  for name in ('setup.cfg', 'pyproject.toml', 'LICENSE', 'README.md'):
    if (_ROOT / name).exists():
      shutil.copy(_ROOT / name, source)
  command = [sys.executable, '-m', 'pip', 'wheel', '--no-deps', '--no-index']
  command += ['--no-build-isolation', '-w', str(folder), str(source)]
  result = subprocess.run(command, capture_output=True, text=True)
  assert result.returncode == 0, result.stdout + result.stderr
  [built] = folder.glob('dmc_multimode-*.whl')
  return built


def test_wheel_holds_code_and_data(wheel: pathlib.Path) -> None:
  with zipfile.ZipFile(wheel) as archive:
    held = set(archive.namelist())
  code = {
    path.relative_to(_ROOT).as_posix()
    for path in (_ROOT / 'dmc_multimode').rglob('*.py')
  }
  assert 'dmc_multimode/xml/mini_biped.xml' in held
  assert code | _data_files() <= held
  tops = {name.split('/')[0] for name in held}
  assert tops == {'dmc_multimode', next(t for t in tops if 'dist-info' in t)}
  assert any(name.endswith('LICENSE') for name in held)


def test_resources_of_an_unpacked_wheel(
  wheel: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  site = tmp_path / 'site'
  with zipfile.ZipFile(wheel) as archive:
    archive.extractall(site)
  code = (
    'from dmc_multimode.utils import resources as r; '
    "print(r.path('xml', 'mini_biped.xml'), *r.names('flags'))"
  )
  result = subprocess.run(
    [sys.executable, '-S', '-c', code],  # -S: no editable install in the way.
    env={**os.environ, 'PYTHONPATH': str(site)},
    cwd=tmp_path,
    capture_output=True,
    text=True,
  )
  assert result.returncode == 0, result.stderr
  found, *flags = result.stdout.split()
  assert found == str(site / 'dmc_multimode' / 'xml' / 'mini_biped.xml')
  assert flags == sorted(path.name for path in (_ROOT / 'flags').glob('*'))
