"""Defines what trainings must survive, a function a fault: see `faults`."""

import contextlib
import csv
import dataclasses
import os
import pathlib
import pickle
import random
import shutil
import signal
import subprocess
import time
from typing import Any, Callable, Iterator, Mapping

from benchmarks.reliability import fault_hooks
from benchmarks.reliability import fault_process
from dmc_multimode.agents import checkpointing

_WORLDS, _LENGTH = 8, 4
ITERATION = _WORLDS * _LENGTH  # Control steps.
_ITERATIONS = 24
_FLAGS = (
  f'--num_worlds={_WORLDS}',
  f'--ppo_rollout_length={_LENGTH}',
  '--ppo_hidden_sizes=16',
  '--ppo_epochs=1',
  '--ppo_minibatches=1',
  '--modes=idle,launch',
  '--one_hot',
  '--threads=1',
  f'--steps={ITERATION * _ITERATIONS}',
)
_INTERVAL = 0.15  # Seconds between checkpoints.
_CALLS = 8  # fsyncs and renames of a checkpoint and its policy.
_POISONED = 8  # The iteration in which something becomes NaN.
_NOBODY = 65534
_KILOBYTE = 1 << 10

Hooks = Mapping[str, Mapping[str, Any]]
_SLOWLY: Hooks = {'slow': {'seconds': 0.2}}  # Five seconds in all, at least.


class Skipped(Exception):
  """A fault cannot be had here; the message says why."""


@dataclasses.dataclass
class Row:
  """One fault, however often.

  Attributes:
    fault: what happened.
    cases: how often.
    explained: how often the process ended as it is documented to.
    compared: states that were compared with the undisturbed run's, bit for bit.
    different: those that were not the same.
    checkpoints_lost: completed checkpoints that were not resumed from although
      they were whole.
    most_lost: control steps that were done again, at most, in iterations.
    problems: what is not as it should be, a line each.
    skipped: why it did not happen here.
  """

  fault: str
  cases: int = 0
  explained: int = 0
  compared: int = 0
  different: int = 0
  checkpoints_lost: int = 0
  most_lost: int = 0
  problems: list[str] = dataclasses.field(default_factory=list)
  skipped: str = ''

  def judge(self, done: fault_process.Done, code: int) -> None:
    """Counts a case by how its process ended."""
    self.cases += 1
    problem = done.unexplained(code)
    self.explained += not problem
    self.problems += [problem] if problem else []


@dataclasses.dataclass(frozen=True)
class _Reference:
  """A run that nothing disturbed.

  Attributes:
    states: hash of everything, by control steps.
    rows: of the log, without the speed.
    seconds: from start to end.
  """

  states: Mapping[int, str]
  rows: list[dict[str, str]]
  seconds: float


class _Journal:
  """What `fault_hooks.journal` noted in one process."""

  def __init__(self, path: pathlib.Path):
    self.states: dict[int, str] = {}
    self.saved: list[int] = []
    text = path.read_text(encoding='ascii') if path.exists() else ''
    for line in text.splitlines():
      what, steps, *rest = line.split()
      if what == 'at':
        self.states[int(steps)] = rest[0]
      elif what == 'saved':
        self.saved.append(int(steps))


class Run:
  """One training in a folder of its own, disturbed and resumed."""

  def __init__(
    self, campaign: 'Campaign', row: Row, folder: pathlib.Path, hooks: Hooks
  ):
    """Will train in `folder`; `hooks` are part of what it is."""
    self.folder = folder
    self._campaign, self._row, self._hooks = campaign, row, hooks
    self._reference = campaign.reference(hooks)
    self._done, self._saved = 0, 0  # Control steps; by whole checkpoints.

  @property
  def seconds(self) -> float:
    """How long it takes when nothing disturbs it."""
    return self._reference.seconds

  def start(self, more: Hooks | None = None, *flags: str) -> int:
    """Starts or resumes it; returns the process."""
    self._campaign.journal.unlink(missing_ok=True)
    self._campaign.journal.touch(mode=0o666)
    os.chmod(self._campaign.journal, 0o666)
    flags = (*_FLAGS, *flags)
    if (self.folder / 'config.json').exists():
      flags = ('--resume', *flags)
    hooks: dict[str, Mapping[str, Any]] = {
      'journal': {'path': str(self._campaign.journal)},
      'checkpoint_every': {'seconds': _INTERVAL},
      **self._hooks,
      **(more or {}),
    }
    return self._campaign.trainings.start(
      (f'--run_dir={self.folder}', *flags), hooks
    )

  def wait(self) -> fault_process.Done:
    """Waits for its end; compares what it has computed."""
    done = self._campaign.trainings.wait()
    found, row = _Journal(self._campaign.journal), self._row
    for steps, state in found.states.items():
      row.compared += 1
      if self._reference.states.get(steps) != state:
        row.different += 1
    if found.states:
      resumed = min(found.states) - ITERATION
      row.checkpoints_lost += resumed < self._saved
      row.most_lost = max(row.most_lost, (self._done - resumed) // ITERATION)
      self._done = max(found.states)
      self._saved = max([resumed, *found.saved])
    return done

  def forget(self) -> None:
    """Nothing is left of it, as was to be expected."""
    self._done = self._saved = 0

  def give_up(self, steps: int) -> None:
    """The checkpoint of those steps is the newest that can be had."""
    self._saved = min(self._saved, steps)

  def wait_for_progress(self) -> None:
    """Waits until some iterations are done and a checkpoint is written."""
    while self._campaign.trainings.is_running():
      if _Journal(self._campaign.journal).saved:
        return

  def finish(self) -> fault_process.Done:
    """Lets it go on to its end, where it must be what it would have been."""
    self.start()
    done = self.wait()
    problem = done.unexplained(0)
    row = self._row
    row.problems += [f'resumed: {problem}'] if problem else []
    if not problem:
      if _rows(self.folder) != self._reference.rows:
        row.problems.append('The log has other rows.')
      left = [p.name for p in self.folder.rglob('.*')]
      row.problems += [f'{name} was left behind.' for name in left]
    return done


def _rows(folder: pathlib.Path) -> list[dict[str, str]]:
  """Returns the rows of a run's log without its speed."""
  with open(folder / 'metrics.csv', newline='', encoding='utf-8') as file:
    return [{**r, 'steps_per_second': ''} for r in csv.DictReader(file)]


class Campaign:
  """All the faults, on trainings that one process starts."""

  def __init__(self, folder: pathlib.Path, seed: int):
    """Will work in a folder; what is random comes from `seed`."""
    self.random = random.Random(seed)
    self._folder = folder
    self.journal = folder / 'journal'
    os.chmod(folder, 0o777)
    self.trainings = fault_process.Trainings(folder)
    self._references: dict[str, _Reference] = {}
    self._count = 0

  def close(self) -> None:
    """Ends the process that starts trainings."""
    self.trainings.close()

  def reference(self, hooks: Hooks) -> _Reference:
    """Returns the undisturbed run, which is run when it is first needed."""
    key = repr(hooks)
    if key not in self._references:
      folder = self._new_folder()
      self.journal.unlink(missing_ok=True)
      done = self.trainings.run(
        (f'--run_dir={folder}', *_FLAGS),
        {'journal': {'path': str(self.journal)}, **hooks},
      )
      if done.unexplained(0):
        raise RuntimeError(done.unexplained(0))
      states = _Journal(self.journal).states
      tensors, _ = checkpointing.load_tensors(folder / checkpointing.NAME)
      if fault_hooks.digest(tensors) != states[max(states)]:
        raise RuntimeError('The checkpoint is not what was computed.')
      self._references[key] = _Reference(states, _rows(folder), done.seconds)
    return self._references[key]

  def _new_folder(self) -> pathlib.Path:
    self._count += 1
    return self._folder / f'run{self._count}'

  @contextlib.contextmanager
  def run(self, row: Row, hooks: Hooks | None = None) -> Iterator[Run]:
    """A new run, whose folder goes with it."""
    folder = self._new_folder()
    try:
      yield Run(self, row, folder, hooks or {})
    finally:
      shutil.rmtree(folder, ignore_errors=True)

  # Death.

  def killed(self, kills: int) -> Row:
    """`kill -9` at random moments, up to five times a run."""
    row = Row('kill -9 at a random moment')
    while row.cases < kills:
      with self.run(row) as run:
        for _ in range(min(5, kills - row.cases)):
          process = run.start()
          if self.trainings.is_running(self.random.uniform(0, run.seconds)):
            os.kill(process, signal.SIGKILL)
          done = run.wait()
          if done.code:
            row.judge(done, -signal.SIGKILL)
        run.finish()
    return row

  def killed_in_checkpoint(self, kills: int) -> Row:
    """`kill -9` before every fsync and rename of checkpoints, in turn."""
    row = Row('kill -9 inside a checkpoint write')
    while row.cases < kills:
      with self.run(row) as run:
        for _ in range(min(4, kills - row.cases)):
          # The write before the first fsync is cut off anywhere.
          call = row.cases % _CALLS + _CALLS * self.random.randrange(2)
          share = self.random.random()
          run.start({'die_in_checkpoint': {'call': call, 'share': share}})
          done = run.wait()
          if done.code:
            row.judge(done, -signal.SIGKILL)
        run.finish()
    return row

  # Signals.

  def asked_to_stop(self, name: str, cases: int) -> Row:
    """A signal that ends a run with a checkpoint of its last iteration."""
    row = Row(f'{name}')
    for _ in range(cases):
      with self.run(row) as run:
        process = run.start(_SLOWLY)
        run.wait_for_progress()
        self.trainings.is_running(self.random.uniform(0, 1))
        os.kill(process, signal.Signals[name])
        row.judge(run.wait(), 0)
        run.finish()
        if row.most_lost:
          row.problems.append('Iterations were lost.')
    return row

  def interrupted_twice(self, cases: int) -> Row:
    """Two SIGINTs in one rollout that takes long."""
    row = Row('SIGINT twice')
    for _ in range(cases):
      with self.run(row) as run:
        process = run.start({'stall': {'iteration': 10}})
        run.wait_for_progress()
        while max(_Journal(self.journal).states) < 9 * ITERATION:
          time.sleep(0.05)
        time.sleep(0.5)
        os.kill(process, signal.SIGINT)
        if not self.trainings.is_running(0.5):
          row.problems.append('The first one ended it.')
        os.kill(process, signal.SIGINT)
        row.judge(run.wait(), -signal.SIGINT)
        run.finish()
    return row

  # Disks.

  def disk_full(self) -> Row:
    """A disk of so many kilobytes, which grows after the error."""
    row = Row('disk full')
    _must_be_root()
    for size in (8, 24, 48, 76, 100, 128, 148, 168):
      with self.run(row) as run, _small_disk(run.folder, size) as grow:
        run.folder /= 'run'
        run.start()
        done = run.wait()
        if done.code:
          row.judge(done, 2)
          if 'No space left' not in ' '.join(done.errors):
            row.problems.append(f'Another error: {done.errors}')
        grow()
        run.finish()
    return row

  def folder_gone(self) -> Row:
    """The folder is moved away and put back, or removed for good."""
    row = Row('run directory moved away, or removed')
    for comes_back in (True, True, False):
      with self.run(row) as run:
        run.start(_SLOWLY)
        run.wait_for_progress()
        away = run.folder.with_name('away')
        run.folder.rename(away)
        done = run.wait()
        row.judge(done, 2)
        if run.folder.exists():
          row.problems.append('It was made again.')
        if comes_back:
          away.rename(run.folder)
        else:
          shutil.rmtree(away)
          run.forget()
        run.finish()
    return row

  def folder_read_only(self) -> Row:
    """The folder cannot be written to from some moment on, or ever."""
    row = Row('run directory read-only')
    hooks = {'as_user': {'user': _NOBODY}} if os.getuid() == 0 else {}
    for from_the_start in (False, False, True):
      with self.run(row) as run:
        if from_the_start:
          run.folder.mkdir()
          os.chmod(run.folder, 0o555)
        run.start({**_SLOWLY, **hooks})
        if not from_the_start:
          run.wait_for_progress()
          _chmod(run.folder, 0o555)
        row.judge(run.wait(), 2)
        _chmod(run.folder, 0o777)
        run.finish()
    return row

  # Time.

  def clock_jumps(self, cases: int) -> Row:
    """Clocks that jump while it trains."""
    row = Row('clock jumps')
    for seed in range(cases):
      with self.run(row) as run:
        run.start({'clock_jumps': {'seed': seed}})
        done = run.wait()
        row.judge(done, 0)
        run.finish()
    return row

  # Numbers.

  def world_nan(self, cases: int) -> Row:
    """A world that becomes NaN begins anew, is counted, and ends nothing."""
    row = Row('a world goes NaN')
    hooks = {'world_goes_nan': {'iteration': _POISONED, 'worlds': [2]}}
    for _ in range(cases):
      with self.run(row, hooks) as run:
        process = run.start(_SLOWLY)
        run.wait_for_progress()
        self.trainings.is_running(self.random.uniform(0, 4))
        if self.trainings.is_running(0):
          os.kill(process, signal.SIGKILL)
        done = run.wait()
        row.judge(done, done.code and -signal.SIGKILL)
        run.finish()
        counted = [float(found['diverged']) for found in _rows(run.folder)]
        if counted[0] != 0 or counted[-1] != 1:
          row.problems.append(f'Counted {counted} worlds.')
    return row

  def stops(self, fault: str, hooks: Hooks, words: str) -> Row:
    """Numbers that end a run with one error and leave its checkpoint alone."""
    row = Row(fault)
    with self.run(row) as run:
      run.start(hooks)
      done = run.wait()
      row.judge(done, 2)
      if words not in ' '.join(done.errors):
        row.problems.append(f'Another error: {done.errors}')
      run.finish()
    return row

  def worlds_nan(self) -> Row:
    """More worlds than a thousandth of the steps go NaN."""
    hooks = {'worlds_go_nan': {'iteration': _POISONED}}
    return self.stops('more than 0.1% of worlds NaN', hooks, 'diverged')

  def reward_nan(self) -> Row:
    """One reward goes NaN."""
    hooks = {'reward_goes_nan': {'iteration': _POISONED}}
    return self.stops('a reward goes NaN', hooks, 'not finite')

  # Files.

  def newest_damaged(self) -> Row:
    """The newest checkpoint is damaged in one way after the other."""
    row = Row('newest checkpoint damaged')
    half = ITERATION * _ITERATIONS // 2
    with self.run(row) as first:
      before = half - 2 * ITERATION
      for steps in (before, half):  # With a checkpoint at the end of each.
        first.start({'checkpoint_every': {'seconds': 1e9}}, f'--steps={steps}')
        first.wait()
      for name, damage in _damages(self.random).items():
        with self.run(row) as run:
          shutil.copytree(first.folder, run.folder)
          damage(run.folder / checkpointing.NAME)
          run._done = half
          done = run.finish()
          row.judge(done, 0)
          if f'Resuming from {checkpointing.PREVIOUS}' not in done.stdout:
            row.problems.append(f'{name}: it does not say so: {done.stdout}')
          if min(_Journal(self.journal).states) != before + ITERATION:
            row.problems.append(f'{name}: not the one before.')
          if (run.folder.parent / 'ran').exists():
            row.problems.append(f'{name}: executed.')
    return row

  def both_damaged(self) -> Row:
    """Neither checkpoint is whole."""
    row = Row('both checkpoints damaged')
    with self.run(row) as run:
      run.start(None, f'--steps={ITERATION * _ITERATIONS // 2}')
      run.wait()
      for name in (checkpointing.NAME, checkpointing.PREVIOUS):
        path = run.folder / name
        path.write_bytes(path.read_bytes()[:-100])
      before = {p: p.read_bytes() for p in run.folder.rglob('*') if p.is_file()}
      run.start()
      row.judge(run.wait(), 2)
      after = {p: p.read_bytes() for p in run.folder.rglob('*') if p.is_file()}
      if before != after:
        row.problems.append('Files have changed.')
    return row


def _must_be_root() -> None:
  if os.getuid():
    raise Skipped('only root can mount a small disk')


@contextlib.contextmanager
def _small_disk(
  folder: pathlib.Path, kilobytes: int
) -> Iterator[Callable[[], object]]:
  """Mounts a disk at a folder; yields what makes it large."""
  folder.mkdir()
  mount = ['mount', '-t', 'tmpfs', '-o', f'size={kilobytes}k', 'tmpfs']
  try:
    subprocess.run([*mount, str(folder)], check=True, capture_output=True)
  except (OSError, subprocess.CalledProcessError) as error:
    raise Skipped(f'no small disk can be mounted ({error})') from error
  larger = ['mount', '-o', 'remount,size=64m', str(folder)]
  try:
    yield lambda: subprocess.run(larger, check=True)
  finally:
    subprocess.run(['umount', str(folder)], check=True)


def _chmod(folder: pathlib.Path, mode: int) -> None:
  for path in (folder, *folder.rglob('*')):
    if path.is_dir():
      os.chmod(path, mode)
    elif mode & 0o222:
      os.chmod(path, 0o666)


class _Planted:
  """A pickle that makes a file where it is loaded."""

  def __init__(self, mark: pathlib.Path):
    self._mark = mark

  def __reduce__(self) -> tuple[Any, ...]:
    return pathlib.Path.touch, (self._mark,)


def _damages(
  source: random.Random,
) -> Mapping[str, Callable[[pathlib.Path], Any]]:
  """Returns ways to damage a file, by name."""

  def cut(path: pathlib.Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: source.randrange(1, len(content))])

  def flip(path: pathlib.Path) -> None:
    content = bytearray(path.read_bytes())
    place = source.randrange(len(content))
    content[place] ^= 1 << source.randrange(8)
    path.write_bytes(content)

  def blank(path: pathlib.Path) -> None:
    content = bytearray(path.read_bytes())
    start = source.randrange(len(content) - 4096)
    content[start : start + 4096] = bytes(4096)
    path.write_bytes(content)

  def plant(path: pathlib.Path) -> None:
    mark = path.parent.parent / 'ran'
    path.write_bytes(pickle.dumps(_Planted(mark)))

  return {
    'cut off': cut,
    'cut off again': cut,
    'one bit': flip,
    'another bit': flip,
    'a third bit': flip,
    'a page of zeros': blank,
    'empty': lambda path: path.write_bytes(b''),
    'a pickle': plant,
    'missing': lambda path: path.unlink(),
  }
