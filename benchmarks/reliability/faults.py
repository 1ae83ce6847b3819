"""Disturbs trainings in every way below, and counts what is lost.

    python -m benchmarks.reliability.faults --out=faults.json

A tiny training of `dmc_multimode.bin.train` is disturbed, resumed, and compared
with the same training undisturbed: a hash of everything that a checkpoint
holds, after every single iteration. What is counted:

- cases: how often the fault happened;
- explained: how often the process ended as documented: with that exit code, and
  where it is an error with one line that says so, and no traceback;
- states: iterations whose state was compared; different: not the same bits;
- lost: whole checkpoints that a resumed run did not go on from; again: the most
  iterations that had to be done again.

A new fault is a row of `faults()`. Some need root: small disks are mounted, and
the process whose folder is read-only is another user's. They are skipped
elsewhere, with the reason. Ends with 3 if anything is lost, different or
unexplained. Damaged checkpoints are tests/agents/checkpointing_test.py's.
"""

import contextlib
import functools
import os
import pathlib
import shutil
import signal
import subprocess
import tempfile
import time
from typing import Any, Callable, ContextManager, Iterator, NamedTuple, Sequence

from absl import flags

from benchmarks import common
from benchmarks.reliability import fault_runs
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

_KILLS = flags.DEFINE_integer('kills', 50, 'Half of them in checkpoints.', 2)
_CASES = flags.DEFINE_integer('cases', 3, 'Of each other random fault.', 1)
_ONLY = flags.DEFINE_list('only', None, 'Names of faults; all by default.')
_FOLDER = config_flags.define_path(
  'folder', None, 'Where to work; by default a temporary folder.'
)
_OUT = common.define_out()

_SEED = 0  # Of the moments. A flag of that name would be `train`'s, too.
_POISONED = 8  # The iteration in which something becomes NaN.
_NOBODY = 65534
_CALLS = 8  # fsyncs and renames of a checkpoint and its policy.
_DISKS = (8, 24, 48, 76, 100, 128, 148, 168)  # Kilobytes.
_SLOWLY: fault_runs.Hooks = {'slow': {'seconds': 0.2}}

Run = fault_runs.Run


class Skipped(Exception):
  """A fault cannot be had here; the message says why."""


@contextlib.contextmanager
def _start(run: Run, hooks: fault_runs.Hooks | None = None) -> Iterator[None]:
  """Only starts: the hooks do the rest."""
  run.start(hooks)
  yield


@contextlib.contextmanager
def _killed(run: Run) -> Iterator[None]:
  """Kills at a random moment."""
  assert run.reference
  run.start({'slow': {'seconds': 0.05}})  # Or all is over before we strike.
  if run.random.random() < 0.3:  # Maybe before there is a checkpoint.
    run.is_running(run.random.uniform(0, 0.3 * run.reference.seconds))
  else:
    further = run.random.randrange(fault_runs.ITERATIONS // 4)
    run.wait_until(run.done + further * fault_runs.STEPS)
    run.is_running(run.random.uniform(0, 0.02))
  if run.is_running():
    run.send(signal.SIGKILL)
  yield


@contextlib.contextmanager
def _killed_in_checkpoint(run: Run) -> Iterator[None]:
  """Kills before every fsync and rename in turn, a file cut off anywhere."""
  call = run.row.cases % _CALLS + _CALLS * run.random.randrange(2)
  share = run.random.random()
  run.start({'die_in_checkpoint': {'call': call, 'share': share}})
  yield


@contextlib.contextmanager
def _asked_to_stop(run: Run, number: signal.Signals) -> Iterator[None]:
  """Asks once, after a checkpoint."""
  run.start(_SLOWLY)
  run.wait_until(0)
  run.is_running(run.random.uniform(0, 1))
  run.send(number)
  yield


@contextlib.contextmanager
def _interrupted_twice(run: Run) -> Iterator[None]:
  """Interrupts twice in one rollout that takes long."""
  run.start({'slow': {'seconds': 300, 'iteration': 10}})
  run.wait_until(9 * fault_runs.STEPS)
  time.sleep(0.5)
  run.send(signal.SIGINT)
  if not run.is_running(0.5):
    run.row.problems.append('The first one ended it.')
  run.send(signal.SIGINT)
  yield


@contextlib.contextmanager
def _disk_full(run: Run) -> Iterator[None]:
  """Trains on a disk of so many kilobytes, which grows after the error."""
  if os.getuid():
    raise Skipped('only root can mount a small disk')
  run.folder = run.work / 'disk' / 'run'
  disk, size = str(run.folder.parent), _DISKS[run.case % len(_DISKS)]
  os.mkdir(disk)
  mount = ['mount', '-t', 'tmpfs', '-o', f'size={size}k', 'tmpfs', disk]
  try:
    subprocess.run(mount, check=True, capture_output=True)
  except (OSError, subprocess.CalledProcessError) as error:
    raise Skipped(f'no small disk can be mounted ({error})') from error
  run.start()
  yield
  grow = ['mount', '-o', 'remount,size=64m', disk]
  subprocess.run(grow, check=True)


@contextlib.contextmanager
def _folder_gone(run: Run) -> Iterator[None]:
  """Moves the folder away and puts it back, or every third time does not."""
  run.start(_SLOWLY)
  run.wait_until(0)
  away = run.folder.rename(run.work / 'away')
  yield
  if run.folder.exists():
    run.row.problems.append('It was made again.')
  if run.case % 3 < 2:
    away.rename(run.folder)
  else:
    shutil.rmtree(away)
    run.done = run.saved = 0


@contextlib.contextmanager
def _folder_read_only(run: Run) -> Iterator[None]:
  """Forbids to write from some moment on, every third time from the start."""
  hooks: dict[str, Any] = dict(_SLOWLY)
  if os.getuid() == 0:
    hooks['as_user'] = {'user': _NOBODY}
  if run.case % 3 < 2:
    run.start(hooks)
    run.wait_until(0)
    _set_modes(run.folder, 0o555)
  else:
    run.folder.mkdir(0o555)
    run.start(hooks)
  yield
  _set_modes(run.folder, 0o777)


def _set_modes(folder: pathlib.Path, mode: int) -> None:
  for path in (folder, *folder.rglob('*')):
    os.chmod(path, mode if path.is_dir() else 0o666)


@contextlib.contextmanager
def _world_nan(run: Run) -> Iterator[None]:
  """Sets a world to NaN; the log must count it."""
  run.start()
  yield
  counted = [float(row['diverged']) for row in run.rows()]
  if counted[0] != 0 or counted[-1] != 1:
    run.row.problems.append(f'Counted {counted} worlds.')


class Fault(NamedTuple):
  """Describes a way to disturb a training.

  `disturb` starts a run and disturbs it; once the process has ended, with the
  documented exit code and words, what follows its `yield` mends what a user
  would. Each of the runs is disturbed and resumed so many times, with the hooks
  `lasting` as the undisturbed one has, and at most `most_again` iterations are
  done again.
  """

  title: str
  code: int
  runs: int
  disturb: Callable[[Run], ContextManager[None]]
  words: str = ''
  times: int = 1
  lasting: fault_runs.Hooks = {}
  most_again: int = fault_runs.ITERATIONS


def _hooked(name: str, **values: Any) -> Callable[[Run], ContextManager[None]]:
  """Returns a disturbance by a hook alone."""
  return lambda run: _start(run, {name: values})


def faults(kills: int, cases: int) -> dict[str, Fault]:
  """Returns all faults by name."""
  at, runs, kill = {'iteration': _POISONED}, -(-kills // 10), -signal.SIGKILL
  world = {'world_goes_nan': {**at, 'world': 2}}
  asked = lambda n: functools.partial(_asked_to_stop, number=n)
  in_checkpoint = 'kill -9 inside a checkpoint write'
  gone = 'run directory moved away, or removed'
  many = 'more than 0.1% of worlds NaN'
  return {
    'killed': Fault('kill -9 at a random moment', kill, runs, _killed, times=5),
    'killed_in_checkpoint': Fault(
      in_checkpoint, kill, runs, _killed_in_checkpoint, times=5
    ),
    'sigterm': Fault('SIGTERM', 0, cases, asked(signal.SIGTERM), most_again=0),
    'sigint': Fault('SIGINT', 0, cases, asked(signal.SIGINT), most_again=0),
    'sigint_twice': Fault(
      'SIGINT twice', -signal.SIGINT, cases, _interrupted_twice
    ),
    'disk_full': Fault(
      'disk full', 2, len(_DISKS), _disk_full, 'No space left'
    ),
    'folder_gone': Fault(gone, 2, 3, _folder_gone),
    'folder_read_only': Fault(
      'run directory read-only', 2, 3, _folder_read_only, 'Permission denied'
    ),
    'clock_jumps': Fault('clock jumps', 0, 1, _hooked('clock_jumps', seed=0)),
    'world_nan': Fault('a world goes NaN', 0, 1, _world_nan, lasting=world),
    'worlds_nan': Fault(many, 2, 1, _hooked('worlds_go_nan', **at), 'diverged'),
    'reward_nan': Fault(
      'a reward goes NaN', 2, 1, _hooked('reward_goes_nan', **at), 'not finite'
    ),
  }


def suffer(fault: Fault, folder: pathlib.Path) -> fault_runs.Row:
  """Returns what a fault led to in runs inside a folder."""
  row = fault_runs.Row(fault.title)
  reference = fault_runs.Reference(folder / 'reference', fault.lasting)
  for case in range(fault.runs):
    run = Run(row, folder / str(case), fault.lasting, case, _SEED)
    run.reference = reference
    try:
      for _ in range(fault.times):
        with fault.disturb(run):
          done = run.wait()
          if done.code or not fault.code:  # It may have ended before.
            row.judge(done, fault.code, fault.words)
      run.finish()
    except Skipped as error:
      return fault_runs.Row(fault.title, skipped=str(error))
    finally:
      disk = run.work / 'disk'
      if disk.is_mount():
        subprocess.run(['umount', str(disk)], check=True)
      shutil.rmtree(run.work, ignore_errors=True)
  if row.most_lost > fault.most_again:
    row.problems.append('Iterations were lost.')
  return row


_COLUMNS = (
  'fault | cases:d | explained:d | states=compared:d | different:d | '
  'lost=checkpoints_lost:d | again=most_lost:d'
)


def _has_failed(row: fault_runs.Row) -> bool:
  bad = row.problems or row.different or row.checkpoints_lost
  return bool(bad) or row.explained < row.cases


def main(argv: Sequence[str]) -> int:
  """Runs, prints, writes; returns the exit code."""
  del argv
  out = files.output_file('out', _OUT.value)
  known = faults(_KILLS.value, _CASES.value)
  names = [*known] if _ONLY.value is None else _ONLY.value
  if set(names) - set(known):
    raise ValueError(f'--only: there are {", ".join(known)}.')
  rows = []
  for name in progress_bar.Bar(names, unit='fault'):
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as folder:
      os.chmod(folder, 0o777)  # Of nobody, too.
      rows.append(suffer(known[name], pathlib.Path(folder)))
    common.show(_COLUMNS, vars(rows[-1]))
  common.print_table(_COLUMNS, map(vars, rows))
  for row in rows:
    skipped = [f'skipped: {row.skipped}'] if row.skipped else []
    for text in [*row.problems, *skipped]:
      print(f'{row.fault}: {text}')
  report = {'benchmark': 'faults', 'table': [vars(row) for row in rows]}
  common.write_report(out, {**report, 'kills': _KILLS.value})
  return app.EXIT_UNSOLVED if any(map(_has_failed, rows)) else 0


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
