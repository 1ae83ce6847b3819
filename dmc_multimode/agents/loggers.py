"""Loggers: each writes a dictionary of numbers; the dispatcher fans out."""

import contextlib
import csv
import io
import math
import pathlib
import secrets
import threading
import time
from typing import Any, Callable, Iterator, Mapping, Protocol, Sequence

from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

Values = Mapping[str, float]
_MAX_CHARACTERS = 1 << 30  # Bytes of a CSV file; longer ones are rejected.


class Logger(Protocol):
  """Writes one row of numbers."""

  def write(self, values: Values) -> None:
    """Writes a row of values by name; 'steps' is the abscissa.

    NaN stands for a value that is not known yet.
    """

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
    with contextlib.ExitStack() as stack:  # Closes all, also after an error.
      for logger in reversed(self._loggers):
        stack.callback(logger.close)


class CSVLogger:
  """Appends rows to a CSV file; the first row determines the columns."""

  def __init__(self, path: pathlib.Path, resume_from: float = 0.0):
    """Opens `path`; rows beyond `resume_from` steps are dropped first."""
    rows = _rows_until(path, resume_from)
    self._path = path
    self._fields = list(rows[0]) if rows else None
    text = io.StringIO()
    if self._fields:
      writer = csv.DictWriter(text, self._fields)
      writer.writeheader()
      writer.writerows(rows)
    files.write(path, text.getvalue().encode())
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
    with _named_errors(self._path):
      self._file.flush()

  def close(self) -> None:
    """See `Logger`."""
    with _named_errors(self._path):
      self._file.close()


@contextlib.contextmanager
def _named_errors(path: pathlib.Path) -> Iterator[None]:
  """Adds the file's name to an error of writing."""
  try:
    yield
  except OSError as error:
    raise OSError(error.errno, error.strerror, str(path)) from error


def _rows_until(path: pathlib.Path, steps: float) -> list[dict[str, str]]:
  """Reads the rows of an interrupted run up to its checkpoint.

  Raises:
    ValueError: the file was not written by a `CSVLogger`.
  """
  if not path.exists() or steps <= 0:
    return []
  try:
    with open(path, newline='', encoding='utf-8') as file:
      text = file.read(_MAX_CHARACTERS + 1)
    if len(text) > _MAX_CHARACTERS:
      raise ValueError('it is too large')
    # A full disk or a killed process may have cut the last row off.
    whole = text[: text.rfind('\n') + 1]
    rows = list(csv.DictReader(io.StringIO(whole, newline='')))
    kept = [r for r in rows if float(r.get('steps') or 'inf') <= steps]
    if any(None in row or None in row.values() for row in kept):
      raise ValueError('a row is not as long as the first')
  except (csv.Error, ValueError) as error:
    raise ValueError(
      f'{path} does not hold the metrics of a run ({error}): move it away to '
      'go on without what was logged.'
    ) from error
  return kept


class TensorBoardLogger:
  """Writes scalars for TensorBoard."""

  def __init__(self, directory: pathlib.Path, resume_from: int = 0):
    """Opens `directory`; events beyond `resume_from` are hidden."""
    # Late: most commands do not need it.
    from torch.utils import tensorboard

    self._path = directory
    purge = resume_from + 1 if resume_from else None
    others = set(threading.enumerate())
    with _named_errors(directory):
      self._writer = tensorboard.SummaryWriter(str(directory), purge_step=purge)
    # Errors of its thread are raised by `flush`; there it would be
    # printed as well, with a traceback.
    self._excepthook = threading.excepthook
    own = set(threading.enumerate()) - others
    threading.excepthook = lambda args: (
      None if args.thread in own else self._excepthook(args)
    )

  def write(self, values: Values) -> None:
    """See `Logger`."""
    with _named_errors(self._path):
      for key, value in values.items():
        if key != 'steps' and not math.isnan(value):
          self._writer.add_scalar(key, value, int(values['steps']))
      # Another thread writes; flushing raises its errors here, and not after
      # two minutes.
      self._writer.flush()

  def close(self) -> None:
    """See `Logger`."""
    try:
      with _named_errors(self._path):
        self._writer.close()
    finally:
      threading.excepthook = self._excepthook


def check_wandb() -> None:
  """Raises ModuleNotFoundError where Weights and Biases is not installed."""
  try:
    import wandb  # noqa: F401
  except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
      f'{error}; logging to Weights and Biases takes the extra `wandb`: pip '
      "install 'dmc_multimode[wandb]'."
    ) from error


class WandbLogger:
  """Writes to a project of Weights and Biases; needs the extra `wandb`.

  Environment variables of wandb select the destination: with
    `WANDB_MODE=offline` it writes below the run's folder only.
  """

  _ID_FILE = 'wandb_id'  # File with the id of the run, for a resumed run.

  def __init__(
    self, directory: pathlib.Path, project: str, config: Mapping[str, Any]
  ):
    """Begins a run, or continues the run that `directory` has begun.

    Args:
      directory: of the training.
      project: its name.
      config: configuration of the training, JSON values.

    Raises:
      ModuleNotFoundError: Weights and Biases is not installed.
    """
    check_wandb()
    import wandb

    path = directory / self._ID_FILE
    if not path.exists():
      files.write(path, secrets.token_hex(8).encode())
    self._run = wandb.init(
      project=project,
      id=path.read_text(encoding='utf-8'),
      name=directory.name,
      dir=str(directory),
      config=dict(config),
      resume='allow',
    )
    # The default abscissa is the number of rows, and rows with steps that were
    # logged before, as in a resumed run, would be dropped.
    self._run.define_metric('*', step_metric='steps')

  def write(self, values: Values) -> None:
    """See `Logger`."""
    self._run.log({k: v for k, v in values.items() if not math.isnan(v)})

  def close(self) -> None:
    """See `Logger`."""
    self._run.finish()


class ProgressLogger:
  """Shows progress on stderr; in a log, a line every half a minute."""

  _SHOWN = (
    ('steps/s', 'steps_per_second', '{:.0f}'),
    ('MRA', 'mra_modes', '{:.3f}'),
    ('transitions', 'mra_transitions', '{:.3f}'),
    ('survival', 'survival', '{:.3f}'),
    ('seconds', 'seconds', '{:.1f}'),
    ('lr', 'learning_rate', '{:.1e}'),
    ('std', 'std', '{:.3f}'),
  )
  # Where time runs out first, the time that the steps would take misleads.
  _TIMED = '{n_fmt} of at most {total_fmt} steps [{elapsed}{postfix}]'

  def __init__(
    self,
    total_steps: int,
    first_step: int = 0,
    minutes: float = math.inf,
    clock: Callable[[], float] = time.monotonic,
  ):
    """Shows progress from `first_step` to `total_steps`.

    Args:
      total_steps: at the end.
      first_step: at the beginning.
      minutes: wall-clock limit from now on; with one, what is left of it is
        shown.
      clock: returns seconds.
    """
    self._clock, self._end = clock, clock() + 60 * minutes
    self._bar = progress_bar.Bar(
      total=total_steps,
      initial=first_step,
      unit='step',
      unit_scale=True,
      mininterval=2.0,
      dynamic_ncols=True,
      bar_format=self._TIMED if math.isfinite(minutes) else None,
      postfix=self._left(),
    )

  def _left(self) -> dict[str, str]:
    """Returns the minutes that are left, if they are limited."""
    left = max(self._end - self._clock(), 0.0) / 60
    return {'minutes left': f'{left:.1f}'} if math.isfinite(left) else {}

  def write(self, values: Values) -> None:
    """See `Logger`."""
    shown = self._left() | {
      name: form.format(values[key])
      for name, key, form in self._SHOWN
      if not math.isnan(values.get(key, math.nan))
    }
    self._bar.set_postfix(shown, refresh=False)
    self._bar.update(int(values['steps']) - self._bar.n)

  def close(self) -> None:
    """See `Logger`."""
    self._bar.close()
