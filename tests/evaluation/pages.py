"""Values of an evaluation, and a reader of the pages that show them."""

import html.parser
import itertools
from typing import Any

from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.evaluation import report

NASTY = '<script>"walk" & \'leap\''
MODES = ('idle', NASTY)
_VOID = {'meta', 'img', 'br', 'hr', 'link', 'input'}


class Page(html.parser.HTMLParser):
  """Content of a page: the text of its table rows, and its elements."""

  def __init__(self, text: str):
    super().__init__()
    self.elements: list[tuple[str, dict[str, str]]] = []
    self.rows: list[list[str]] = []
    self.text = ''
    self._open: list[str] = []
    self.feed(text)
    self.close()
    assert not self._open  # Whatever begins, ends.

  def handle_starttag(
    self, tag: str, attrs: list[tuple[str, str | None]]
  ) -> None:
    self.elements.append((tag, {key: value or '' for key, value in attrs}))
    if tag == 'tr':
      self.rows.append([])
    if tag in ('td', 'th'):
      self.rows[-1].append('')
    if tag not in _VOID:
      self._open.append(tag)

  def handle_endtag(self, tag: str) -> None:
    assert self._open.pop() == tag

  def handle_data(self, data: str) -> None:
    self.text += data
    if self._open and self._open[-1] in ('td', 'th'):
      self.rows[-1][-1] += data

  def all(self, tag: str) -> list[dict[str, str]]:
    """Returns the attributes of all elements of a kind."""
    return [attributes for name, attributes in self.elements if name == tag]


def values() -> dict[str, Any]:
  """A report as `scores.evaluate` makes them."""
  row = dict.fromkeys(report.MODE_COLUMNS, 0.25)
  pairs = itertools.product(MODES, MODES)
  criterion = {'value': 0.58, 'worst': 0.4, 'least': 0.5, 'most': None}
  return {
    'mra_modes': {'mean': 0.912, 'std': 0.01},
    'mra_transitions': {'mean': 0.834, 'std': 0.02},
    'survival_modes': 1.0,
    'survival_transitions': 0.75,
    'modes': {name: {**row, 'mra': 0.5 + i} for i, name in enumerate(MODES)},
    'acceptance': {
      'idle': {'drift': {**criterion, 'passed': True}},
      NASTY: {'speed': {**criterion, 'passed': False}},
    },
    'transitions': {
      f'{a}->{b}': {'mra': 0.1 + 0.2 * i, 'survival': 0.125 * i}
      for i, (a, b) in enumerate(pairs)
    },
    'motion': {
      name: dict.fromkeys([m.name for m in motion_metrics.TABLE], 0.5 + i)
      for i, name in enumerate(MODES)
    },
    'switching': {
      'seconds': 20.0,
      'episodes': 256,
      'any_moment': {'survival': 0.875, 'falls': {'idle': 31, NASTY: 1}},
      'from_ground': {'survival': 1.0, 'falls': {}},
    },
    'clock_rates': {
      '3': {
        NASTY: {
          'velocity': 1.25,
          'reference': 1.5,
          'mra': 0.625,
          'survival': 0.75,
        }
      }
    },
    'seed': 1234,
    'episodes_per_case': 4,
    'clock_rate': 1.5,
    'task': {'gains': {'position': 0.35}, 'time_limit': 4.5},
    'provenance': {'steps': 987, 'commit': '<none>'},
  }


def check_self_contained(text: str) -> None:
  """Checks that a page has all that it shows in itself."""
  page = Page(text)
  assert 'http:' not in text and 'https:' not in text and '@import' not in text
  for tag, attributes in page.elements:
    assert tag not in ('script', 'link', 'iframe')
    for name in ('src', 'href', 'srcset', 'poster', 'data'):
      assert attributes.get(name, 'data:').startswith('data:')
