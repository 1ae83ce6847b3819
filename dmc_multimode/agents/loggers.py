"""Loggers: each writes a dictionary of numbers; the dispatcher fans out."""

import csv
import io
import pathlib
from typing import Mapping, Protocol, Sequence

import tqdm

from dmc_multimode import atomic

Values = Mapping[str, float]


class Logger(Protocol):
  """Writes one row of numbers."""

  def write(self, values: Values) -> None:
    """Writes `values` by name; 'steps' is the abscissa."""

  def close(self) -> None:
    """Flushes and closes."""


class Dispatcher:
  """Writes to several loggers."""

  def __init__(self, loggers: Sequence[Logger]):
    """Fans out to `loggers`, in order."""
    self._loggers = tuple(loggers)

  def write(self, values: Values) -> None:
    """See `Logger`."""
    for logger in self._loggers:
      logger.write(values)

  def close(self) -> None:
    """See `Logger`."""
    for logger in self._loggers:
      logger.close()


class CSVLogger:
  """Appends rows to a CSV file whose columns the first row decides."""

  def __init__(self, path: pathlib.Path, resume_from: float = 0.0):
    """Opens `path`; rows beyond `resume_from` steps are dropped first."""
    rows = _rows_until(path, resume_from)
    self._fields = list(rows[0]) if rows else None
    text = io.StringIO()
    if self._fields:
      writer = csv.DictWriter(text, self._fields)
      writer.writeheader()
      writer.writerows(rows)
    atomic.write(path, text.getvalue().encode())
    self._file = open(path, 'a', newline='', encoding='utf-8')

  def write(self, values: Values) -> None:
    """See `Logger`."""
    if self._fields is None:
      self._fields = list(values)
      csv.DictWriter(self._file, self._fields).writeheader()
    writer = csv.DictWriter(self._file, self._fields, extrasaction='ignore')
    writer.writerow(
      {k: f'{v:.6g}' if k != 'steps' else int(v) for k, v in values.items()}
    )
    self._file.flush()

  def close(self) -> None:
    """See `Logger`."""
    self._file.close()


def _rows_until(path: pathlib.Path, steps: float) -> list[dict[str, str]]:
  """Reads the rows of an interrupted run up to its checkpoint."""
  if not path.exists() or steps <= 0:
    return []
  with open(path, newline='', encoding='utf-8') as file:
    rows = list(csv.DictReader(file))
  return [row for row in rows if float(row.get('steps') or 'inf') <= steps]


class TensorBoardLogger:
  """Writes scalars for TensorBoard."""

  def __init__(self, directory: pathlib.Path, resume_from: int = 0):
    """Opens `directory`; what lies beyond `resume_from` is hidden."""
    # Imported here: it takes seconds, and most binaries do not need it.
    from torch.utils import tensorboard  # pylint: disable=g-import-not-at-top

    self._writer = tensorboard.SummaryWriter(
      str(directory), purge_step=resume_from or None
    )

  def write(self, values: Values) -> None:
    """See `Logger`."""
    for key, value in values.items():
      if key != 'steps':
        self._writer.add_scalar(key, value, int(values['steps']))

  def close(self) -> None:
    """See `Logger`."""
    self._writer.close()


class ProgressLogger:
  """Keeps one line on the terminal."""

  _SHOWN = (
    ('steps/s', 'steps_per_second', '{:.0f}'),
    ('MRA', 'mra_modes', '{:.3f}'),
    ('transitions', 'mra_transitions', '{:.3f}'),
    ('survival', 'survival', '{:.3f}'),
    ('lr', 'learning_rate', '{:.1e}'),
    ('std', 'std', '{:.3f}'),
  )

  def __init__(self, total_steps: int, first_step: int = 0):
    """Shows the way from `first_step` to `total_steps`."""
    self._bar = tqdm.tqdm(
      total=total_steps,
      initial=first_step,
      unit='step',
      unit_scale=True,
      mininterval=2.0,
      dynamic_ncols=True,
    )

  def write(self, values: Values) -> None:
    """See `Logger`."""
    shown = {
      name: form.format(values[key])
      for name, key, form in self._SHOWN
      if key in values
    }
    self._bar.set_postfix(shown, refresh=False)
    self._bar.update(int(values['steps']) - self._bar.n)

  def close(self) -> None:
    """See `Logger`."""
    self._bar.close()
