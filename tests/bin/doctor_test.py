"""Tests of dmc_multimode.bin.doctor."""

import configparser
import os
import pathlib
import re
import subprocess
import sys
from typing import Any, Callable

import pytest

from dmc_multimode.bin import doctor

_ROOT = pathlib.Path(__file__).resolve().parents[2]


def _found(check: doctor.Check) -> dict[str, doctor.Finding]:
  return {finding.topic: finding for finding in check()}


def _fail(error: Exception) -> Callable[..., Any]:
  def raise_it(*args: Any, **kwargs: Any) -> Any:
    raise error

  return raise_it


def _run(
  folder: pathlib.Path, **variables: str
) -> subprocess.CompletedProcess[str]:
  paths = {'PYTHONPATH': str(_ROOT)}
  return subprocess.run(
    [sys.executable, '-m', 'dmc_multimode.bin.doctor'],
    cwd=folder,
    env={**os.environ, **paths, **variables},
    capture_output=True,
    text=True,
  )


@pytest.mark.gl
def test_all_is_there(tmp_path: pathlib.Path) -> None:
  done = _run(tmp_path, OMP_NUM_THREADS='1')
  assert (done.returncode, done.stderr) == (0, '')
  lines = done.stdout.splitlines()
  assert lines[-1] == 'All is there that planning, training and recording need.'
  topics = [line[:16].strip() for line in lines[:-1]]
  expected = ['dmc_multimode', 'Python', 'mujoco', 'torch', 'numpy', 'OpenGL']
  expected += ['cores', 'BLAS threads', 'policies', 'working folder']
  expected += [f'extra {name}' for name in doctor.EXTRAS]
  assert set(expected) <= set(topics)
  assert 'OMP_NUM_THREADS=1; torch takes 1' in done.stdout
  assert not list(tmp_path.iterdir())


def test_without_opengl_a_line_says_what_to_install(
  tmp_path: pathlib.Path,
) -> None:
  done = _run(tmp_path, MUJOCO_GL='nothing')
  assert done.returncode == 2
  (line,) = done.stderr.splitlines()
  assert line.startswith('error: MUJOCO_GL=nothing cannot draw here')
  assert 'apt-get install libegl1' in line
  assert 'All is there' not in done.stdout and 'policies' in done.stdout


def test_extras_are_those_of_the_package() -> None:
  config = configparser.ConfigParser(interpolation=None)
  config.read(_ROOT / 'setup.cfg')
  own = {
    name: re.findall(r'^([\w.-]+)', text, re.MULTILINE)
    for name, text in config['options.extras_require'].items()
  }
  assert own.pop('bench') == ['dmc_multimode']
  bench = [d for name in ('gym', 'rsl_rl', 'sb3') for d in own[name]]
  assert list(doctor.EXTRAS['bench'].distributions) == bench
  found = {name: list(e.distributions) for name, e in doctor.EXTRAS.items()}
  del found['bench']
  assert found == own


def test_extras(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(doctor, '_version', lambda name: '1' * (name != 'viser'))
  found = _found(doctor.find_extras)
  assert found['extra gym'].text.endswith('; installed')
  assert found['extra view'].text.endswith(
    "; missing viser: pip install 'dmc_multimode[view]'"
  )
  assert not any(finding.advice for finding in found.values())


def test_requirements(monkeypatch: pytest.MonkeyPatch) -> None:
  versions = {'dmc_multimode': '0.1', 'mujoco': '4.0', 'torch': '2.13.0+cpu'}
  required = ['mujoco<4,>=3.17', 'torch>=2.4', 'scipy>=1.14']
  required += ['viser>=1; extra == "view"']
  monkeypatch.setattr(doctor, '_version', lambda name: versions.get(name, ''))
  monkeypatch.setattr(
    doctor.importlib.metadata, 'requires', lambda name: required
  )
  found = _found(doctor.find_versions)
  assert found['mujoco'].text == '4.0' and found['numpy'].text == 'missing'
  assert found['required'].advice == (
    "pip install 'mujoco<4,>=3.17' 'scipy>=1.14'"
  )
  missing = doctor.importlib.metadata.PackageNotFoundError()
  monkeypatch.setattr(doctor.importlib.metadata, 'requires', _fail(missing))
  found = _found(doctor.find_versions)
  assert found['required'].advice == "pip install 'dm_control' 'numpy'"


def test_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(doctor.gl, 'choose_backend', _fail(OSError('no GL: apt')))
  monkeypatch.setitem(sys.modules, 'av', None)
  found = _found(doctor.find_drawing)
  assert found['OpenGL'].advice == 'no GL: apt'
  assert 'pip install' in found['videos'].advice
  monkeypatch.setattr(doctor.importlib.util, 'find_spec', lambda name: None)
  assert not _found(doctor.find_drawing)['OpenGL'].advice


def test_policies(monkeypatch: pytest.MonkeyPatch) -> None:
  from dmc_multimode.pretrained import policy

  damaged = {'pi1'}

  def load(name: str) -> None:
    if name in damaged:
      raise ValueError('it is truncated')

  monkeypatch.setattr(policy, 'load', load)
  found = _found(doctor.find_policies)
  assert found['policy pi1'].text == 'it is truncated'
  assert 'pi2' in found['policies'].text and not found['policies'].advice
  damaged.add('pi2')
  assert (
    'pi2 cannot be loaded' in _found(doctor.find_policies)['policies'].advice
  )
  monkeypatch.setattr(
    doctor.importlib, 'import_module', _fail(ImportError('no torch'))
  )
  assert _found(doctor.find_policies)['policies'].advice.startswith('no torch')


def test_policies_of_robots_that_are_not_installed(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  from dmc_multimode.pretrained import policy
  from dmc_multimode.walkers import robot_files

  monkeypatch.setattr(policy, 'load', lambda name: None)
  monkeypatch.setattr(
    robot_files, 'is_here', lambda model: not robot_files.is_packaged(model)
  )
  found = _found(doctor.find_policies)
  text = found['policies of other robots'].text
  assert 'go1_quickstart' in text and '[robots]' in text
  assert 'go1_quickstart' not in found['policies'].text


def test_folders(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.chdir(tmp_path)
  found = _found(doctor.find_folders)
  assert found['working folder'].text == f'{tmp_path} is writable'
  error = PermissionError(13, 'Permission denied')
  monkeypatch.setattr(doctor.tempfile, 'TemporaryFile', _fail(error))
  found = _found(doctor.find_folders)
  assert found['working folder'].text == f'{tmp_path}: Permission denied'
  assert f'make {tmp_path} writable' in found['working folder'].advice


def test_advice_is_the_error(
  monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  findings = [
    doctor.Finding('a', 'is there'),
    doctor.Finding('b', 'is not', 'pip install b'),
    doctor.Finding('c', 'is not', 'pip install c'),
  ]
  monkeypatch.setattr(doctor, 'CHECKS', (lambda: iter(findings),))
  with pytest.raises(OSError, match='^pip install b; pip install c$'):
    doctor.main(['doctor'])
  assert len(capsys.readouterr().out.splitlines()) == 3
