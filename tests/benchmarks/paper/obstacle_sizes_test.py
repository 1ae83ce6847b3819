"""Tests of benchmarks.paper.obstacle_sizes and of its figure."""

import json
import pathlib

import numpy as np
import pytest

from dmc_multimode import planner
from dmc_multimode.arenas import layouts
from tests.benchmarks import modules
from tests.bin import processes

sizes = modules.load('paper.obstacle_sizes')


def test_the_papers_sizes_are_among_those_that_are_tried() -> None:
  gap, block = (sizes.OBSTACLES[name] for name in ('gap', 'block'))
  assert gap.default[:2] == (0.2, 0.25) and gap.default[-1] == 0.8
  assert (len(gap.default), len(block.default)) == (13, 11)
  assert block.default[0] == 0.2 and block.default[-1] == 0.7
  for name, obstacle in sizes.OBSTACLES.items():
    assert obstacle.paper in obstacle.default
    assert layouts.default_sizes(name)[obstacle.size] == obstacle.paper


def test_a_beam_search_follows_a_guided_one(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  given = planner.solve(
    'quickstart',
    'gap',
    planner=planner.BeamConfig(1, 1),
    quiet=True,
    seconds=0.01,
  )
  assert not given.success
  asked = []

  def solve(*args: object, **arguments: object) -> planner.PlanResult:
    asked.append((args[2], args[4], args[5], arguments['seconds']))
    return given

  monkeypatch.setattr(sizes.planner_lib, 'solve', solve)
  row = sizes.solve(
    'pi2', 'block', 0.65, 3, sizes.searches('guided'), 0.15, 8.0
  )
  found = [planner.GuidedConfig(), planner.BeamConfig()]
  assert asked == [(3, {'height': 0.65}, config, 4.0) for config in found]
  assert not row['success'] and row['found_by'] == 'beam'
  asked.clear()
  sizes.solve('pi2', 'gap', 0.3, 0, sizes.searches('selector'), 0.15, 8.0)
  assert [seconds for *_, seconds in asked] == [None]


def test_figure() -> None:
  rows = [
    {
      'obstacle': track,
      'size': size,
      'planner': name,
      'reached': reached,
      'of': 4,
    }
    for track in ('gap', 'block')
    for name, both in (('guided', (4, 3)), ('selector', (4, 1)))
    for size, reached in zip((0.3, 0.5), both, strict=True)
  ]
  drawn = sizes.draw(rows)
  for axis, paper in zip(drawn.axes, (0.45, 0.4), strict=True):
    guided, selector, line = axis.lines
    np.testing.assert_allclose(guided.get_ydata(), [1.0, 0.75])
    np.testing.assert_allclose(selector.get_ydata(), [1.0, 0.25])
    np.testing.assert_allclose(line.get_xdata(), paper)
    legend = [text.get_text() for text in axis.get_legend().get_texts()]
    assert legend == ['guided', 'selector', f"the paper's, {paper} m"]
    assert axis.get_xlabel().endswith('(m)')


def test_report(benchmark: processes.Binary, tmp_path: pathlib.Path) -> None:
  out, figure = tmp_path / 'sizes.json', tmp_path / 'sizes.png'
  done = benchmark(
    '--planners=selector',
    '--seeds=1',
    '--gaps=0.8,0.3',
    '--blocks=0.3',
    f'--figure={figure}',
    f'--out={out}',
  )
  assert done.code == 0, done.stderr
  table = json.loads(out.read_text())['table']
  found = [(row['obstacle'], row['size'], row['reached']) for row in table]
  assert found == [('gap', 0.3, 1), ('gap', 0.8, 0), ('block', 0.3, 1)]
  assert figure.read_bytes().startswith(b'\x89PNG')
  lines = done.stdout.splitlines()[-4:-1]
  assert [line.split()[:5] for line in lines] == [
    [name, f'{size:.2f}', 'selector', str(reached), '1']
    for name, size, reached in found
  ]


def test_bad_input(benchmark: processes.Binary) -> None:
  for argument, message in (
    ('--planners=luck', "'luck' is not one of guided, beam, selector"),
    ('--blocks=high', '--blocks are metres'),
    ('--seconds=0', 'seconds'),
    ('--policy=quickstart', 'no selector beside it'),
  ):
    done = benchmark(argument)
    assert done.code == 2, done.stderr
    assert message in done.error
