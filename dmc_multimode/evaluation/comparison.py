"""Tables of two evaluations side by side: both values and their difference.

A difference is the first policy's value minus the second's. Tables begin with
what is worst for the first, where one end of a metric is the better one.
"""

import functools
from typing import Any, Callable, Mapping, NamedTuple

import numpy as np

from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.evaluation import report

_NOTABLE = 0.005  # Smaller differences of scores have no colour.
_LONG = 24  # Rows: longer tables are folded away.
_TINY = 1e-6  # Against ratios to nothing.
_SCORES = ('mra', 'survival', 'mean')  # Metrics of which more is better.

Scores = Mapping[str, Mapping[str, Any]]  # By row and metric.
Order = Callable[[Mapping[str, Any], Mapping[str, Any]], float]


class Cell(NamedTuple):
  """A cell of a table: its text, and the class of its style, '' for none."""

  text: str
  mark: str = ''


_VERDICTS = {True: Cell('yes'), False: Cell('NO', 'failed'), None: Cell('')}


class Row(NamedTuple):
  """A row of a table, with its name first."""

  name: str
  cells: tuple[Cell, ...]


class Table(NamedTuple):
  """A table of both policies."""

  title: str
  text: str
  columns: tuple[str, ...]
  rows: tuple[Row, ...]

  @property
  def is_long(self) -> bool:
    """True for a table that is to be folded away."""
    return len(self.rows) > _LONG


def distinct(
  one: report.Evaluated, other: report.Evaluated
) -> tuple[report.Evaluated, report.Evaluated]:
  """Returns both, with names that differ."""
  if one.name != other.name:
    return one, other
  return one._replace(name=f'{one.name} (1)'), other._replace(
    name=f'{other.name} (2)'
  )


def tables(one: report.Evaluated, other: report.Evaluated) -> list[Table]:
  """Returns the tables of all that either evaluation has measured."""
  make = functools.partial(_table, one, other)
  scores = {'mra': 'MRA', 'survival': 'survival'}
  found = [
    make('Means', 'Over all that each policy has.', _means, {'mean': ''}),
    make(
      'Modes',
      'Scores of each mode by itself.',
      lambda values: values['modes'],
      scores,
      _by_difference('mra'),
    ),
    _acceptance(one, other),
    make(
      'Transitions',
      'Scores over the phases and clips of Algorithm 1.',
      lambda values: values['transitions'],
      scores,
      _by_difference('mra'),
    ),
    make('Gaits', 'Speeds, heights and contacts of the modes.', _gaits),
    make(
      'Motion',
      'How the modes move: less is quieter. The largest ratio comes first.',
      _motion,
      order=_by_ratio,
    ),
    make(
      'Switching',
      'Survival of commands at random.',
      _switching,
      {'survival': 'survival'},
      _by_difference('survival'),
    ),
    make(
      'Clock rates',
      'Modes at other rates of the clock.',
      _clock_rates,
      {**scores, 'velocity': 'speed (m/s)'},
      _by_difference('mra'),
    ),
  ]
  return [table for table in found if table.rows]


def _table(
  one: report.Evaluated,
  other: report.Evaluated,
  title: str,
  text: str,
  read: Callable[[Mapping[str, Any]], Scores],
  metrics: Mapping[str, str] = {'value': ''},
  order: Order | None = None,
) -> Table:
  """Returns a table with three columns for each metric.

  Args:
    one, other: the policies.
    title, text: of the table.
    read: finds the rows in the values of an evaluation.
    metrics: titles of the metrics by their names in the rows.
    order: key of a row, the least of which comes first; rows that one policy
      alone has come last.
  """
  mine, yours = read(one.values), read(other.values)
  names = list(dict.fromkeys([*mine, *yours]))
  if order:
    is_alone = lambda name: name not in mine or name not in yours
    names.sort(
      key=lambda name: (
        (True, 0.0)
        if is_alone(name)
        else (False, order(mine[name], yours[name]))
      )
    )
  columns = [title.lower().rstrip('s')]
  for metric in metrics.values():
    columns += [f'{metric} {one.name}', f'{metric} {other.name}', 'difference']
  rows = []
  for name in names:
    cells: list[Cell] = []
    for metric in metrics:
      first, second = (part.get(name, {}).get(metric) for part in (mine, yours))
      cells += _cells(first, second, is_score=metric in _SCORES)
    rows.append(Row(name, tuple(cells)))
  return Table(title, text, tuple(map(str.strip, columns)), tuple(rows))


def _cells(
  mine: float | None, yours: float | None, is_score: bool
) -> list[Cell]:
  """Returns both values and their difference, coloured if more is better."""
  shown = [Cell(report.number(mine)), Cell(report.number(yours))]
  if mine is None or yours is None:
    return [*shown, Cell('')]
  difference, mark = mine - yours, ''
  if is_score and abs(difference) >= _NOTABLE:
    mark = 'better' if difference > 0 else 'failed'
  return [*shown, Cell(f'{difference:+.3f}', mark)]


def _by_difference(metric: str) -> Order:
  """Returns the order by the difference of a metric, the least first."""
  return lambda mine, yours: float(mine[metric] - yours[metric])


def _by_ratio(mine: Mapping[str, Any], yours: Mapping[str, Any]) -> float:
  """Returns minus the ratio of the values of a row; 0 without both."""
  one, other = mine['value'], yours['value']
  if one is None or other is None:
    return 0.0
  return -(abs(one) + _TINY) / (abs(other) + _TINY)


def _means(values: Mapping[str, Any]) -> Scores:
  """Returns the means of an evaluation."""
  passed = [
    row['passed']
    for rows in values['acceptance'].values()
    for row in rows.values()
  ]
  return {
    'MRA of modes': {'mean': values['mra_modes']['mean']},
    'MRA of transitions': {'mean': values['mra_transitions']['mean']},
    'survival of modes': {'mean': values['survival_modes']},
    'survival of transitions': {'mean': values['survival_transitions']},
    'acceptance criteria passed': {
      'mean': float(np.mean(passed)) if passed else None
    },
  }


def _gaits(values: Mapping[str, Any]) -> Scores:
  """Returns the gait metrics, a row each."""
  return {
    f'{mode}: {report.column_title(name)}': {'value': row[name]}
    for mode, row in values['modes'].items()
    for name in report.MODE_COLUMNS
    if name not in _SCORES
  }


def _motion(values: Mapping[str, Any]) -> Scores:
  """Returns the motion metrics, a row each."""
  return {
    f'{mode}: {metric.name.replace("_", " ")}'
    + (f' ({metric.unit})' if metric.unit else ''): {'value': row[metric.name]}
    for mode, row in values.get('motion', {}).items()
    for metric in motion_metrics.TABLE
    if metric.name in row
  }


def _switching(values: Mapping[str, Any]) -> Scores:
  """Returns the survival of random switches."""
  found = values.get('switching', {})
  return {
    text: found[kind]
    for kind, text in (
      ('any_moment', 'at any moment'),
      ('from_ground', 'from the ground'),
    )
    if kind in found
  }


def _clock_rates(values: Mapping[str, Any]) -> Scores:
  """Returns the scores at other clock rates, a row for each and mode."""
  return {
    f'{mode} at {rate}': row
    for rate, rows in values.get('clock_rates', {}).items()
    for mode, row in rows.items()
  }


def _acceptance(one: report.Evaluated, other: report.Evaluated) -> Table:
  """Returns the criteria: first those that the first policy alone fails."""
  mine, yours = _criteria(one.values), _criteria(other.values)
  passed = lambda rows, name: rows.get(name, {}).get('passed')
  names = sorted(
    dict.fromkeys([*mine, *yours]),
    key=lambda name: (passed(mine, name) is not False, not passed(yours, name)),
  )
  rows = []
  for name in names:
    criterion = mine.get(name) or yours[name]
    bounds = ' to '.join(
      report.number(criterion[end]) or 'any' for end in ('least', 'most')
    )
    verdicts = [_VERDICTS[passed(part, name)] for part in (mine, yours)]
    first, second = (part.get(name, {}).get('value') for part in (mine, yours))
    cells = (*_cells(first, second, False), Cell(bounds), *verdicts)
    rows.append(Row(name, cells))
  columns = (
    *('criterion', one.name, other.name, 'difference', 'bounds'),
    *(f'{one.name} passes', f'{other.name} passes'),
  )
  text = "Bounds of the mean that a mode's reference asks for."
  return Table('Acceptance criteria', text, columns, tuple(rows))


def _criteria(values: Mapping[str, Any]) -> Scores:
  """Returns the acceptance criteria, a row each."""
  return {
    f'{mode}: {metric}': row
    for mode, rows in values['acceptance'].items()
    for metric, row in rows.items()
  }


def show(one: report.Evaluated, other: report.Evaluated) -> None:
  """Prints the means of both."""
  (table, *_) = tables(*distinct(one, other))
  first, *titles = table.columns
  print(f'\n{first:26} ' + ' '.join(f'{text:>20}' for text in titles))
  for row in table.rows:
    cells = ' '.join(f'{cell.text:>20}' for cell in row.cells)
    print(f'{row.name:26} {cells}')
