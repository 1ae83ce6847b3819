"""Tests of dmc_multimode.agents.loggers."""

import contextlib
import csv
import errno
import io
import math
import pathlib
import sys
import threading
import types
from typing import Any

import pytest
from tensorboard.backend.event_processing import event_accumulator

from dmc_multimode.agents import loggers


def _rows(path: pathlib.Path) -> list[dict[str, str]]:
  with open(path, newline='', encoding='utf-8') as file:
    return list(csv.DictReader(file))


def _write(logger: loggers.Logger, *steps: int, **values: float) -> None:
  for step in steps:
    logger.write({'steps': step, 'a': step / 10, **values})
  logger.close()


def test_csv_columns(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'metrics.csv'
  logger = loggers.CSVLogger(path)
  logger.write({'steps': 12_000_000, 'return/idle': 0.5, 'lr': 1.23456789e-5})
  assert len(_rows(path)) == 1  # Nothing waits for `close`.
  logger.write({'steps': 12_000_160.0, 'lr': 1 / 3, 'new': 1.0})
  logger.close()
  assert path.read_text().splitlines()[0] == 'steps,return/idle,lr'
  assert _rows(path) == [
    {'steps': '12000000', 'return/idle': '0.5', 'lr': '1.23457e-05'},
    {'steps': '12000160', 'return/idle': '', 'lr': '0.333333'},
  ]


def test_csv_of_a_resumed_run(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'metrics.csv'
  _write(loggers.CSVLogger(path), 10, 20, 30)
  _write(loggers.CSVLogger(path, resume_from=20), 25, 35)
  assert [row['steps'] for row in _rows(path)] == ['10', '20', '25', '35']
  assert [row['a'] for row in _rows(path)] == ['1', '2', '2.5', '3.5']
  # Before the first row there may be other columns.
  _write(loggers.CSVLogger(path, resume_from=5), 8, b=1.0)
  assert _rows(path) == [{'steps': '8', 'a': '0.8', 'b': '1'}]
  loggers.CSVLogger(path).close()  # A new run begins anew.
  assert path.read_text() == ''


def test_tensorboard_of_a_resumed_run(tmp_path: pathlib.Path) -> None:
  values = {'b': 7.0, 'not_known_yet': math.nan}
  _write(loggers.TensorBoardLogger(tmp_path), 10, 20, 30, **values)
  _write(loggers.TensorBoardLogger(tmp_path, resume_from=20), 25)
  events = event_accumulator.EventAccumulator(str(tmp_path))
  events.Reload()
  assert set(events.Tags()['scalars']) == {'a', 'b'}
  found = [(event.step, event.value) for event in events.Scalars('a')]
  assert found == [(10, 1.0), (20, 2.0), (25, 2.5)]


@pytest.mark.parametrize('kind', ['csv', 'tensorboard'])
def test_a_full_disk_is_told_once(
  tmp_path: pathlib.Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
  printed: list[Any] = []  # By TensorBoard's thread, besides what is raised.
  monkeypatch.setattr(threading, 'excepthook', printed.append)
  logger: Any
  full = open('/dev/full', 'wb')
  if kind == 'csv':
    logger = loggers.CSVLogger(tmp_path / 'metrics.csv')
    logger._file = io.TextIOWrapper(full)
  else:
    logger = loggers.TensorBoardLogger(tmp_path)
    events = logger._writer.file_writer.event_writer._async_writer
    events._writer._writer = open('/dev/full', 'wb', buffering=0)
  with pytest.raises(OSError, match=str(tmp_path)) as error:
    logger.write({'steps': 10, 'a': 1.0})
    logger.write({'steps': 20, 'a': 1.0})  # It may take until then.
  assert error.value.errno == errno.ENOSPC
  if kind == 'tensorboard':
    events._worker.join(10)
  assert not printed


class _FakeWandb(types.ModuleType):
  """Stands in for Weights and Biases; notes what it is told."""

  def __init__(self) -> None:
    super().__init__('wandb')
    self.begun: list[dict[str, Any]] = []
    self.told: list[Any] = []

  def init(self, **values: Any) -> Any:
    self.begun.append(values)
    return types.SimpleNamespace(
      define_metric=lambda *args, **kwargs: self.told.append((args, kwargs)),
      log=self.told.append,
      finish=lambda: self.told.append('finish'),
    )


def test_wandb(monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path) -> None:
  fake = _FakeWandb()
  monkeypatch.setitem(sys.modules, 'wandb', fake)
  for steps in ((10, 20), (15, 25)):  # The second goes on from a checkpoint.
    logger = loggers.WandbLogger(tmp_path, 'bipeds', {'seed': 3})
    _write(logger, *steps, not_known_yet=math.nan)
  for begun in fake.begun:
    assert begun['project'] == 'bipeds' and begun['config'] == {'seed': 3}
    assert begun['name'] == tmp_path.name and begun['dir'] == str(tmp_path)
    # The same run, which may be there already.
    assert begun['id'] == (tmp_path / 'wandb_id').read_text()
    assert len(begun['id']) == 16 and begun['resume'] == 'allow'
  (tmp_path / 'other').mkdir()
  _write(loggers.WandbLogger(tmp_path / 'other', 'bipeds', {}))
  assert fake.begun[2]['id'] != fake.begun[0]['id']
  abscissa = (('*',), {'step_metric': 'steps'})
  assert fake.told[:-2] == [
    *[abscissa, {'steps': 10, 'a': 1.0}, {'steps': 20, 'a': 2.0}, 'finish'],
    *[abscissa, {'steps': 15, 'a': 1.5}, {'steps': 25, 'a': 2.5}, 'finish'],
  ]


def test_wandb_is_missing(
  monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path
) -> None:
  monkeypatch.setitem(sys.modules, 'wandb', None)
  with pytest.raises(ModuleNotFoundError, match=r'extra `wandb`: pip install'):
    loggers.WandbLogger(tmp_path, 'bipeds', {})
  assert not list(tmp_path.iterdir())


def test_progress_line() -> None:
  line = io.StringIO()
  with contextlib.redirect_stderr(line):
    logger = loggers.ProgressLogger(4000, first_step=1000)
    logger.write(
      {
        'steps': 3000,
        'steps_per_second': 7123.4,
        'mra_modes': 0.81234,
        'mra_transitions': math.nan,  # Not known yet.
        'survival': 0.95,
        'seconds': 3.21,
        'learning_rate': 5e-4,
        'unknown': 1.0,
      }
    )
    logger.close()
  last = line.getvalue().replace('\r', '\n').strip().splitlines()[-1]
  assert '3.00k/4.00k' in last and 'left' not in last
  for part in ('steps/s=7123', 'MRA=0.812', 'survival=0.950', 'lr=5.0e-04'):
    assert part in last
  assert 'seconds=3.2,' in last
  for part in ('unknown', 'std', 'transitions'):
    assert part not in last


def test_progress_of_a_training_that_time_ends() -> None:
  line, now = io.StringIO(), [100.0]
  with contextlib.redirect_stderr(line):
    logger = loggers.ProgressLogger(12_000_000, 0, 3.0, lambda: now[0])
    now[0] += 45.0
    logger.write({'steps': 90_000, 'survival': 0.95})
    now[0] += 200.0
    logger.close()
  (last,) = line.getvalue().splitlines()
  assert '90.0k of at most 12.0M steps' in last
  assert 'minutes left=2.2' in last and 'survival=0.950' in last
  assert '<' not in last  # The time that the steps would take.
