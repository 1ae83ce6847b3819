"""Page of two evaluations side by side, with the tables of `comparison`."""

import pathlib
from typing import Iterable, Mapping, Sequence

from dmc_multimode.evaluation import comparison
from dmc_multimode.evaluation import report

_TEMPLATE = 'comparison.html.j2'
_COLOURS = 'RdBu'  # Red is worse. The colour-blind tell both ends apart.
_LEAST_RANGE = 0.05  # Of the heat map's colours: smaller differences stay pale.


def write_page(
  path: pathlib.Path, one: report.Evaluated, other: report.Evaluated, note: str
) -> None:
  """Writes the page, atomically; `note` is the reason for no videos."""
  report.write(path, page(one, other, note))


def page(one: report.Evaluated, other: report.Evaluated, note: str = '') -> str:
  """Returns the page as HTML, in which names and values are escaped."""
  both = comparison.distinct(one, other)
  modes = [list(each.values['modes']) for each in both]
  common = [name for name in modes[0] if name in modes[1]]
  return report.render(
    _TEMPLATE,
    title=f'Evaluation of {both[0].name} beside {both[1].name}',
    names=[each.name for each in both],
    alone=[[name for name in names if name not in common] for names in modes],
    tables=comparison.tables(*both),
    common=common,
    heat_map=_heat_map(common, *both),
    videos=_by_key([(each.name, each.videos) for each in both]),
    figures=_by_key([(each.name, each.images) for each in both]),
    settings=_settings(*both),
    summaries=[each.summary for each in both],
    provenance=[report.provenance(each.values) for each in both],
    note=note,
  )


def _heat_map(
  modes: Sequence[str], one: report.Evaluated, other: report.Evaluated
) -> dict[str, comparison.Cell]:
  """Returns a cell for each transition between modes; its mark is its style."""
  names = [f'{a}->{b}' for a in modes for b in modes]
  mine, yours = (each.values['transitions'] for each in (one, other))
  differences = {n: mine[n]['mra'] - yours[n]['mra'] for n in names}
  most = max([_LEAST_RANGE, *map(abs, differences.values())])
  return {
    name: comparison.Cell(
      f'{mine[name]["mra"]:.2f} {difference:+.2f}',
      report.colour((1 + difference / most) / 2, _COLOURS),
    )
    for name, difference in differences.items()
  }


def _by_key(
  contents: Iterable[tuple[str, Mapping[str, bytes]]],
) -> dict[str, dict[str, bytes]]:
  """Returns the files of several policies, by their keys and by policy."""
  found: dict[str, dict[str, bytes]] = {}
  for name, files in contents:
    for key, content in files.items():
      found.setdefault(key, {})[name] = content
  return found


def _settings(
  one: report.Evaluated, other: report.Evaluated
) -> list[tuple[str, str, str]]:
  """Returns the settings of trainings and evaluations that differ."""
  flat = [
    {
      f'{caption.lower()}: {name}': text
      for caption, rows in report.provenance(each.values).items()
      for name, text in rows
    }
    for each in (one, other)
  ]
  names = dict.fromkeys([*flat[0], *flat[1]])
  pairs = [
    (name, flat[0].get(name, ''), flat[1].get(name, '')) for name in names
  ]
  return [row for row in pairs if row[1] != row[2]]
