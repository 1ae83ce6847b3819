"""Tests of dmc_multimode.evaluation.report: the page and what is in it."""

import base64
import io
import itertools
import pathlib
from typing import Mapping

import av
import jinja2
import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import report
from dmc_multimode.evaluation import task_summary
from dmc_multimode.suite.imitation import config as task_config
from tests.bin import untrained
from tests.evaluation import pages


def _page(
  figures_: Mapping[str, bytes] = {}, videos: Mapping[str, bytes] = {}
) -> str:
  section = task_summary.Section(
    'Limits & <more>',
    ('It ends < here.', 'Or there.'),
    ('term', 'unit'),
    (('height & more', 'm'),),
  )
  return report.page(
    report.Evaluated('<pi2>', pages.values(), figures_, videos, [section])
  )


def test_every_mode_criterion_and_transition_is_there() -> None:
  page = pages.Page(_page())
  rows = {row[0]: row[1:] for row in page.rows}
  assert ['idle', '0.500', *['0.250'] * 12] in page.rows
  assert [pages.NASTY, '1.500', *['0.250'] * 12] in page.rows
  assert rows['idle: drift'] == ['0.580', '0.400', '0.500', '', 'yes']
  assert rows[f'{pages.NASTY}: speed'][-1] == 'NO'
  for i, (a, b) in enumerate(itertools.product(pages.MODES, pages.MODES)):
    expected = [f'{0.1 + 0.2 * i:.3f}', f'{0.125 * i:.3f}']
    assert rows[f'{a}->{b}'] == expected
  assert rows['touch down speed (m/s)'] == ['0.500', '1.500']
  assert rows['at any moment'] == ['0.875', f'idle 31, {pages.NASTY} 1']
  assert rows['from the ground'] == ['1.000', '']
  assert [pages.NASTY, '3', '1.250', '1.500', '0.625', '0.750'] in page.rows
  assert ['idle', '0.10', '0.30'] in page.rows  # Of the heat map.
  assert [pages.NASTY, '0.50', '0.70'] in page.rows
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


def test_the_task_is_in_words_and_the_raw_configuration_folded() -> None:
  text = _page()
  page = pages.Page(text)
  assert 'Limits & <more>' in page.text and 'It ends < here.' in page.text
  assert ['height & more', 'm'] in page.rows
  begin = text.rindex('<details><summary>Raw configuration')
  assert text.index('<h2>Task</h2>') < text.index('Limits &amp;') < begin
  assert text.rindex('gains.position') > begin > text.rindex('<h2>')
  assert text.index('</details>', begin) > text.rindex('time_limit')


def test_pictures_and_videos_are_in_the_page() -> None:
  png, mp4 = b'\x89PNG...', b'....ftyp'
  text = _page({'Heights': png}, {'idle': mp4, pages.NASTY: mp4})
  pages.check_self_contained(text)
  page = pages.Page(text)
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
  found = report.Evaluated('Report', pages.values(), report.pictures(drawn))
  report.write_page(path, found, 'no <OpenGL> here')
  assert list(path.parent.iterdir()) == [path]
  text = path.read_text()
  pages.check_self_contained(text)
  page = pages.Page(text)
  assert 'There are no videos: no <OpenGL> here' in page.text
  assert not page.all('video')
  assert len({image['alt'] for image in page.all('img')}) == 2
  for image in page.all('img'):
    content = base64.b64decode(image['src'].partition(',')[2])
    assert content.startswith(b'\x89PNG')
  broken = pages.values()
  del broken['modes']
  with pytest.raises((KeyError, jinja2.UndefinedError)):
    report.write_page(path, report.Evaluated('Report', broken))
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
