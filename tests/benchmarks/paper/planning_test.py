"""Tests of benchmarks.paper.planning."""

import json
import pathlib

from tests.bin import processes

# More beams than one would make no other report.
_ONE_ATTEMPT = """
binary.beam_search.BeamConfig.escalation = lambda self: [self]
"""


def test_report(benchmark: processes.Binary, tmp_path: pathlib.Path) -> None:
  out = tmp_path / 'planning.json'
  done = benchmark(
    '--policy=quickstart',
    '--planners=beam',
    '--beams=1',
    '--seeds=2',
    '--random=1',
    f'--out={out}',
    before=_ONE_ATTEMPT,
  )
  assert done.code == 0, done.stderr
  report = json.loads(out.read_text())
  plans, table = report['plans'], report['table']
  assert [row['track'] for row in table] == [
    'gap',
    'plateau',
    'gap_block',
    'parkour',
  ]
  assert [row['of'] for row in table] == [2, 2, 2, 1]
  lines = done.stdout.splitlines()[-4:]
  for row, line in zip(table, lines, strict=True):
    mine = [plan for plan in plans if plan['track'] == row['track']]
    assert row['solved'] == sum(plan['success'] for plan in mine)
    assert line.startswith(row['track'])
    assert line.split()[2:4] == [str(row['solved']), str(row['of'])]
    for plan in mine:
      knots = 11 if row['track'] in ('gap', 'plateau') else len(plan['plan'])
      assert len(plan['plan']) == knots
      assert plan['control_steps'] > 0
  # Without launch nobody gets onto a block of 0.4 m.
  assert table[2]['solved'] == 0
  assert 'gap_block 0: not solved' in done.stderr
  starts = [plan['final_position'] for plan in plans[:2]]
  assert starts[0] != starts[1]  # The seeds are two starts.


def test_unknown_planner(benchmark: processes.Binary) -> None:
  done = benchmark('--planners=beam,guess')
  assert done.code == 2, done.stderr
  assert "'guess' is not one of beam, guided, q_learning" in done.error
