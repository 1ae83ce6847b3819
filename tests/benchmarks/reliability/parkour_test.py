"""Tests of benchmarks.reliability.parkour and of its conditions."""

import json
import math
import pathlib
from typing import Any

import pytest

from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.suite.imitation import events
from tests.benchmarks import modules
from tests.bin import processes

parkour = modules.load('reliability.parkour')


class _Asked(Exception):
  """Ends a planning whose arguments are known."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
  """The keyword arguments of the last planning, none of which is made."""
  seen: dict[str, Any] = {}

  def solve(*args: Any, **arguments: Any) -> plan_lib.PlanResult:
    seen.update(arguments)
    raise _Asked(args)

  monkeypatch.setattr(parkour.planner_lib, 'solve', solve)
  return seen


@pytest.mark.parametrize('controller', parkour.Controllers.names)
def test_what_a_controller_meets(
  controller: str, asked: dict[str, Any]
) -> None:
  controllers = parkour.Controllers('pi2', replan_every=3, seconds=2.0)
  sees = controller == 'selector'

  def run(condition: str) -> dict[str, Any]:
    with pytest.raises(_Asked, match="'pi2', 'parkour', 7, "):
      controllers.run(controller, parkour.CONDITIONS[condition], 7)
    return dict(asked)

  nominal = run('nominal')
  assert nominal['replan_every'] == (3 if controller == 'replanning' else 0)
  assert nominal['seconds'] == (None if sees else 2.0)
  assert nominal['pushes'] == () and nominal['map_error'] == 0
  assert nominal['disturbed'] == events.NONE
  for push in run('pushes 0.5 m/s')['pushes']:
    assert math.hypot(*push.velocity) == pytest.approx(0.5)
  slippery = run('friction 0.5')['disturbed'].disturbances
  assert slippery.active == ('friction',) and slippery.friction == (0.5, 0.5)
  for condition, error in (
    ('edges 5 cm nearer', 0.05),
    ('edges 5 cm farther', -0.05),
  ):
    wrong = run(condition)
    assert wrong['map_error'] == (0 if sees else error)
    if sees:
      assert wrong['planner'].scan_errors.nearer == error


def test_scan_noise_concerns_who_looks() -> None:
  for name, condition in parkour.CONDITIONS.items():
    everybody = name != 'scan noise 5 cm'
    assert len(parkour.concerned(condition)) == (3 if everybody else 1)
  runs = [
    {'controller': 'selector', 'seed': seed, 'success': seed < 2}
    for seed in range(3)
  ]
  assert parkour.summary('noise', runs) == {
    'condition': 'noise',
    'open_loop': None,
    'replanning': None,
    'selector': 2,
    'of': 3,
  }


@pytest.mark.slow
def test_report(benchmark: processes.Binary, tmp_path: pathlib.Path) -> None:
  out = tmp_path / 'parkour.json'
  done = benchmark(
    '--tracks=1',
    '--conditions=nominal,scan noise 5 cm',
    '--replan_every=12',
    f'--out={out}',
  )
  assert done.code == 0, done.stderr
  report = json.loads(out.read_text())
  nominal, noise = report['table']
  assert [nominal[name] for name in parkour.Controllers.names] == [1, 1, 1]
  assert noise['open_loop'] is noise['replanning'] is None
  assert len(report['runs']) == 4
  for run in report['runs']:
    off = abs(run['goal'][0] - run['final_position'][0])
    assert not run['success'] or off <= 0.25
  lines = done.stdout.splitlines()[-2:]
  assert lines[0].split() == ['nominal', '1', '1', '1', '1']
  assert lines[1].split() == [
    *('scan', 'noise', '5', 'cm'),
    str(noise['selector']),
    '1',
  ]


def test_bad_input(benchmark: processes.Binary) -> None:
  done = benchmark('--conditions=nominal,wind')
  assert done.code == 2, done.stderr
  assert "'wind' is not one of nominal, pushes 0.5 m/s" in done.error
  done = benchmark('--policy=quickstart')
  assert done.code == 2, done.stderr
  assert 'no selector beside it' in done.error
