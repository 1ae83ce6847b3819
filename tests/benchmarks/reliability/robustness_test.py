"""Tests of benchmarks.reliability.robustness and of its cases."""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.modes import schedule
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import events
from dmc_multimode.utils import schedule as schedules
from tests.benchmarks import modules
from tests.bin import processes
from tests.bin import untrained

robustness = modules.load('reliability.robustness')

_CONFIG = task_config.ImitationConfig(time_limit=0.3, events=events.NONE)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The folder of an untrained policy, for episodes of 0.3 seconds."""
  result = tmp_path_factory.mktemp('policy')
  untrained.save(result, ('idle', 'launch'), _CONFIG, {})
  return result


def _worlds(folder: pathlib.Path, case: Any, mode: int = 0) -> Any:
  plan = schedule.single(np.full(3, mode))
  return robustness.Worlds(case, pretrained.load(folder), plan, _CONFIG, 0)


@pytest.mark.parametrize('offset', [-0.06, 0.06])
def test_edges(folder: pathlib.Path, offset: float) -> None:
  plain = _worlds(folder, robustness.Case(), mode=1)
  other = _worlds(folder, robustness.Case(edge=offset), mode=1)
  for worlds in (plain, other):
    worlds.reset()
  edges = plain.core.terrain.starts[:, 1]
  np.testing.assert_allclose(edges, 0.27)
  np.testing.assert_allclose(other.core.terrain.starts[:, 1], edges + offset)
  # The references are as they were.
  np.testing.assert_array_equal(
    plain.core.tracker.reference().position,
    other.core.tracker.reference().position,
  )


def test_pushes_come_once_a_second(folder: pathlib.Path) -> None:
  plain = _worlds(folder, robustness.Case())
  other = _worlds(folder, robustness.Case(push=(0.3, 0.3)))
  action = np.tile(plain.standing_action(), (3, 1))
  plain.reset()
  other.reset()
  for step in range(1, 34):
    plain.step(action)
    if step < 33:
      other.step(action)
      np.testing.assert_array_equal(other.qvel, plain.qvel)
  before = other.qpos.copy()
  other.step(action)
  # Within a control step of 0.03 s, feet on the ground.
  moved = other.qpos[:, :2] - before[:, :2]
  assert (np.linalg.norm(moved, axis=1) > 0.003).all()
  assert np.ptp(np.arctan2(moved[:, 1], moved[:, 0])) > 0.1
  assert not np.array_equal(other.qvel, plain.qvel)


def test_weak_servos_and_bumps(folder: pathlib.Path) -> None:
  worlds = _worlds(folder, robustness.Case(torque_limit=18.0))
  assert np.abs(worlds.physics.model.actuator_forcerange).max() == 18.0
  worlds = _worlds(folder, robustness.Case(bumps=0.03), mode=1)
  worlds.reset()
  tops = worlds.core.terrain.tops
  assert (tops[:, 0] == 0).all()
  assert (tops[:, 1] == 0.4).all()  # The block of a launch stays what it is.
  worlds = _worlds(folder, robustness.Case(bumps=0.03))
  worlds.reset()
  tops = worlds.core.terrain.tops[:, 1:25]
  assert 0 <= tops.min() < 0.01 and 0.02 < tops.max() <= 0.03
  assert len({tuple(row) for row in tops}) == 3


def test_obstacles(folder: pathlib.Path) -> None:
  plan, case = (
    schedule.single(np.full(3, 1)),
    robustness.Case(obstacles=1.0),
  )
  trained = dataclasses.replace(
    _CONFIG,
    events=events.TrainingEvents(
      reference_starts=0.0,
      edge_noise=0.0,
      obstacles=schedules.Schedule(0.0, 0.4, 10**6, 10**6),
    ),
  )
  worlds = robustness.Worlds(case, pretrained.load(folder), plan, trained, 0)
  worlds.reset()
  # A block of another height, or there would be nothing to withstand.
  tops = worlds.core.terrain.tops[:, 1]
  assert (tops < 0.4).all()
  assert np.ptp(tops) > 0


def test_report(
  benchmark: processes.Binary, folder: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  out = tmp_path / 'robustness.json'
  names = ['nominal', '1 ms', 'edge 6 cm nearer', 'mass +10 %', 'pushes']
  done = benchmark(
    f'--policy={folder}',
    '--episodes=1',
    '--fall_episodes=3',
    f'--cases={",".join(names)}',
    f'--out={out}',
  )
  assert done.code == 0, done.stderr
  table = json.loads(out.read_text())['table']
  assert [row['name'] for row in table] == names
  lines = done.stdout.splitlines()[-len(names) :]
  for row, line in zip(table, lines, strict=True):
    assert line.startswith(row['name'])
    assert 0 < row['mra_transitions'] < 1
    assert row['policy'] == folder.name and 0 <= row['upright'] <= 1
    assert row['worst_modes'] in ('idle', 'launch')
  plain, fine, _, heavy, pushed = (row['mra_modes'] for row in table)
  assert len({plain, fine, heavy}) == 3
  assert pushed == plain  # The episodes end before the first push.


def test_unknown_case(benchmark: processes.Binary) -> None:
  done = benchmark('--cases=nominal,wind')
  assert done.code == 2, done.stderr
  assert "'wind' is not one of nominal, 2 ms" in done.error
