"""Searches settings of a training: many short runs, and what each scores.

`python -m dmc_multimode.bin.sweep` as a function. A sweep is a folder:

sweep.json         what is searched, and all other settings
journal.log        the trials, as Optuna's journal
trials/N/          the run of trial N, and its report.json
sweep.csv, .txt    the table; sweep.png the plot

Several workers may have the same folder. Each locks the trial that it trains;
a trial that is not finished and not locked is gone on with, bit for bit.
"""

import contextlib
import csv
import fcntl
import io
import json
import os
import pathlib
import re
import time
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

from dmc_multimode.experiments import config as run_config
from dmc_multimode.utils import files

OBJECTIVES = (
  'mra_transitions',
  'mra_modes',
  'survival_transitions',
  'survival_modes',
)
_SETTINGS, _JOURNAL, _STUDY = 'sweep.json', 'journal.log', 'sweep'
_TABLE, _TEXT, _PLOT = 'sweep.csv', 'sweep.txt', 'sweep.png'
_REPORT, _LOCK = 'report.json', 'lock'
_MAX_BYTES = 1_000_000
_LOG_RATIO = 10.0  # Ranges as wide as this are searched by orders of magnitude.
_STARTUP = 8  # Trials at random before Optuna's sampler has a model.
_SCORING = ('task_gains', 'task_limits')  # Prefixes of what scores depend on.
_SEARCH = re.compile(r'(\w+):(.+)')
_MISSING = "sweeps take the extra `sweep`: pip install 'dmc_multimode[sweep]'"


class Range(NamedTuple):
  """Values of one setting to search.

  Attributes:
    name: of the setting, as the flags of `train` are named.
    values: its two ends, or what to choose from.
    is_choice: whether it is the latter.
  """

  name: str
  values: tuple[Any, ...]
  is_choice: bool

  def __str__(self) -> str:
    """Returns the text that `parse` reads."""
    between = '|' if self.is_choice else '..'
    return f'{self.name}:{between.join(map(str, self.values))}'

  @property
  def is_log(self) -> bool:
    """True if it is searched by its logarithm."""
    if self.is_choice:
      return False
    low, high = self.values
    return bool(low > 0 and high / low >= _LOG_RATIO)

  def distribution(self) -> Any:
    """Returns it as one of Optuna's."""
    from optuna import distributions

    if self.is_choice:
      return distributions.CategoricalDistribution(self.values)
    low, high = self.values
    if isinstance(low, int):
      return distributions.IntDistribution(low, high, log=self.is_log)
    return distributions.FloatDistribution(low, high, log=self.is_log)


class Trial(NamedTuple):
  """One run of a sweep.

  Attributes:
    number: of the trial, from 0.
    state: 'complete', 'fail' or 'running'.
    value: its score, or None.
    params: values of what is searched, by name.
  """

  number: int
  state: str
  value: float | None
  params: Mapping[str, Any]


def parse(text: str) -> Range:
  """Returns the range of 'NAME:LOW..HIGH' or of 'NAME:A|B|C'.

  Two whole numbers are searched in whole numbers.

  Raises:
    ValueError: in one line, it is neither.
  """
  match = _SEARCH.fullmatch(text.strip())
  if not match:
    raise ValueError(
      f'search {text!r}: write NAME:LOW..HIGH, as in '
      'ppo_learning_rate:1e-4..1e-3, or NAME:A|B|C'
    )
  name, rest = match.groups()
  if name.startswith(_SCORING):
    raise ValueError(
      f'search {text!r}: {name} changes what scores mean, and trials could not '
      'be compared'
    )
  if '..' not in rest:
    choices = tuple(_number(part) for part in rest.split('|'))
    if len(set(choices)) < 2:
      raise ValueError(f'search {text!r}: give two values at least, as in A|B')
    return Range(name, choices, True)
  ends = [_number(part) for part in rest.split('..')]
  if len(ends) != 2 or not all(isinstance(x, (int, float)) for x in ends):
    raise ValueError(f'search {text!r}: LOW..HIGH must be two numbers')
  low, high = ends
  if not low < high < float('inf'):
    raise ValueError(f'search {text!r}: LOW must be less than HIGH')
  if not all(isinstance(x, int) for x in ends):
    low, high = float(low), float(high)
  return Range(name, (low, high), False)


def _number(text: str) -> Any:
  """Returns a number if the text is one, else the text."""
  for kind in (int, float):
    with contextlib.suppress(ValueError):
      return kind(text.strip())
  return text.strip()


def check(search: Sequence[str], settings: Mapping[str, Any]) -> list[Range]:
  """Returns the ranges; raises ValueError, in one line, for what cannot be.

  Args:
    search: texts for `parse`.
    settings: other settings of the runs, by name.
  """
  ranges = [parse(text) for text in search]
  names = [each.name for each in ranges]
  if not ranges:
    raise ValueError('Say what to search, as in ppo_learning_rate:1e-4..1e-3.')
  for name in names:
    if names.count(name) > 1:
      raise ValueError(f'{name} is searched twice.')
    if name in settings:
      raise ValueError(f'{name} is searched, and set: leave one out.')
    if name in ('steps', 'modes', 'threads'):
      raise ValueError(f'{name} is the same in all trials of a sweep.')
  config = run_config.overridden(run_config.RunConfig(), settings)
  for each in ranges:
    for value in each.values:
      run_config.overridden(config, {each.name: value})
  return ranges


def sweep(
  run_dir: str | os.PathLike[str],
  search: Sequence[str],
  trials: int,
  objective: str = OBJECTIVES[0],
  episodes: int = 1,
  sampler_seed: int = 0,
  modes: str | None = None,
  steps: int | None = None,
  mode_file: str | os.PathLike[str] | None = None,
  robot: str | os.PathLike[str] | None = None,
  **settings: Any,
) -> list[Trial]:
  """Trains and scores until there are `trials`; writes table and plot.

  The same call goes on with a sweep that was interrupted, and a second one at
  the same time shares its trials.

  Args:
    run_dir: folder of the sweep.
    search: 'NAME:LOW..HIGH' or 'NAME:A|B|C' each. Ranges of a factor of 10 and
      more are searched by orders of magnitude.
    trials: in all, failed ones included.
    objective: score to maximise, one of `OBJECTIVES`, of the deterministic
      policy at the end of its training.
    episodes: of its evaluation; see `evaluation.evaluate`.
    sampler_seed: of Optuna's sampler; `seed` is that of the trainings.
    modes, steps, mode_file, robot: as in `train`.
    **settings: other settings of all runs, as in `train`.

  Returns:
    The trials, best first.

  Raises:
    ModuleNotFoundError: the extra `sweep` is not installed.
    ValueError: in one line, a range or a setting is wrong, or contradicts the
      sweep in the folder.
    KeyboardInterrupt: a signal stopped the training; it has a checkpoint.
  """
  ranges = check(search, settings)
  if objective not in OBJECTIVES:
    raise ValueError(
      f'objective {objective!r}: give one of {", ".join(OBJECTIVES)}.'
    )
  if trials < 1:
    raise ValueError(f'trials must be positive, got {trials}.')
  folder = files.output_folder('run_dir', run_dir)
  if folder is None:
    raise ValueError('run_dir must name a folder.')
  what = {
    'modes': modes,
    'steps': steps,
    'mode_file': None if mode_file is None else str(mode_file),
    'robot': None if robot is None else str(robot),
    **settings,
  }
  _import_optuna()
  folder.mkdir(parents=True, exist_ok=True)
  with _locked(folder / _LOCK):
    _remember(
      folder / _SETTINGS,
      {
        'search': list(map(str, ranges)),
        'objective': objective,
        'episodes': episodes,
        'settings': json.loads(json.dumps(what, default=str)),
      },
    )
  worker = _Worker(folder, ranges, trials, sampler_seed)
  while worker.take():
    with worker.trial_lock:
      worker.run(objective, episodes, what)
  return finish(folder, worker.trials(), ranges, objective)


def _import_optuna() -> Any:
  """Returns the module, which says nothing of each trial."""
  try:
    import optuna
  except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f'{error}; {_MISSING}') from error
  optuna.logging.set_verbosity(optuna.logging.WARNING)
  return optuna


def _remember(path: pathlib.Path, asked: Mapping[str, Any]) -> None:
  """Writes what a sweep is; raises ValueError if the folder has another."""
  if not path.exists():
    files.write_json(path, asked)
    return
  known = files.read_json(path, _MAX_BYTES)
  for name, value in asked.items():
    if known.get(name) != value:
      raise ValueError(
        f'The sweep in {path.parent} has {name}={known.get(name)}, not '
        f'{value}: give the same, or name another folder.'
      )


@contextlib.contextmanager
def _locked(path: pathlib.Path) -> Iterator[None]:
  """Waits for the lock of a file, which ends with the process at the latest."""
  with open(path, 'a', encoding='utf-8') as file:
    fcntl.flock(file, fcntl.LOCK_EX)
    yield


class _Worker:
  """Takes trials of a sweep one by one, and runs them.

  Attributes:
    trial_lock: of the trial that was taken; its end gives the trial back.
  """

  def __init__(
    self, folder: pathlib.Path, ranges: Sequence[Range], trials: int, seed: int
  ):
    """Opens the study of a folder, or begins it."""
    optuna = _import_optuna()
    from optuna.storages import journal

    self._folder, self._trials = folder, trials
    self._distributions = {each.name: each.distribution() for each in ranges}
    backend = journal.JournalFileBackend(str(folder / _JOURNAL))
    storage = optuna.storages.JournalStorage(backend)
    with _locked(folder / _LOCK):
      self._study = optuna.create_study(
        storage=storage,
        study_name=_STUDY,
        direction='maximize',
        load_if_exists=True,
      )
    begun = len(self._study.trials)
    self._study.sampler = optuna.samplers.TPESampler(
      seed=seed + begun, n_startup_trials=_STARTUP, constant_liar=True
    )
    self.trial_lock = contextlib.ExitStack()

  def trials(self) -> list[Trial]:
    """Returns all trials so far, in their order."""
    return [
      Trial(each.number, each.state.name.lower(), each.value, each.params)
      for each in self._study.trials
    ]

  def take(self) -> bool:
    """Takes a trial that nobody works on, or a new one; False without any."""
    with _locked(self._folder / _LOCK):
      known = self.trials()
      for trial in known:
        if trial.state == 'running' and self._lock(trial.number):
          self._taken = trial
          return True
      if len(known) >= self._trials:
        return False
      new = self._study.ask(self._distributions)
      self._taken = Trial(new.number, 'running', None, new.params)
      return self._lock(new.number)

  def _lock(self, number: int) -> bool:
    """Locks a trial; False if another worker has it."""
    folder = self._folder / 'trials' / str(number)
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
      file = stack.enter_context(open(folder / _LOCK, 'a', encoding='utf-8'))
      try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
      except BlockingIOError:
        return False
      self.trial_lock = stack.pop_all()
      return True

  def run(self, objective: str, episodes: int, what: Mapping[str, Any]) -> None:
    """Trains and scores the trial that was taken; see `sweep`."""
    from optuna import trial as trial_lib

    from dmc_multimode.evaluation import scores
    from dmc_multimode.experiments import run_folder
    from dmc_multimode.experiments import training

    trial = self._taken
    folder = run_folder.RunFolder(self._folder / 'trials' / str(trial.number))
    chosen = ', '.join(f'{k}={_short(v)}' for k, v in trial.params.items())
    print(f'trial {trial.number}: {chosen}', flush=True)
    is_old = folder.holds_run()
    settings = {**what, **trial.params}
    if is_old:  # The folder knows them, and files may have moved.
      for name in ('mode_file', 'robot'):
        settings.pop(name, None)
    began = time.monotonic()
    try:
      policy = training.train(folder.path, resume=is_old, **settings)
    except FloatingPointError as error:
      print(f'trial {trial.number} failed: {error}', flush=True)
      self._study.tell(trial.number, state=trial_lib.TrialState.FAIL)
      return
    if policy.provenance['steps'] < folder.load()[0].steps:
      raise KeyboardInterrupt  # `train` stopped at a signal.
    found = scores.evaluate(
      policy, episodes=episodes, quiet=True, with_motion=False
    )
    files.write_json(folder.path / _REPORT, found)
    value = found[objective]
    value = float(value['mean'] if isinstance(value, dict) else value)
    self._study.tell(trial.number, value)
    seconds = time.monotonic() - began
    print(
      f'trial {trial.number}: {objective} {value:.3f} in {seconds:.0f} s',
      flush=True,
    )


def finish(
  folder: pathlib.Path,
  trials: Sequence[Trial],
  ranges: Sequence[Range],
  objective: str,
) -> list[Trial]:
  """Writes table and plot, prints the table; returns the trials, best first."""
  best = lambda trial: -float('inf') if trial.value is None else trial.value
  ordered = sorted(trials, key=best, reverse=True)
  rows = [
    {
      'trial': trial.number,
      'state': trial.state,
      objective: '' if trial.value is None else trial.value,
      **trial.params,
    }
    for trial in ordered
  ]
  content = io.StringIO()
  writer = csv.DictWriter(content, list(rows[0]), lineterminator='\n')
  writer.writeheader()
  writer.writerows(rows)
  files.write(folder / _TABLE, content.getvalue().encode())
  text = _table(rows)
  files.write(folder / _TEXT, text.encode())
  print(text, end='')
  _draw(folder / _PLOT, trials, ranges, objective)
  print(f'{folder / _TABLE}, {folder / _TEXT} and {folder / _PLOT}')
  return ordered


def _short(value: Any) -> str:
  return f'{value:.4g}' if isinstance(value, float) else str(value)


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
  """Returns rows as text in columns."""
  cells = [list(rows[0]), *([_short(v) for v in row.values()] for row in rows)]
  widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
  lines = (
    '  '.join(f'{cell:>{w}}' for cell, w in zip(row, widths, strict=True))
    for row in cells
  )
  return '\n'.join([*lines, ''])


def _draw(
  path: pathlib.Path,
  trials: Sequence[Trial],
  ranges: Sequence[Range],
  objective: str,
) -> None:
  """Draws the score over each setting, and the best one so far by trials."""
  from dmc_multimode.evaluation import figures

  drawn, (axes,) = figures.empty(1, len(ranges) + 1, 3.4, 3.0)
  done = [trial for trial in trials if trial.value is not None]
  values = [float(trial.value or 0.0) for trial in done]
  for axis, each in zip(axes[:-1], ranges, strict=True):
    inputs = [trial.params[each.name] for trial in done]
    axis.plot(list(map(str, inputs)) if each.is_choice else inputs, values, 'o')
    axis.set_xlabel(each.name)
    if each.is_log:
      axis.set_xscale('log')
  numbers = [trial.number for trial in done]
  axes[-1].plot(numbers, values, 'o', label='trial')
  best = [max(values[: i + 1]) for i in range(len(values))]
  axes[-1].step(numbers, best, where='post', label='best so far')
  axes[-1].set_xlabel('trial')
  axes[0].set_ylabel(objective)
  if done:
    axes[-1].legend(fontsize='small')
  else:
    axes[-1].text(0.5, 0.5, 'no trial is complete', ha='center')
  figures.save(path, drawn)
