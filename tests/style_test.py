"""Tests of the style of docstrings, as `benchmarks.release.style` counts it."""

import pathlib

import pytest

from benchmarks.release import style

_ROOT = pathlib.Path(__file__).parents[1]


@pytest.mark.parametrize('folder', ['dmc_multimode', 'benchmarks', 'tests'])
def test_docstrings_begin_with_a_verb_or_a_noun(folder: str) -> None:
  """None begins with What, How, Where, Whether, Is, Has, Lets, Who or Why."""
  assert style.count(_ROOT / folder).odd == []


def test_odd_first_words_are_found(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'odd.py'
  path.write_text('"""Fine."""\n\n\ndef odd():\n  """What is odd."""\n')
  assert style.count(tmp_path).odd == [f'{path}:4: What is odd.']
