"""Tests of what people read: the notebook, links, how to cite."""

import configparser
import json
import os
import pathlib
import re
import subprocess
import sys
from typing import Any

import pytest
import yaml

import dmc_multimode

_ROOT = pathlib.Path(__file__).resolve().parent.parent
_NOTEBOOK = _ROOT / 'docs' / 'tour.ipynb'
_PAGES = sorted(
  [*_ROOT.glob('*.md'), *(_ROOT / 'docs').glob('*.md')],
)
_LINK = re.compile(r'\]\(([^)#\s]+)')

_CHAPTERS = ('Keyframes', 'Latents', 'Training', 'Evaluation', 'Planning')
_MAX_BYTES = 600_000  # Of the notebook, with its outputs.
# What a short run replaces.
_TINY = {
  'STEPS = 800_000': 'STEPS = 4096',
  'EPISODES = 2': 'EPISODES = 1',
  'num_worlds=512': 'num_worlds=32',
}

# Runs the code of a notebook as one program, and tells what it led to.
_RUN = """
import json, sys
import matplotlib
matplotlib.use('agg')
import matplotlib.pyplot as plt
space = {'__name__': '__main__'}
for code in json.loads(sys.argv[1]):
  exec(code, space)
print(json.dumps({
  'policies': [
    space[name].provenance['steps'] for name in ('walker', 'tuned', 'shuffler')
  ],
  'squat': space['tuned'].mode_set.names[-1],
  'mra': space['report']['mra_modes']['mean'],
  'speed': space['speed'],
  'rise': float(space['trace'].support[-1]),
  'success': space['found'].success,
  'axes': [len(plt.figure(i).axes) for i in plt.get_fignums()],
}))
"""


def _notebook() -> dict[str, Any]:
  return json.loads(_NOTEBOOK.read_text())


def _code() -> list[str]:
  cells = _notebook()['cells']
  return [''.join(c['source']) for c in cells if c['cell_type'] == 'code']


@pytest.mark.gl
@pytest.mark.slow
def test_the_notebook_runs(tmp_path: pathlib.Path) -> None:
  code = _code()
  for long, short in _TINY.items():
    assert any(long in cell for cell in code)
    code = [cell.replace(long, short) for cell in code]
  done = subprocess.run(
    [sys.executable, '-c', _RUN, json.dumps(code)],
    cwd=tmp_path,
    env={**os.environ, 'OMP_NUM_THREADS': '1'},
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr
  led_to = json.loads(done.stdout.splitlines()[-1])
  assert min(led_to['policies']) > 0
  assert led_to['squat'] == 'squat'
  assert led_to['mra'] > 0.8 and led_to['success']
  assert 0.2 < led_to['speed'] < 0.4  # A blend: half of a walk's.
  assert led_to['rise'] == pytest.approx(0.4)
  assert led_to['axes'] == [1, 1, 2, 2, 1, 2, 1]
  for film in ('walk/film', 'squat/film', 'plan'):
    assert (tmp_path / 'runs' / f'tour_{film}.mp4').stat().st_size > 1000


def test_the_notebook_teaches_through_the_facade_alone() -> None:
  imported = re.findall(
    r'^(?:import|from) (\w+)(\.?)', '\n'.join(_code()), re.M
  )
  own = {name + dot for name, dot in imported if 'multimode' in name}
  assert own == {'dmc_multimode'}
  text = [
    ''.join(cell['source'])
    for cell in _notebook()['cells']
    if cell['cell_type'] == 'markdown'
  ]
  for number, title in enumerate(_CHAPTERS, 1):
    assert any(cell.startswith(f'## {number}. {title}\n') for cell in text)
  exercises = sum(cell.startswith('**Exercise.**') for cell in text)
  solutions = [c for c in _code() if c.startswith('# @title Solution')]
  assert len(_CHAPTERS) == exercises == len(solutions)


def test_the_notebook_is_small_and_whole() -> None:
  notebook = _notebook()
  assert notebook['nbformat'] == 4
  assert _NOTEBOOK.stat().st_size < _MAX_BYTES
  names = [cell['id'] for cell in notebook['cells']]
  assert len(set(names)) == len(names)
  for cell in notebook['cells']:
    kinds = [o['output_type'] for o in cell.get('outputs', ())]
    assert 'error' not in kinds


@pytest.mark.parametrize('page', _PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page: pathlib.Path) -> None:
  for link in _LINK.findall(page.read_text()):
    if not link.startswith(('http:', 'https:', 'mailto:')):
      assert (page.parent / link).exists(), link


def test_citation() -> None:
  citation = yaml.safe_load((_ROOT / 'CITATION.cff').read_text())
  assert {'cff-version', 'message', 'title', 'authors'} <= citation.keys()
  assert citation['cff-version'] == '1.2.0'
  setup = configparser.ConfigParser(interpolation=None)
  setup.read(_ROOT / 'setup.cfg')
  assert citation['license'] == setup['metadata']['license']
  changes = (_ROOT / 'CHANGELOG.md').read_text()
  newest = re.search(r'^## (\S+) - ', changes, re.M)
  assert newest is not None
  assert citation['version'] == dmc_multimode.__version__ == newest[1]
  (paper,) = citation['references']
  assert [author['family-names'] for author in paper['authors']] == [
    'Krishna',
    'Nguyen',
  ]
  readme = ' '.join((_ROOT / 'README.md').read_text().split())
  assert paper['title'] in readme
