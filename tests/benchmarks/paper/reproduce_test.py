"""Tests of benchmarks.paper.reproduce."""

import pathlib

import pytest

from dmc_multimode import pretrained
from tests.benchmarks import modules

reproduce = modules.load('paper.reproduce')


def test_every_shipped_policy_is_evaluated() -> None:
  parts = {part.name: part for part in reproduce.parts(2)}
  assert set(pretrained.names('mini_biped')) <= set(parts)
  assert parts['pi2'].needs == {'pi2'}
  assert '--episodes=2' in parts['pi2'].words.split()
  assert parts['planning'].needs == {'pi2'}
  assert parts['switching'].needs == {
    'pi2_paper',
    'unimodal_walk',
    'unimodal_launch',
  }
  assert parts['curves_pi2_paper'].needs == {'pi2_paper', 'pi2_uniform'}
  assert parts['curves_pi1_paper'].needs == {'pi1_paper', 'pi1_uniform'}
  assert set(reproduce.PAPER) <= set(pretrained.names())


def test_runs_leave_a_log(tmp_path: pathlib.Path) -> None:
  good = reproduce.Part('good', 'json.tool {out}/some.json')
  (tmp_path / 'some.json').write_text('[1]')
  assert reproduce.run(good, tmp_path) > 0
  assert (tmp_path / 'good.log').read_text().split() == ['[', '1', ']']
  with pytest.raises(ChildProcessError, match='bad failed: see .*bad.log'):
    reproduce.run(reproduce.Part('bad', 'no.such.module'), tmp_path)
  assert 'No module' in (tmp_path / 'bad.log').read_text()


def test_table_two_has_both_sides() -> None:
  report = {
    'mra_modes': {'mean': 0.9184, 'std': 0.02},
    'mra_transitions': {'mean': 0.902, 'std': 0.039},
  }
  lines = reproduce.table_two({'pi2': report})
  mine = next(line for line in lines if line.startswith('pi2 '))
  assert mine.split() == (
    'pi2 0.91 +- 0.05 0.918 +- 0.020 0.79 +- 0.24 0.902 +- 0.039'.split()
  )
  absent = len(reproduce.PAPER) - 1
  assert sum('(not shipped)' in line for line in lines) == absent
