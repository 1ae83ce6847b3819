"""An evaluation as one HTML page that needs nothing but itself.

The page is built as a tree, so that whatever names and values hold is escaped.
Figures and videos are in it as data.
"""

import base64
import json
from typing import Any, Mapping, Sequence
from xml.etree import ElementTree

import matplotlib

MODE_COLUMNS = (
  'mra',
  'survival',
  'velocity',
  'lateral_velocity',
  'height',
  'apex',
  'rise',
  'flight',
  'alternation',
  'single_support',
  'agreement',
  'drift',
  'position_error',
)
_UNITS = {
  'velocity': 'm/s',
  'lateral_velocity': 'm/s',
  'height': 'm',
  'apex': 'm',
  'rise': 'm',
  'flight': 's',
  'drift': 'm',
  'position_error': 'm',
}
_COLOURS = 'viridis'  # Told apart in grey as well.
_DARK = 0.5  # Luminance below which white text is read best.
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #161c24; margin: 2rem auto;
  max-width: 75rem; padding: 0 1rem; }
h1, h2 { line-height: 1.2; }
h2 { margin-top: 2.5rem; }
img { max-width: 100%; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .6rem; text-align: right;
  border-bottom: 1px solid #ddd; }
td, tbody th { white-space: nowrap; }
th:first-child, .text td { text-align: left; }
.text td { white-space: normal; overflow-wrap: anywhere; }
.heat td { text-align: center; border: 1px solid #fff; }
.heat thead th { text-align: center; vertical-align: bottom; }
.broken { color: #b3261e; font-weight: 600; }
.videos { display: flex; flex-wrap: wrap; gap: 1rem; }
.videos figure { margin: 0; }
.videos video { display: block; width: 320px; max-width: 100%; }
"""


def make(
  title: str,
  values: Mapping[str, Any],
  figures: Mapping[str, bytes],
  videos: Mapping[str, bytes],
  note: str = '',
) -> str:
  """Returns the page.

  Args:
    title: of the page.
    values: what `scoring.report` returned, with the `provenance` of the policy.
    figures: PNG files by their titles.
    videos: MP4 files by the names of modes.
    note: why there are no videos; empty if there are.
  """
  page = ElementTree.Element('html', lang='en')
  head = _add(page, 'head')
  _add(head, 'meta', charset='utf-8')
  _add(
    head, 'meta', name='viewport', content='width=device-width,initial-scale=1'
  )
  _add(head, 'title', title)
  _add(head, 'style', _STYLE)
  body = _add(page, 'body')
  _add(body, 'h1', title)
  _summarise(body, values)
  _add_videos(body, values['modes'], videos, note)
  _add_modes(body, values['modes'])
  _add_promises(body, values['behaviour'])
  _add_transitions(body, values['modes'], values['transitions'])
  for caption, content in figures.items():
    _add(body, 'h2', caption)
    _add(body, 'img', src=_data('image/png', content), alt=caption)
  _add_provenance(body, values)
  text = ElementTree.tostring(page, encoding='unicode', method='html')
  return f'<!DOCTYPE html>\n{text}\n'


def _add(
  parent: ElementTree.Element, tag: str, text: str = '', **attributes: str
) -> ElementTree.Element:
  """Adds an element and returns it; `class_` is the attribute `class`."""
  names = {key.removesuffix('_'): value for key, value in attributes.items()}
  element = ElementTree.SubElement(parent, tag, names)
  element.text = text or None
  return element


def _data(kind: str, content: bytes) -> str:
  """Returns a file as a URI that holds it."""
  return f'data:{kind};base64,{base64.b64encode(content).decode()}'


def _table(
  parent: ElementTree.Element,
  columns: Sequence[str],
  rows: Sequence[Sequence[str]],
  class_: str = '',
) -> list[list[ElementTree.Element]]:
  """Adds a table, the first cell of each row being its header.

  Returns:
    The cells of each row but its header.
  """
  table = _add(_add(parent, 'div', class_='wide'), 'table', class_=class_)
  head = _add(_add(table, 'thead'), 'tr')
  for name in columns:
    _add(head, 'th', name, scope='col')
  body, cells = _add(table, 'tbody'), []
  for name, *row in rows:
    line = _add(body, 'tr')
    _add(line, 'th', name, scope='row')
    cells.append([_add(line, 'td', text) for text in row])
  return cells


def _summarise(body: ElementTree.Element, values: Mapping[str, Any]) -> None:
  """Adds the figures that sum it all up."""
  promises = [
    row['kept']
    for mode in values['behaviour'].values()
    for row in mode.values()
  ]
  rows = [
    (
      f'{kind} ({len(values[kind])})',
      f'{values[f"mra_{kind}"]["mean"]:.3f}',
      f'{values[f"mra_{kind}"]["std"]:.3f}',
      f'{values[f"survival_{kind}"]:.3f}',
    )
    for kind in ('modes', 'transitions')
  ]
  _table(body, ('mean over', 'MRA', 'standard deviation', 'survival'), rows)
  _add(
    body,
    'p',
    'MRA is the mean normalised return: the share of the highest reward that '
    'an episode earns, and what comes after a fall earns none. Survival is the '
    'share of episodes that reach their time limit. Promises kept: '
    f'{sum(promises)} of {len(promises)}.',
  )


def _add_videos(
  body: ElementTree.Element,
  modes: Mapping[str, Mapping[str, float]],
  videos: Mapping[str, bytes],
  note: str,
) -> None:
  _add(body, 'h2', 'Videos')
  if note:
    _add(body, 'p', f'There are no videos: {note}')
    return
  grid = _add(body, 'div', class_='videos')
  for name, content in videos.items():
    figure = _add(grid, 'figure')
    _add(
      figure,
      'video',
      src=_data('video/mp4', content),
      controls='',
      loop='',
      muted='',
      playsinline='',
      preload='metadata',
    )
    _add(figure, 'figcaption', f'{name}, MRA {modes[name]["mra"]:.3f}')


def _add_modes(
  body: ElementTree.Element, modes: Mapping[str, Mapping[str, float]]
) -> None:
  _add(body, 'h2', 'Modes')
  columns = [
    f'{name.replace("_", " ")} ({_UNITS[name]})'
    if name in _UNITS
    else name.replace('_', ' ')
    for name in MODE_COLUMNS
  ]
  rows = [
    (name, *(f'{row[key]:.3f}' for key in MODE_COLUMNS))
    for name, row in modes.items()
  ]
  _table(body, ('mode', *columns), rows)


def _add_promises(
  body: ElementTree.Element, behaviour: Mapping[str, Mapping[str, Any]]
) -> None:
  _add(body, 'h2', 'Promises')
  _add(
    body,
    'p',
    'What each mode promises by its reference, beyond the reward, and what the '
    'body did: mean and worst of the episodes, and the bounds of the mean.',
  )
  number = lambda value: '' if value is None else f'{value:.3f}'
  rows, kept = [], []
  for mode, promises in behaviour.items():
    for metric, row in promises.items():
      numbers = [
        number(row[key]) for key in ('value', 'worst', 'least', 'most')
      ]
      kept.append(row['kept'])
      rows.append((f'{mode}: {metric}', *numbers, 'yes' if kept[-1] else 'NO'))
  columns = ('promise', 'value', 'worst', 'least', 'most', 'kept')
  cells = _table(body, columns, rows)
  for row, is_kept in zip(cells, kept, strict=True):
    if not is_kept:
      row[-1].set('class', 'broken')


def _add_transitions(
  body: ElementTree.Element,
  modes: Sequence[str] | Mapping[str, Any],
  transitions: Mapping[str, Mapping[str, float]],
) -> None:
  """Adds a heat map of the returns, and the table of all there is."""
  _add(body, 'h2', 'Transitions')
  _add(body, 'p', 'MRA of each transition: from the row to the column.')
  rows = [
    (a, *(f'{transitions[f"{a}->{b}"]["mra"]:.2f}' for b in modes))
    for a in modes
  ]
  cells = _table(body, ('from \\ to', *modes), rows, 'heat')
  for a, row in zip(modes, cells, strict=True):
    for b, cell in zip(modes, row, strict=True):
      found = transitions[f'{a}->{b}']
      paper, ink = _heat(found['mra'])
      cell.set('style', f'background:{paper};color:{ink}')
      cell.set('title', f'{a} to {b}: survival {found["survival"]:.3f}')
  details = _add(body, 'details')
  _add(details, 'summary', f'All {len(transitions)} transitions')
  rows = [
    (name, f'{row["mra"]:.3f}', f'{row["survival"]:.3f}')
    for name, row in transitions.items()
  ]
  _table(details, ('transition', 'MRA', 'survival'), rows)


def _heat(share: float) -> tuple[str, str]:
  """Returns the colours of a value in [0, 1] and of text on it."""
  red, green, blue, _ = matplotlib.colormaps[_COLOURS](share, bytes=True)
  luminance = (0.2126 * red + 0.7152 * green + 0.0722 * blue) / 255
  ink = '#fff' if luminance < _DARK else '#000'
  return f'#{red:02x}{green:02x}{blue:02x}', ink


def _add_provenance(
  body: ElementTree.Element, values: Mapping[str, Any]
) -> None:
  """Adds how this was measured, and on what."""
  _add(body, 'h2', 'Provenance')
  evaluation = ('seed', 'episodes_per_case', 'clock_rate')
  for caption, part in (
    ('Evaluation', {key: values[key] for key in evaluation}),
    ('Policy', values['provenance']),
    ('Task', values['task']),
  ):
    _add(body, 'h3', caption)
    rows = list(_flat(part))
    _table(body, ('what', 'value'), rows, 'text')


def _flat(values: Mapping[str, Any], prefix: str = '') -> list[tuple[str, str]]:
  """Returns nested values as rows of a table."""
  rows = []
  for key, value in values.items():
    if isinstance(value, Mapping):
      rows += _flat(value, f'{prefix}{key}.')
    else:
      text = value if isinstance(value, str) else json.dumps(value)
      rows.append((f'{prefix}{key}', text))
  return rows
