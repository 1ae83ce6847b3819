"""Tests of dmc_multimode.bin.plan, and of recording what it found."""

import json
import pathlib
from typing import Iterator

import pytest

from dmc_multimode import pretrained
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.suite.reaching import problem as reaching
from tests.bin import processes
from tests.planner import replay

_WALK = (
  '--policy=quickstart',
  '--arena=flat',
  '--goal=0.6,0,0.5',
  '--knots=4',
  '--dt=0.3',
  '--beam_beams=2',
  '--threads=1',
)


@pytest.fixture(scope='module')
def plan(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  binary = processes.Binary('plan', tmp_path_factory.mktemp('output'))
  yield binary
  binary.close()


@pytest.fixture(scope='module')
def record(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  binary = processes.Binary('record', tmp_path_factory.mktemp('output'))
  yield binary
  binary.close()


def test_plan_and_record(
  plan: processes.Binary, record: processes.Binary, tmp_path: pathlib.Path
) -> None:
  out, figure = tmp_path / 'new' / 'plan.json', tmp_path / 'plan.png'
  done = plan(*_WALK, f'--out={out}', f'--figure={figure}')
  assert done.code == 0, done.stderr
  assert 'reached the goal' in done.stdout
  assert figure.read_bytes().startswith(b'\x89PNG')
  values = json.loads(out.read_text())
  assert values['success']
  assert values['goal'] == [0.6, 0.0, 0.5]
  assert abs(values['final_position'][0] - 0.6) < 0.3
  assert (values['knots'], values['dt'], values['arena']) == (4, 0.3, 'flat')
  assert len(values['plan']) == 4
  assert values['control_steps'] == 40 * (2 * 3 + 1)
  assert values['rollouts'] > 0
  assert values['return'] > 0
  assert values['solve_seconds'] > 0
  assert (values['pushes'], values['replan_every']) == ([], 0)
  again = tmp_path / 'again.json'
  assert plan(*_WALK, f'--out={again}').code == 0
  second = json.loads(again.read_text())
  for key in values.keys() - {'solve_seconds'}:
    assert second[key] == values[key], key

  video = tmp_path / 'plan.mp4'
  small = '--width=64', '--height=48'
  done = record(
    '--policy=quickstart', f'--plan={out}', f'--out={video}', *small
  )
  assert done.code == 0, done.stderr
  assert f'wrote {video} (40 frames)' in done.stdout


def test_pushes_and_replanning(
  plan: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """What is written is what was commanded, and why."""
  out, figure = tmp_path / 'plan.json', tmp_path / 'plan.png'
  flags = [
    *_WALK,
    '--knots=6',
    '--beam_attempts=1',
    '--push=0.9:-1:0.1,0.6:0.2',
    '--replan_every=2',
  ]
  done = plan(*flags, f'--out={out}', f'--figure={figure}')
  assert done.code in (0, 3), done.stderr
  assert figure.exists()
  values = json.loads(out.read_text())
  assert values['pushes'] == [
    {'time': 0.9, 'velocity': [-1.0, 0.1, 0.0]},
    {'time': 0.6, 'velocity': [0.2, 0.0, 0.0]},
  ]
  assert values['replan_every'] == 2
  assert values['success'] == (done.code == 0)
  file = plan_lib.PlanFile.read(out)
  replayed = replay.replay(
    pretrained.load('quickstart'),
    reaching.ReachingConfig((0.6, 0.0, 0.5), 6, 0.3),
    file.plan,
    file.course.pushes,
  )
  assert replayed.position[0].tolist() == values['final_position']


def test_q_learning_and_sizes(
  plan: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """A gap that is a crack; too far a goal is told by the exit code."""
  out = tmp_path / 'plan.json'
  flags = [
    *_WALK,
    '--arena=gap',
    '--sizes=width:0.01,distance:0.4',
    '--planner=q_learning',
    '--q_learning_trials=2',
    '--q_learning_episodes=3',
    '--seed=5',
    f'--out={out}',
  ]
  assert plan(*flags, '--goal=3,0,0.5').code == 3
  values = json.loads(out.read_text())
  assert not values['success']
  assert values['sizes'] == {'width': 0.01, 'distance': 0.4}
  assert (values['planner'], values['seed']) == ('q_learning', 5)
  assert values['rollouts'] == 6


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--arena=gap', '--sizes=width'], 'not NAME:METRES'),
    (['--arena=gap', '--sizes=width:wide'], 'not NAME:METRES'),
    (['--goal=1,2'], 'not X,Y,Z'),
    (['--seed=-1'], 'seed'),
    (['--replan_every=-1'], 'replan_every must not be negative'),
    (['--push=0.3:1,0.6:x'], "'0.6:x' is no push"),
    (['--push=0.5:1'], 'at 0.5 s is not at a knot'),
    (['--policy={tmp}/none'], 'no pretrained named'),
    (['--out={tmp}'], 'is a folder'),
    (['--figure={tmp}'], 'is a folder'),
  ],
)
def test_bad_input(
  plan: processes.Binary,
  tmp_path: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  done = plan(*_WALK, *(flag.format(tmp=tmp_path) for flag in flags))
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
  ('content', 'flags', 'message'),
  [
    ({}, [], 'lacks'),
    ({'plan': ['launch']}, [], 'launch'),
    ({'arena': 'moat'}, [], 'moat'),
    ({'pushes': [{'time': 9, 'velocity': [1, 0, 0]}]}, [], 'outside of'),
    ({'plan': ['idle']}, ['--arena=gap'], '--plan says what --arena would'),
  ],
)
def test_bad_plans(
  record: processes.Binary,
  tmp_path: pathlib.Path,
  content: dict[str, object],
  flags: list[str],
  message: str,
) -> None:
  path, video = tmp_path / 'plan.json', tmp_path / 'plan.mp4'
  good = {
    'plan': ['idle'],
    'knots': 1,
    'dt': 0.3,
    'arena': 'flat',
    'sizes': {},
    'seed': 0,
  }
  path.write_text(json.dumps({**good, **content} if content else {}))
  done = record(
    '--policy=quickstart', f'--plan={path}', f'--out={video}', *flags
  )
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not video.exists()
