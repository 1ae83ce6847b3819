"""Tests for gl."""

import os
import pathlib
import re
import subprocess
import sys
from typing import Iterator

import pytest

import dmc_multimode
from dmc_multimode.utils import gl

_PACKAGE = pathlib.Path(dmc_multimode.__file__).parent
# GLVND looks for its EGL vendors there: no libegl in effect.
_NO_EGL = {'__EGL_VENDOR_LIBRARY_DIRS': '/nonexistent', 'MUJOCO_GL': 'egl'}


@pytest.fixture(autouse=True)
def _unset(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
  """MUJOCO_GL unset and dm_control not imported; both as before afterwards."""
  monkeypatch.setenv(gl.VARIABLE, '')
  monkeypatch.delitem(sys.modules, 'dm_control._render', raising=False)
  yield


def _only(*working: str) -> gl.Probe:
  return lambda backend: None if backend in working else 'not here'


@pytest.mark.parametrize(
  ('working', 'expected'),
  [(('egl', 'osmesa'), 'egl'), (('osmesa',), 'osmesa'), (('egl',), 'egl')],
)
def test_first_backend_that_draws(
  working: tuple[str, ...], expected: str
) -> None:
  assert gl.choose_backend(_only(*working)) == expected
  assert os.environ['MUJOCO_GL'] == expected


def test_the_users_choice_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setenv('MUJOCO_GL', 'glfw')
  assert gl.choose_backend(_only('egl', 'glfw')) == 'glfw'
  assert os.environ['MUJOCO_GL'] == 'glfw'


@pytest.mark.parametrize(
  ('choice', 'working', 'message'),
  [
    ('', (), 'libegl1 libgl1-mesa-dri.*libosmesa6'),
    ('osmesa', ('egl',), r'MUJOCO_GL=osmesa .*\(not here\)'),
  ],
)
def test_nothing_that_draws(
  monkeypatch: pytest.MonkeyPatch,
  choice: str,
  working: tuple[str, ...],
  message: str,
) -> None:
  monkeypatch.setenv('MUJOCO_GL', choice)
  with pytest.raises(OSError, match=message) as caught:
    gl.choose_backend(_only(*working))
  assert '\n' not in str(caught.value)
  assert os.environ['MUJOCO_GL'] == choice


@pytest.mark.parametrize(
  ('variable', 'code'),
  [
    ('', 'gl.choose_backend(lambda backend: None)'),
    ('', 'gl.choose()'),
    ('egl', ''),
  ],
)
def test_triton_is_imported_before_anything_is_drawn(
  variable: str, code: str, tmp_path: pathlib.Path
) -> None:
  (tmp_path / 'triton.py').write_text('print("triton")')
  imports = 'import dmc_multimode.suite; from dmc_multimode.utils import gl'
  variables = {'MUJOCO_GL': variable, 'PYTHONPATH': str(tmp_path)}
  done = _run(variables, '-c', f'{imports}; {code}')
  assert (done.returncode, done.stdout) == (0, 'triton\n'), done.stderr


@pytest.mark.gl
def test_after_dm_control(monkeypatch: pytest.MonkeyPatch) -> None:
  """It draws all the same, as long as nothing has been drawn."""
  script = (
    'from dm_control import mujoco; from dmc_multimode.utils import gl;'
    'gl.choose_backend();'
    "physics = mujoco.Physics.from_xml_string('<mujoco/>');"
    'print(physics.render(16, 16).shape)'
  )
  result = _run({'MUJOCO_GL': ''}, '-c', script)
  assert result.returncode == 0, result.stderr
  assert result.stdout.splitlines()[-1] == '(16, 16, 3)'
  # What dm_control has taken stays, and is not tried again.
  monkeypatch.setenv('MUJOCO_GL', 'glfw')
  monkeypatch.setitem(sys.modules, 'dm_control._render', os)
  assert gl.choose_backend(_only('egl')) == 'glfw'


_FRAME = """if True:
  import os, warnings
  from dmc_multimode.utils import gl
  {before}
  from dmc_multimode import suite
  before = os.environ.get('MUJOCO_GL')
  env = suite.load('multimode_biped', 'idle')
  env.reset()
  print(before, env.physics.render(16, 16).shape, os.environ['MUJOCO_GL'])
"""
_HEADLESS = {'DISPLAY': '', 'WAYLAND_DISPLAY': ''}


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize(
  ('before', 'drawn'),
  [
    (
      'warnings.simplefilter("error"); del os.environ["MUJOCO_GL"]',
      'None (16, 16, 3) egl',
    ),
    ('from dm_control import suite', ' (16, 16, 3) egl'),
    ('os.environ["DISPLAY"] = ":77"', ' (16, 16, 3) egl'),  # Dead.
    ('os.environ["MUJOCO_GL"] = "osmesa"', 'osmesa (16, 16, 3) osmesa'),
    ('gl.BACKENDS = ()', None),
  ],
)
def test_first_frame_of_the_suite(before: str, drawn: str | None) -> None:
  """Drawn without a display, and without a word from the commands."""
  environment = {'MUJOCO_GL': '', **_HEADLESS}
  if 'osmesa' in before and gl.why_not('osmesa'):
    pytest.skip('No OSMesa.')
  result = _run(environment, '-c', _FRAME.format(before=before))
  if drawn:
    assert result.stdout.strip() == drawn.strip(), result.stderr
  else:
    assert result.stderr.splitlines()[-1] == f'OSError: {gl.HELP}'


_ROOMS = sorted(
  {
    path.relative_to(_PACKAGE).parts[0]
    for path in _PACKAGE.rglob('*.py')
    if re.search(r'^(from|import) dm_control\b', path.read_text(), re.M)
  }
  # Which draws, and so chooses first.
  - {'viewer'}
)


@pytest.mark.parametrize('room', _ROOMS)
def test_nothing_looks_for_a_display_that_is_not_there(room: str) -> None:
  """Whichever package brings dm_control along, there is no warning."""
  script = (
    f'import dmc_multimode.{room}, sys; import dm_control._render;'
    'print(dm_control._render.BACKEND)'
  )
  result = _run({'MUJOCO_GL': '', **_HEADLESS}, '-W', 'error', '-c', script)
  assert (result.stdout, result.stderr) == ('off\n', '')


def test_a_probe_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(gl, '_DRAW', 'import time; time.sleep(60)')
  monkeypatch.setattr(gl, '_TIMEOUT', 0.1)
  assert 'no frame within' in str(gl.why_not('egl'))


def _run(
  environment: dict[str, str], *arguments: str
) -> subprocess.CompletedProcess[str]:
  return subprocess.run(
    [sys.executable, *(arguments or ('-m', 'dmc_multimode.viewer.gl'))],
    env={**os.environ, **environment},
    capture_output=True,
    text=True,
  )


def test_this_machine_with_and_without_egl() -> None:
  result = _run(_NO_EGL)
  assert (result.returncode, result.stdout) == (2, '')
  [line] = result.stderr.splitlines()
  assert line.startswith('error: MUJOCO_GL=egl cannot draw here')
  assert 'libegl1' in line
  result = _run({})
  if result.returncode:
    pytest.skip(result.stderr)
  assert result.stdout.strip() in gl.BACKENDS
