"""Tests of dmc_multimode.bin.plan, and of recording what it found."""

import json
import pathlib
from typing import Iterator

import pytest

from tests.bin import processes

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
  assert 'stands at the goal' in done.stdout
  assert figure.read_bytes().startswith(b'\x89PNG')
  values = json.loads(out.read_text())
  assert values['reached']
  assert values['goal'] == [0.6, 0.0, 0.5]
  assert abs(values['final_position'][0] - 0.6) < 0.25
  assert (values['knots'], values['dt'], values['arena']) == (4, 0.3, 'flat')
  assert len(values['plan']) == 4
  video = tmp_path / 'plan.mp4'
  small = '--width=64', '--height=48'
  flags = '--policy=quickstart', f'--plan={out}', f'--out={video}', *small
  done = record(*flags)
  assert done.code == 0, done.stderr
  assert f'wrote {video} (90 control steps)' in done.stdout
  done = record(*flags, '--arena=gap')
  assert done.code == 2
  assert '--plan says what --arena would' in done.error


def test_pushes_and_replanning(
  plan: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """The file holds the commanded modes and their origin."""
  out = tmp_path / 'plan.json'
  flags = [
    *_WALK,
    '--knots=6',
    '--beam_attempts=1',
    '--push=0.9:-1:0.1,0.6:0.2',
    '--replan_every=2',
  ]
  done = plan(*flags, f'--out={out}')
  assert done.code in (0, 3), done.stderr
  values = json.loads(out.read_text())
  assert values['pushes'] == [
    {'time': 0.9, 'velocity': [-1.0, 0.1, 0.0]},
    {'time': 0.6, 'velocity': [0.2, 0.0, 0.0]},
  ]
  assert values['replan_every'] == 2
  assert values['reached'] == (done.code == 0)


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
  assert not values['reached']
  assert values['sizes'] == {'width': 0.01, 'distance': 0.4}
  assert (values['planner'], values['seed']) == ('q_learning', 5)
  assert values['rollouts'] == 6


def test_a_track_has_its_own_problem(
  plan: processes.Binary, tmp_path: pathlib.Path
) -> None:
  """But for the flags that are given; paths are read as a shell reads them."""
  home = tmp_path / 'home'
  home.mkdir()
  plan.start(
    '--policy=quickstart',
    '--arena=gap',
    '--knots=2',
    '--beam_beams=1',
    '--beam_attempts=1',
    '--out=~/plan.json',
    before=f'import os; os.environ["HOME"] = {str(home)!r}',
  )
  assert plan.wait().code == 3
  values = json.loads((home / 'plan.json').read_text())
  assert (values['goal'], values['dt']) == ([2.0, 0.0, 0.5], 0.3)
  assert values['knots'] == 2


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--arena=gap', '--sizes=width'], 'not NAME:METRES'),
    (['--goal=1,2'], 'not X,Y,Z'),
    (['--push=0.3:1,0.6:x'], "'0.6:x' is no push"),
    (['--push=0.5:1'], 'at 0.5 s is not at a knot'),
    (['--goal=-1,0,0.5'], 'is behind the start'),
    (['--out={tmp}'], 'is a folder'),
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
