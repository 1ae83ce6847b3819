"""Tests of dmc_multimode.bin.check_robot."""

import pathlib
import shutil
import subprocess
import sys

import pytest
import yaml

from dmc_multimode.bin import check_robot
from dmc_multimode.walkers import robot as robot_lib

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
      [
        "standing height        0.217 m, 0.434 of the mini biped's",
        # Stiffness, limit, scale; 0.5 of the servo and 0.05 of the joint.
        '20         12     0.60   0.55     -fr_roll',
        'stands for 5 s: 1 mm lower, tilted by 0.00 rad, 4 of 4 feet down',
      ],
    ),
    (
      _ROOT / 'xml' / 'mini_biped.yaml',
      [
        'height        0.5 m, 1 of the mini',
        'standing action   falls after 2.',
        'training has to learn to balance',
      ],
    ),
  ],
)
def test_a_good_robot(path: pathlib.Path, lines: list[str]) -> None:
  done = _check(path)
  assert done.returncode == 0, done.stderr
  for line in lines:
    assert line in done.stdout
  assert 'warning' not in done.stderr


def test_unusual_servos(tmp_path: pathlib.Path) -> None:
  """Are told in a line each, with all their joints."""
  for path in _ROBOTS.iterdir():
    shutil.copy(path, tmp_path)
  path = tmp_path / 'four_legs.yaml'
  text = path.read_text()
  limits = dict.fromkeys(yaml.safe_load(text)['joints'], 12)
  limits |= {'fl_roll': 30, 'fr_roll': 30}
  path.write_text(text.replace('limit: 12', f'limit: {limits}'))
  robot = robot_lib.load(path)
  assert list(check_robot.unusual(robot)) == [
    'warning: limit / stiffness is 0.4 to 1.2 of robots that come along, and '
    'here 1.5 of fl_roll, 1.5 of fr_roll'
  ]
  path.write_text(text.replace('damping: 0.5', 'damping: 3'))
  (line,) = check_robot.unusual(robot_lib.load(path))
  assert 'damping / stiffness is 0.017 to 0.125 of' in line
  assert line.endswith(', '.join(f'0.15 of {name}' for name in robot.joints))


@pytest.mark.parametrize('name', robot_lib.names())
def test_robots_that_come_along_are_usual(name: str) -> None:
  try:
    robot = robot_lib.load(name)
  except ValueError:
    pytest.skip('its model takes the extra `robots`')
  assert not list(check_robot.unusual(robot))


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
  assert 'the robot cannot stand: it sinks by' in done.stderr
