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

# Runs the code of a notebook as one program, and tells what it led to.
_RUN = """
import json, sys
import matplotlib
matplotlib.use('agg')
import matplotlib.pyplot as plt
space = {'__name__': '__main__'}
for cell in json.load(open(sys.argv[1]))['cells']:
  if cell['cell_type'] == 'code':
    exec(''.join(cell['source']), space)
frames, found = space['frames'], space['found']
shown = [len(plt.figure(i).axes) for i in plt.get_fignums()]
print(json.dumps({
  'rewards': space['rewards'],
  'returns': space['episodes'].returns.tolist(),
  'shape': frames[0].shape,
  'spread': [float(frame.std()) for frame in frames],
  'success': found.success,
  'axes': shown,
}))
"""


def _notebook() -> dict[str, Any]:
  return json.loads(_NOTEBOOK.read_text())


@pytest.mark.gl
def test_the_notebook_runs() -> None:
  done = subprocess.run(
    [sys.executable, '-c', _RUN, str(_NOTEBOOK)],
    cwd=_ROOT,
    env={**os.environ, 'OMP_NUM_THREADS': '1'},
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr
  led_to = json.loads(done.stdout.splitlines()[-1])
  assert led_to['rewards'][0] > led_to['rewards'][-1]
  assert len(led_to['returns']) == 8 and min(led_to['returns']) > 0.5
  assert led_to['shape'] == [180, 240, 3] and min(led_to['spread']) > 10
  assert led_to['success']
  assert led_to['axes'] == [1, 4, 1]  # Heights, frames, the way.


def test_the_notebook_has_no_outputs() -> None:
  notebook = _notebook()
  assert notebook['nbformat'] == 4
  code = [c for c in notebook['cells'] if c['cell_type'] == 'code']
  assert code
  assert all(not cell['outputs'] for cell in code)
  assert all(cell['execution_count'] is None for cell in code)
  names = [cell['id'] for cell in notebook['cells']]
  assert len(set(names)) == len(names)


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
  assert citation['version'] == dmc_multimode.__version__
  (paper,) = citation['references']
  assert [author['family-names'] for author in paper['authors']] == [
    'Krishna',
    'Nguyen',
  ]
  readme = ' '.join((_ROOT / 'README.md').read_text().split())
  assert paper['title'] in readme
