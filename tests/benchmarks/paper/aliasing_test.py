"""Tests of benchmarks.paper.aliasing and of what it measures."""

import json
import pathlib

import numpy as np
import pytest

from dmc_multimode.suite.imitation import config as task_config
from tests.benchmarks import modules
from tests.bin import processes
from tests.bin import untrained

aliasing = modules.load('paper.aliasing')

_TIMESTEP = 0.1  # Seconds.


def _profiles(robot: float) -> dict[str, np.ndarray]:
  """A walk at constant height and leaps of 0.2 m; `robot` of it."""
  steps = np.arange(48)
  wave = 0.1 * np.sin(2 * np.pi * steps / 12)
  still = np.zeros(48)
  return {
    'robot': 0.4 + np.stack([still, robot * wave]),
    'reference': 0.5 + np.stack([still, wave]),
  }


@pytest.mark.parametrize('robot', [0.0, 0.5, 1.2])
def test_separation_is_relative_to_the_references(robot: float) -> None:
  found = aliasing.separation(_profiles(robot), _TIMESTEP)
  assert found == pytest.approx(robot)
  heights = _profiles(robot)
  heights['robot'][:, :12] += 1.0  # The first 1.2 seconds do not count.
  assert aliasing.separation(heights, _TIMESTEP) == pytest.approx(robot)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  result = tmp_path_factory.mktemp('policy')
  task = task_config.ImitationConfig(time_limit=1.5)
  untrained.save(result, ('idle', 'walk_forward', 'leap_forward'), task, {})
  return result


def test_report(
  benchmark: processes.Binary, folder: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  out = tmp_path / 'aliasing.json'
  done = benchmark(
    f'--policy={folder}',
    '--episodes=2',
    f'--out={out}',
    f'--figures={tmp_path}',
  )
  assert done.code == 0, done.stderr
  assert list(json.loads(out.read_text())['separation']) == [str(folder)]
  assert (tmp_path / 'aliasing.png').is_file()


@pytest.mark.parametrize('modes', ['idle', 'idle,idle'])
def test_needs_two_modes(benchmark: processes.Binary, modes: str) -> None:
  done = benchmark(f'--modes={modes}')
  assert done.code == 2, done.stderr
  assert 'two modes that differ' in done.error
