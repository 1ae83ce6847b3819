"""Tests of benchmarks.paper.blending."""

import json
import pathlib

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.modes import mode_set
from tests.benchmarks import modules
from tests.bin import processes

blending = modules.load('paper.blending')


def test_half_of_a_walk_is_a_walk_at_half_of_its_speed() -> None:
  policy = pretrained.load('quickstart')
  rows = blending.measure(
    policy, ('idle', 'walk_forward'), [0.0, 0.5, 1.0], episodes=1, seed=0
  )
  assert [row['blend'] for row in rows] == [
    'idle',
    'idle*0.5+walk_forward*0.5',
    'walk_forward',
  ]
  for row in rows:
    assert row['reference_x'] == pytest.approx(0.6 * row['share'], abs=0.01)
    assert row['velocity_x'] == pytest.approx(row['reference_x'], abs=0.05)
    assert row['velocity_y'] == pytest.approx(0.0, abs=0.05)
    assert row['survival'] == 1.0


@pytest.mark.parametrize('count', [2, 12, 13])
def test_shares_add_up(count: int) -> None:
  """Or the blends would be refused."""
  shares = np.linspace(0.0, 1.0, count).tolist()
  names = blending.names('idle', 'walk_forward', shares)
  policy = pretrained.load('quickstart')
  blended = mode_set.with_blends(policy.mode_set, names)
  assert len(blended) == len(policy.mode_set) + count - 2


def test_report(benchmark: processes.Binary, tmp_path: pathlib.Path) -> None:
  done = benchmark(
    '--policy=quickstart',
    '--modes=idle,walk_forward',
    '--shares=2',
    '--episodes=1',
    f'--out={tmp_path}/out.json',
    f'--figures={tmp_path}',
  )
  assert done.code == 0, done.stderr
  report = json.loads((tmp_path / 'out.json').read_text())
  (rows,) = report['blends']['quickstart'].values()
  assert [row['share'] for row in rows] == [0.0, 1.0]
  assert (tmp_path / 'blending.png').is_file()


@pytest.mark.parametrize('modes', ['idle', 'idle,idle', 'idle,fly'])
def test_bad_input(
  benchmark: processes.Binary, tmp_path: pathlib.Path, modes: str
) -> None:
  done = benchmark(
    '--policy=quickstart', f'--modes={modes}', f'--figures={tmp_path}/figures'
  )
  assert done.code == 2
  assert modes.rpartition(',')[2] in done.error
  assert not (tmp_path / 'figures').exists()
