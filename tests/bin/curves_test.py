"""Tests of dmc_multimode.bin.curves and training_figures."""

import pathlib
from typing import Any

import numpy as np
import pytest

from dmc_multimode.evaluation import training_figures
from tests.bin import processes

_COLUMNS = 'steps,mra_modes,mra_transitions,p/walk,p/walk->idle'


def _write(folder: pathlib.Path, *rows: str, columns: str = _COLUMNS) -> None:
  folder.mkdir(parents=True, exist_ok=True)
  text = '\n'.join([columns, *rows]) + '\n'
  (folder / training_figures.METRICS_FILE).write_text(text)


def _lines(axis: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
  return {line.get_label(): line.get_data() for line in axis.lines}


def test_read(tmp_path: pathlib.Path) -> None:
  _write(tmp_path, '0,0.1,0.2,0.5,1', '100,0.3,0.25,0.5,1')
  for path in (tmp_path, tmp_path / training_figures.METRICS_FILE):
    found = training_figures.read(path)
    assert list(found) == _COLUMNS.split(',')
    np.testing.assert_array_equal(found['mra_modes'], [0.1, 0.3])


def test_returns_are_means_over_the_steps_that_all_runs_have() -> None:
  one = {
    'steps': np.array([0.0, 1e6, 2e6]),
    'mra_modes': np.array([0.0, 0.2, 0.4]),
    'mra_transitions': np.array([0.1, 0.1, 0.1]),
  }
  two = {
    'steps': np.array([0.5e6, 1.5e6]),
    'mra_modes': np.array([0.5, 0.5]),
    'mra_transitions': np.array([np.nan, 0.3]),  # Not known yet.
  }
  drawn = training_figures.draw_returns({'both': [one, two], 'alone': [two]})
  modes, transitions = (_lines(axis) for axis in drawn.axes)
  steps, values = modes['both']
  np.testing.assert_allclose(steps[[0, -1]], [0.5, 1.5])
  np.testing.assert_allclose(values[[0, -1]], [0.3, 0.4])
  is_known = steps == 1.5
  np.testing.assert_array_equal(np.isfinite(transitions['both'][1]), is_known)
  np.testing.assert_allclose(transitions['both'][1][is_known], 0.2)
  np.testing.assert_allclose(modes['alone'][1], 0.5)
  # A panel of their own, unless a run is older than they are.
  newer = {**two, 'seconds': np.array([1.0, 3.0])}
  drawn = training_figures.draw_returns({'new': [newer]})
  _, values = _lines(drawn.axes[2])['new']
  assert (
    values[[0, -1]].tolist() == [1.0, 3.0] and drawn.axes[2].get_ylim()[1] > 3
  )
  mixed = training_figures.draw_returns({'new': [newer], 'old': [one]})
  assert len(mixed.axes) == 2


def test_sampling() -> None:
  run = {
    'steps': np.array([1e6, 2e6]),
    'p/walk': np.array([0.25, 0.75]),
    'p/walk->idle': np.array([0.5, 0.6]),
  }
  drawn = training_figures.draw_sampling(run)
  initial, final = (_lines(axis) for axis in drawn.axes)
  assert (list(initial), list(final)) == (['walk'], ['idle'])
  # Running means, of two rows at least.
  np.testing.assert_allclose(initial['walk'], [[1.5], [0.5]])
  np.testing.assert_allclose(final['idle'], [[1.5], [0.55]])
  titles = [axis.get_title() for axis in drawn.axes]
  assert titles == ['initial mode', 'final mode after walk']


def test_blank_panels_say_why() -> None:
  row = {
    'steps': np.array([1e6]),
    'mra_modes': np.array([0.5]),
    'mra_transitions': np.array([0.3]),
    'p/idle': np.array([1.0]),
  }
  long = {name: np.repeat(values, 60) for name, values in row.items()}
  long['steps'] = np.linspace(1e6, 2e6, 60)
  texts = lambda drawn: [[t.get_text() for t in a.texts] for a in drawn.axes]
  for draw in (
    lambda run: training_figures.draw_returns({'run': [run]}),
    training_figures.draw_sampling,
  ):
    assert all('too short a run' in text for (text,) in texts(draw(row)))
    assert not any(texts(draw(long)))
  alone = {k: v for k, v in long.items() if not k.startswith('p/')}
  ((text,),) = texts(training_figures.draw_sampling(alone))
  assert 'a single mode' in text


@pytest.fixture(scope='module')
def binary(tmp_path_factory: pytest.TempPathFactory) -> Any:
  found = processes.Binary('curves', tmp_path_factory.mktemp('output'))
  yield found
  found.close()


def test_command(binary: processes.Binary, tmp_path: pathlib.Path) -> None:
  for name in ('a', 'b', 'c'):
    _write(tmp_path / name, '0,0.1,0.2,0.5,1', '100,0.3,0.25,0.5,1')
  runs = [f'--run=one={tmp_path / "a"}', f'--run=one={tmp_path / "b"}']
  done = binary(*runs, f'--out={tmp_path / "alone"}')
  assert done.code == 0, done.stderr
  names = {path.name for path in (tmp_path / 'alone').iterdir()}
  assert names == {'returns.png', 'sampling.png'}
  two = f'--run=two={tmp_path / "c"}'
  assert binary(*runs, two, f'--out={tmp_path / "both"}').code == 0
  names = {path.name for path in (tmp_path / 'both').iterdir()}
  assert names == {'returns.png', 'one_sampling.png', 'two_sampling.png'}


@pytest.mark.parametrize(
  ('run', 'message'),
  [
    ('={tmp}/good', 'LABEL=FOLDER'),
    ('a={tmp}/absent', 'does not exist'),
    ('a={tmp}/foreign', 'metrics of a run'),
    ('a={tmp}/damaged', 'damaged'),
  ],
)
def test_bad_input(
  binary: processes.Binary, tmp_path: pathlib.Path, run: str, message: str
) -> None:
  _write(tmp_path / 'good', '0,0.1,0.2,0.5,1')
  _write(tmp_path / 'foreign', '1,2', columns='x,y')
  _write(tmp_path / 'damaged', '0,0.1,0.2,0.5,1', '100,0.3')
  run = run.format(tmp=tmp_path)
  done = binary(f'--run={run}', f'--out={tmp_path / "out"}')
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not (tmp_path / 'out').exists()
