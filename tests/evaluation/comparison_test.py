"""Tests of dmc_multimode.evaluation.comparison, and of its page."""

import copy
import pathlib
import re
from typing import Any

import pytest

from dmc_multimode.evaluation import comparison
from dmc_multimode.evaluation import comparison_page
from dmc_multimode.evaluation import report
from tests.evaluation import pages

_WALK = pages.NASTY


def _both() -> tuple[report.Evaluated, report.Evaluated]:
  """Two policies: the second has a better idle, a worse walk, and a hop."""
  mine = pages.values()
  yours: dict[str, Any] = copy.deepcopy(mine)
  yours['modes']['idle']['mra'] = 0.75
  yours['modes'][_WALK]['mra'] = 1.25
  yours['modes']['hop'] = dict(yours['modes']['idle'])
  yours['acceptance'][_WALK]['speed']['passed'] = True
  yours['acceptance']['hop'] = {
    'rise': {'value': 0.1, 'worst': 0.0, 'least': 0.2, 'most': None}
  }
  yours['acceptance']['hop']['rise']['passed'] = False
  yours['transitions'][f'idle->{_WALK}']['mra'] = 0.9
  yours['motion']['idle']['slip'] = 0.125
  yours['motion'][_WALK]['slip'] = None
  yours['task']['time_limit'] = 3.0
  del yours['switching']
  return report.Evaluated('one', mine), report.Evaluated('other', yours)


def _tables() -> dict[str, comparison.Table]:
  return {table.title: table for table in comparison.tables(*_both())}


def _texts(table: comparison.Table) -> list[list[str]]:
  return [[row.name, *(cell.text for cell in row.cells)] for row in table.rows]


def test_both_values_and_their_difference_worst_first() -> None:
  modes = _tables()['Modes']
  assert modes.columns == (
    *('mode', 'MRA one', 'MRA other', 'difference'),
    *('survival one', 'survival other', 'difference'),
  )
  assert _texts(modes) == [
    ['idle', '0.500', '0.750', '-0.250', '0.250', '0.250', '+0.000'],
    [_WALK, '1.500', '1.250', '+0.250', '0.250', '0.250', '+0.000'],
    ['hop', '', '0.750', '', '', '0.250', ''],
  ]
  marks = [[cell.mark for cell in row.cells] for row in modes.rows]
  assert marks[0] == ['', '', 'failed', '', '', '']
  assert marks[1] == ['', '', 'better', '', '', '']


def test_transitions_are_sorted_and_all_there() -> None:
  rows = _texts(_tables()['Transitions'])
  assert len(rows) == 4
  assert rows[0][:4] == [f'idle->{_WALK}', '0.300', '0.900', '-0.600']


def test_means() -> None:
  rows = {row[0]: row[1:] for row in _texts(_tables()['Means'])}
  assert rows['MRA of modes'] == ['0.912', '0.912', '+0.000']
  # One of two, and two of three.
  assert rows['acceptance criteria passed'] == ['0.500', '0.667', '-0.167']


def test_criteria_that_the_first_alone_fails_come_first() -> None:
  table = _tables()['Acceptance criteria']
  rows = _texts(table)
  assert [row[0] for row in rows] == [
    f'{_WALK}: speed',
    'idle: drift',
    'hop: rise',
  ]
  assert rows[0][4:] == ['0.500 to any', 'NO', 'yes']
  assert rows[2][1:] == ['', '0.100', '', '0.200 to any', '', 'NO']
  assert table.rows[0].cells[-2].mark == 'failed'


def test_motion_is_sorted_by_the_ratio() -> None:
  table = _tables()['Motion']
  first, *_, last = _texts(table)
  assert first == ['idle: slip (m/s)', '0.500', '0.125', '+0.375']
  missing = [row for row in _texts(table) if row[0] == f'{_WALK}: slip (m/s)']
  assert missing == [[f'{_WALK}: slip (m/s)', '1.500', '', '']]
  assert table.is_long and not _tables()['Modes'].is_long
  assert not any(cell.mark for row in table.rows for cell in row.cells)


def test_what_one_has_alone_is_shown() -> None:
  rows = {row[0]: row[1:] for row in _texts(_tables()['Switching'])}
  assert rows['at any moment'] == ['0.875', '', '']
  (row,) = _texts(_tables()['Clock rates'])
  assert row[0] == f'{_WALK} at 3' and row[-3:] == ['1.250', '1.250', '+0.000']
  gaits = _texts(_tables()['Gaits'])
  assert ['hop: velocity (m/s)', '', '0.250', ''] in gaits


def test_a_policy_beside_itself() -> None:
  one, _ = _both()
  first, second = comparison.distinct(one, one)
  assert (first.name, second.name) == ('one (1)', 'one (2)')
  rows = _texts(comparison.tables(first, second)[1])
  assert {row[3] for row in rows} == {'+0.000'}


def test_page(tmp_path: pathlib.Path) -> None:
  one, other = _both()
  mp4, png = b'....ftyp', b'\x89PNG...'
  one = one._replace(images={'Heights': png}, videos={'idle': mp4, _WALK: mp4})
  other = other._replace(images={'Heights': png}, videos={'idle': mp4})
  path = tmp_path / 'new' / 'page.html'
  comparison_page.write_page(path, one, other, '')
  text = path.read_text()
  pages.check_self_contained(text)
  page = pages.Page(text)
  assert 'Evaluation of one beside other' in page.text
  assert 'other alone has hop.' in page.text
  assert 'one alone has' not in page.text
  assert ['idle', '0.500', '0.750', '-0.250', '0.250', '0.250', '+0.000'] in (
    page.rows
  )
  assert len(page.all('video')) == 3
  assert [image['alt'] for image in page.all('img')] == [
    'Heights, one',
    'Heights, other',
  ]
  cells = [cell for cell in page.all('td') if 'style' in cell]
  assert len(cells) == 4  # The transitions that both have.
  red = re.match(r'background:#(..)(..)(..)', cells[1]['style'])
  assert red and int(red[1], 16) > int(red[3], 16)
  assert ['idle', '0.10 +0.00', '0.30 -0.60'] in page.rows
  assert ['task: time_limit', '4.5', '3.0'] in page.rows
  assert text.count('<details>') >= 5


def test_a_page_without_videos_says_why() -> None:
  page = pages.Page(comparison_page.page(*_both(), 'no <OpenGL>'))
  assert 'There are no videos: no <OpenGL>' in page.text


def test_modes_without_anything_in_common() -> None:
  one, other = _both()
  values = dict(other.values)
  values['modes'] = {'hop': values['modes']['hop']}
  values['transitions'] = {'hop->hop': {'mra': 0.5, 'survival': 1.0}}
  text = comparison_page.page(one, other._replace(values=values))
  assert 'Differences of the transitions' not in text


def test_means_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
  comparison.show(*_both())
  lines = capsys.readouterr().out.splitlines()
  assert lines[1].split() == ['mean', 'one', 'other', 'difference']
  assert lines[2].split() == ['MRA', 'of', 'modes', '0.912', '0.912', '+0.000']
