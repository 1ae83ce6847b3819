"""Tests of dmc_multimode.bin.check_robot."""

import pathlib
import shutil
import subprocess
import sys

import pytest

_ROOT = pathlib.Path(__file__).parents[2]
_ROBOTS = _ROOT / 'tests' / 'robots'


def _check(path: pathlib.Path) -> subprocess.CompletedProcess[str]:
  return subprocess.run(
    [sys.executable, '-m', 'dmc_multimode.bin.check_robot', f'--robot={path}'],
    cwd=_ROOT,
    capture_output=True,
    text=True,
  )


@pytest.mark.parametrize(
  ('path', 'lines'),
  [
    (
      _ROBOTS / 'four_legs.yaml',
      ['standing height        0.217 m (0.434)', '-fr_roll', '4 of 4 feet'],
    ),
    (
      _ROOT / 'xml' / 'mini_biped.yaml',
      ['standing height        0.5 m (1)', 'stands: 1 mm', 'falls:'],
    ),
  ],
)
def test_a_good_robot(path: pathlib.Path, lines: list[str]) -> None:
  done = _check(path)
  assert done.returncode == 0, done.stderr
  for line in lines:
    assert line in done.stdout


def test_a_bad_robot(tmp_path: pathlib.Path) -> None:
  for path in _ROBOTS.iterdir():
    shutil.copy(path, tmp_path)
  path = tmp_path / 'four_legs.yaml'
  path.write_text(path.read_text().replace('fl_foot', 'toe'))
  done = _check(path)
  assert (done.returncode, done.stdout) == (2, '')
  assert done.stderr == (
    f"error: {path}: four_legs: the foot 'toe' is neither a site nor a geom "
    'nor a body.\n'
  )
  # Its servos carry it in the standing pose, yet not when it sways.
  text = (_ROBOTS / 'four_legs.yaml').read_text()
  path.write_text(text.replace('stiffness: 20', 'stiffness: 0.3'))
  done = _check(path)
  assert done.returncode == 2
  assert 'the robot cannot stand: stiffen its servos' in done.stderr
