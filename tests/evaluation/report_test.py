"""Tests of dmc_multimode.evaluation.report: the page and what is in it."""

import base64
import html.parser
import io
import itertools
import pathlib
from typing import Any, Mapping

import av
import jinja2
import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.evaluation import report
from dmc_multimode.suite.imitation import config as task_config
from tests.bin import untrained

_NASTY = '<script>"walk" & \'leap\''
_MODES = ('idle', _NASTY)
_VOID = {'meta', 'img', 'br', 'hr', 'link', 'input'}


class _Page(html.parser.HTMLParser):
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
    return [attributes for name, attributes in self.elements if name == tag]


def _values() -> dict[str, Any]:
  """A report as `scores.evaluate` makes them."""
  row = dict.fromkeys(report.MODE_COLUMNS, 0.25)
  pairs = itertools.product(_MODES, _MODES)
  criterion = {'value': 0.58, 'worst': 0.4, 'least': 0.5, 'most': None}
  return {
    'mra_modes': {'mean': 0.912, 'std': 0.01},
    'mra_transitions': {'mean': 0.834, 'std': 0.02},
    'survival_modes': 1.0,
    'survival_transitions': 0.75,
    'modes': {name: {**row, 'mra': 0.5 + i} for i, name in enumerate(_MODES)},
    'acceptance': {
      'idle': {'drift': {**criterion, 'passed': True}},
      _NASTY: {'speed': {**criterion, 'passed': False}},
    },
    'transitions': {
      f'{a}->{b}': {'mra': 0.1 + 0.2 * i, 'survival': 0.125 * i}
      for i, (a, b) in enumerate(pairs)
    },
    'motion': {
      name: dict.fromkeys([m.name for m in motion_metrics.TABLE], 0.5 + i)
      for i, name in enumerate(_MODES)
    },
    'switching': {
      'seconds': 20.0,
      'episodes': 256,
      'any_moment': {'survival': 0.875, 'falls': {'idle': 31, _NASTY: 1}},
      'from_ground': {'survival': 1.0, 'falls': {}},
    },
    'clock_rates': {
      '3': {
        _NASTY: {
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


def _page(
  figures_: Mapping[str, bytes] = {}, videos: Mapping[str, bytes] = {}
) -> str:
  return report.page('Evaluation of <pi2>', _values(), figures_, videos, '')


def _check_self_contained(text: str) -> None:
  page = _Page(text)
  assert 'http:' not in text and 'https:' not in text and '@import' not in text
  for tag, attributes in page.elements:
    assert tag not in ('script', 'link', 'iframe')
    for name in ('src', 'href', 'srcset', 'poster', 'data'):
      assert attributes.get(name, 'data:').startswith('data:')


def test_every_mode_criterion_and_transition_is_there() -> None:
  page = _Page(_page())
  rows = {row[0]: row[1:] for row in page.rows}
  assert ['idle', '0.500', *['0.250'] * 12] in page.rows
  assert [_NASTY, '1.500', *['0.250'] * 12] in page.rows
  assert rows['idle: drift'] == ['0.580', '0.400', '0.500', '', 'yes']
  assert rows[f'{_NASTY}: speed'][-1] == 'NO'
  for i, (a, b) in enumerate(itertools.product(_MODES, _MODES)):
    expected = [f'{0.1 + 0.2 * i:.3f}', f'{0.125 * i:.3f}']
    assert rows[f'{a}->{b}'] == expected
  assert rows['touch down speed (m/s)'] == ['0.500', '1.500']
  assert rows['at any moment'] == ['0.875', f'idle 31, {_NASTY} 1']
  assert rows['from the ground'] == ['1.000', '']
  assert [_NASTY, '3', '1.250', '1.500', '0.625', '0.750'] in page.rows
  assert ['idle', '0.10', '0.30'] in page.rows  # Of the heat map.
  assert [_NASTY, '0.50', '0.70'] in page.rows
  cells = [cell for cell in page.all('td') if 'style' in cell]
  inks = [cell['style'].rpartition(':')[2] for cell in cells]
  assert len(inks) == 4 and (inks[0], inks[-1]) == ('#fff', '#000')
  assert 'passed:\n1 of 2.' in page.text
  assert rows['transitions (4)'] == ['0.834', '0.020', '0.750']
  for key, value in (
    ('seed', '1234'),
    ('clock_rate', '1.5'),
    ('steps', '987'),
    ('commit', '<none>'),
    ('gains.position', '0.35'),
  ):
    assert rows[key] == [value]


def test_pictures_and_videos_are_in_the_page() -> None:
  png, mp4 = b'\x89PNG...', b'....ftyp'
  text = _page({'Heights': png}, {'idle': mp4, _NASTY: mp4})
  _check_self_contained(text)
  page = _Page(text)
  (image,) = page.all('img')
  assert image['alt'] == 'Heights'
  sources = [v['src'] for v in [image, *page.all('video')]]
  kinds = [source.partition(',')[0] for source in sources]
  assert kinds == ['data:image/png;base64', *['data:video/mp4;base64'] * 2]
  contents = [base64.b64decode(source.partition(',')[2]) for source in sources]
  assert contents == [png, mp4, mp4]
  assert 'There are no videos' not in page.text


def test_a_page_without_videos_says_why_and_is_written_whole(
  tmp_path: pathlib.Path,
) -> None:
  path = tmp_path / 'new' / 'report.html'
  drawn = {
    name: figures.empty(1, 1, 2.0, 2.0)[0]
    for name in (figures.HEIGHTS_FILE, figures.CONTACTS_FILE)
  }
  report.write_page(path, 'Report', _values(), drawn, {}, 'no <OpenGL> here')
  assert list(path.parent.iterdir()) == [path]
  text = path.read_text()
  _check_self_contained(text)
  page = _Page(text)
  assert 'There are no videos: no <OpenGL> here' in page.text
  assert not page.all('video')
  assert len({image['alt'] for image in page.all('img')}) == 2
  for image in page.all('img'):
    content = base64.b64decode(image['src'].partition(',')[2])
    assert content.startswith(b'\x89PNG')
  values = _values()
  del values['modes']
  with pytest.raises((KeyError, jinja2.UndefinedError)):
    report.write_page(path, 'Report', values, {}, {}, '')
  assert path.read_text() == text


@pytest.mark.gl
def test_videos_of_the_modes(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  modes = ('idle', 'launch')
  monkeypatch.setattr(report, '_SECONDS', 0.3)
  monkeypatch.setattr(report, '_AFTER', -0.8)
  untrained.save(tmp_path, modes, task_config.ImitationConfig(), {})
  policy = pretrained.load(tmp_path)
  videos = report.film(policy, policy.config, seed=0, clock_rate=1.0)
  assert tuple(videos) == modes
  for content in videos.values():
    assert len(content) < 100_000
    with av.open(io.BytesIO(content), 'r') as container:
      stream = container.streams.video[0]
      assert (stream.codec_context.name, stream.width) == ('h264', 320)
      frames = [f.to_ndarray(format='rgb24') for f in container.decode(stream)]
    assert len(frames) == 10 and np.stack(frames).std() > 10
