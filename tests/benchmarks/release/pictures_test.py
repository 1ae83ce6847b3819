"""Tests of benchmarks.release.pictures: what is shown is what is rendered."""

import importlib.util
import pathlib
import re

import PIL.Image
import PIL.ImageSequence
import pytest

from dmc_multimode import pretrained
from tests.benchmarks import modules
from tests.bin import processes

pictures = modules.load('release.pictures')

_DOCS = pathlib.Path(__file__).resolve().parents[3] / 'docs'
_BY_HAND = {'view.png'}  # Of VIEW.md: a browser takes it.
_MOST_BYTES = 2_000_000  # Of all films.


def test_every_picture_is_rendered_by_the_script() -> None:
  there = {
    p.name for kind in ('png', 'gif', 'mp4') for p in _DOCS.glob(f'*.{kind}')
  }
  assert there == set(pictures.PICTURES) | _BY_HAND


def test_every_picture_is_shown_with_a_caption() -> None:
  pages = [p for p in _DOCS.glob('*.md') if p.name != 'VIEW.md']
  pages.append(_DOCS.parent / 'README.md')
  text = '\n\n'.join(page.read_text() for page in pages)
  for name in pictures.PICTURES:
    assert re.search(rf'\((docs/)?{name}\)', text), name
  for line in re.findall(r'^!\[[^\]]+\]\([^)]+\)\n(.*)', text, re.M):
    assert line.startswith('*'), f'no caption under a picture: {line!r}'


def test_commands_name_what_there_is() -> None:
  shipped = pathlib.Path(pretrained.__file__).parent
  for name, (_, words) in pictures._COMMANDS.items():
    module, *flags = words.split()
    assert importlib.util.find_spec(module), name
    found = re.findall(r'--(?:policy|before|after)=(\S+)', words)
    found += re.findall(r'{shipped}/(\w+)/training.csv', words)
    for policy in found:
      assert (shipped / policy / 'training.csv').is_file(), (name, policy)
    assert found or module.endswith('train_encoder'), name
    assert all(flag.startswith('--') for flag in flags), name


def test_films_are_small() -> None:
  films = [*_DOCS.glob('*.gif'), *_DOCS.glob('*.mp4')]
  assert films
  assert sum(film.stat().st_size for film in films) < _MOST_BYTES


def test_thinned_films_last_as_long(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'film.gif'
  shades = [PIL.Image.new('RGB', (8, 8), (50 * i, 0, 0)) for i in range(5)]
  times = [80, 90, 80, 90, 80]
  shades[0].save(path, save_all=True, append_images=shades[1:], duration=times)
  pictures.thin(path)
  with PIL.Image.open(path) as film:
    kept = [
      (f.convert('RGB').getpixel((0, 0)), f.info['duration'])
      for f in PIL.ImageSequence.Iterator(film)
    ]
  assert kept == [((0, 0, 0), 170), ((100, 0, 0), 170), ((200, 0, 0), 80)]


def test_unknown_pictures_are_refused(benchmark: processes.Binary) -> None:
  done = benchmark('--only=moon.png')
  assert done.code == 2
  assert '--only=moon.png: pictures are pi2.gif' in done.error


@pytest.mark.slow
@pytest.mark.gl
def test_a_plan_is_drawn(tmp_path: pathlib.Path) -> None:
  pictures.PICTURES['plan.png'](tmp_path / 'plan.png')
  assert (tmp_path / 'plan.png').read_bytes().startswith(b'\x89PNG')
