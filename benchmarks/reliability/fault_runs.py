"""Runs tiny trainings that faults disturb, and compares what they compute."""

import csv
import dataclasses
import functools
import multiprocessing
from multiprocessing import process as process_lib
import os
import pathlib
import random
import re
import runpy
import shutil
import signal
import sys
import time
from typing import Any, Mapping, NamedTuple

from benchmarks.reliability import fault_hooks

WORLDS, LENGTH, ITERATIONS = 8, 4, 24
STEPS = WORLDS * LENGTH  # Control steps of an iteration.
_FLAGS = (
  *(f'--num_worlds={WORLDS}', f'--ppo_rollout_length={LENGTH}'),
  *('--ppo_hidden_sizes=16', '--ppo_epochs=1', '--ppo_minibatches=1'),
  *('--modes=idle,launch', '--one_hot', '--threads=1'),
  f'--steps={STEPS * ITERATIONS}',
)
_INTERVAL = 0.15  # Seconds between checkpoints.
_TIMEOUT = 300  # Seconds after which a training is ended.
# The progress line, and MuJoCo's word on a world that diverges.
_EXPECTED = re.compile(r'%\||step/s|^W.*The simulation is unstable')

# Names of functions of `fault_hooks`, and their arguments.
Hooks = Mapping[str, Mapping[str, Any]]


class Done(NamedTuple):
  """Records what a command line led to.

  Attributes:
    code: exit code; that of a signal is negative.
    errors: the lines on stderr that are no progress line, nor MuJoCo's warning
      of a state that is not finite.
    seconds: from its start to its end.
  """

  code: int
  errors: tuple[str, ...]
  seconds: float

  def unexplained(self, code: int, words: str = '') -> str:
    """Returns what is wrong with an end by `code` and, if > 0, one line."""
    text = ' / '.join(self.errors)
    if self.code != code:
      return f'exit code {self.code}, not {code}: {text}'
    told = [line.startswith('error: ') for line in self.errors]
    if told != [True] * (code > 0) or words not in text:
      return f'stderr: {text}'
    return ''


@dataclasses.dataclass
class Row:
  """Counts what one fault led to; `faults` explains the columns."""

  fault: str
  cases: int = 0
  explained: int = 0
  compared: int = 0
  different: int = 0
  checkpoints_lost: int = 0
  most_lost: int = 0
  problems: list[str] = dataclasses.field(default_factory=list)
  skipped: str = ''

  def judge(self, done: Done, code: int, words: str) -> None:
    """Counts a case by how its process ended."""
    problem = done.unexplained(code, words)
    self.cases += 1
    self.explained += not problem
    self.problems += [problem] if problem else []


def _journal(path: pathlib.Path) -> tuple[dict[int, str], list[int]]:
  """Returns states and checkpoints that `fault_hooks.journal` noted."""
  lines = [line.split() for line in path.read_text('ascii').splitlines()]
  states = {int(x[1]): x[2] for x in lines if x[0] == 'at'}
  return states, [int(x[1]) for x in lines if x[0] == 'saved']


def _train(args: tuple[str, ...], hooks: Hooks, folder: pathlib.Path) -> None:
  """Runs a command line in this process, a child that was just forked."""
  signal.alarm(_TIMEOUT)
  output = os.open(folder / 'stderr', os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
  os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
  os.dup2(output, 2)
  for name, values in hooks.items():
    getattr(fault_hooks, name)(**values)
  sys.argv = ['train', *args]
  runpy.run_module('dmc_multimode.bin.train', run_name='__main__')


@functools.cache
def _forks() -> Any:
  """Returns what forks trainings from a process that has imported the library.

  Each has flags, signals and an exit code of its own, as a user's would, and
  starts at once.
  """
  context = multiprocessing.get_context('forkserver')
  context.set_forkserver_preload(
    [
      *(fault_hooks.__name__, 'dmc_multimode.experiments.setup'),
      # Imported late: by optimisers, and by the logger. It takes seconds, and
      # another user may not be allowed to read them.
      *('torch._dynamo', 'torch.utils.tensorboard'),
    ]
  )
  return context


class Run:
  """Trains in a folder of its own, disturbed and resumed."""

  def __init__(
    self, row: Row, work: pathlib.Path, lasting: Hooks, case: int, seed: int
  ):
    """Will train inside `work`, with `lasting` hooks; counts in `row`."""
    work.mkdir()
    os.chmod(work, 0o777)
    self.row, self.work, self.folder = row, work, work / 'run'
    self.case, self.random = case, random.Random(seed + case)
    self.reference: Reference | None = None
    self._lasting, self._journal = lasting, work / 'journal'
    self.done, self.saved = 0, 0  # Control steps; by whole checkpoints.
    self._began = 0.0
    self._process: process_lib.BaseProcess | None = None

  def start(self, hooks: Hooks | None = None) -> None:
    """Starts or resumes it, with more hooks in the process."""
    self._journal.write_text('')
    os.chmod(self._journal, 0o666)
    flags: tuple[str, ...] = (f'--run_dir={self.folder}', *_FLAGS)
    if (self.folder / 'config.json').exists():
      flags = ('--resume', *flags)
    wanted: Hooks = {
      'journal': {'path': str(self._journal)},
      'checkpoint_every': {'seconds': _INTERVAL},
      **self._lasting,
      **(hooks or {}),
    }
    arguments = (flags, wanted, self.work)
    self._process = _forks().Process(target=_train, args=arguments)
    self._began = time.monotonic()
    self._process.start()

  def is_running(self, seconds: float = 0.002) -> bool:
    """Waits that long; returns whether the process has not ended by then."""
    assert self._process
    self._process.join(seconds)
    return self._process.is_alive()

  def send(self, number: signal.Signals) -> None:
    """Sends a signal."""
    assert self._process and self._process.pid
    os.kill(self._process.pid, number)

  def wait_until(self, steps: int) -> None:
    """Waits for those control steps and a checkpoint, or the end."""
    while self.is_running():
      states, saved = _journal(self._journal)
      if saved and max(states, default=0) >= steps:
        return

  def wait(self) -> Done:
    """Waits for its end; compares what it has computed."""
    assert self._process
    self._process.join()
    seconds = time.monotonic() - self._began
    text = (self.work / 'stderr').read_text('utf-8', errors='replace')
    lines = text.replace('\r', '\n').splitlines()
    errors = [x for x in lines if x.strip() and not _EXPECTED.search(x)]
    if self.reference:
      self._compare(self.reference)
    return Done(self._process.exitcode or 0, tuple(errors), seconds)

  def _compare(self, reference: 'Reference') -> None:
    (states, saved), row = _journal(self._journal), self.row
    row.compared += len(states)
    row.different += len(states.items() - reference.states.items())
    if states:
      resumed = min(states) - STEPS
      row.checkpoints_lost += resumed < self.saved
      row.most_lost = max(row.most_lost, (self.done - resumed) // STEPS)
      self.done = max(states)
      self.saved = max([resumed, *saved])

  def finish(self) -> None:
    """Resumes it to its end, where it must be what it would have been."""
    assert self.reference
    self.start()
    problem = self.wait().unexplained(0)
    if problem:
      self.row.problems.append(f'resumed: {problem}')
      return
    if self.rows() != self.reference.rows:
      self.row.problems.append('The log has other rows.')
    left = [path.name for path in self.folder.rglob('.*')]
    self.row.problems += [f'{name} was left behind.' for name in left]

  def rows(self) -> list[dict[str, str]]:
    """Returns the rows of its log without its speed."""
    path = self.folder / 'metrics.csv'
    with open(path, newline='', encoding='utf-8') as file:
      return [{**r, 'steps_per_second': ''} for r in csv.DictReader(file)]


class Reference:
  """Trains undisturbed: hashes by control steps, rows of the log, seconds."""

  def __init__(self, work: pathlib.Path, lasting: Hooks):
    """Trains with the hooks `lasting`."""
    run = Run(Row('reference'), work, lasting, 0, 0)
    run.start()
    done = run.wait()
    if done.unexplained(0):
      raise RuntimeError(done.unexplained(0))
    self.states, _ = _journal(work / 'journal')
    self.rows, self.seconds = run.rows(), done.seconds
    shutil.rmtree(work)
