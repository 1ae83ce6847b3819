"""Trainings that start at once, so that hundreds of them can be disturbed.

One process imports the binary and forks for every command line: each has
flags, signals and an exit code of its own, as a user's would. What a child is
to suffer by itself are `fault_hooks`, put in place right after the fork.
"""

import importlib
import json
import os
import pathlib
import re
import select
import signal
import subprocess
import sys
import time
import traceback
from typing import Any, Mapping, NamedTuple

_ROOT = pathlib.Path(__file__).parents[2]
# The command itself is under test here, and is named as a user would name it.
_COMMAND = 'dmc_multimode.bin.train'
_TIMEOUT = 300  # Seconds after which a child is ended.
# The progress line, and MuJoCo's word on a world that diverges.
_EXPECTED = re.compile(r'%\||step/s|^W.*The simulation is unstable')
_POLL = 0.002  # Seconds between looks at a child.


class Done(NamedTuple):
  """What a command line led to.

  Attributes:
    code: exit code; that of a signal is negative.
    stdout: what it printed.
    errors: the lines on stderr that are no progress line, nor MuJoCo's warning
      of a state that is not finite.
    seconds: from its start to its end.
  """

  code: int
  stdout: str
  errors: tuple[str, ...]
  seconds: float

  def unexplained(self, code: int) -> str:
    """Says what is wrong with the end that was to have that exit code."""
    if self.code != code:
      return f'exit code {self.code}, not {code}: {" ".join(self.errors)}'
    wanted = 1 if code > 0 else 0
    told = [line for line in self.errors if line.startswith('error: ')]
    if len(told) != wanted or len(self.errors) != wanted:
      return f'stderr: {" / ".join(self.errors)}'
    return ''


class Trainings:
  """Runs `dmc_multimode.bin.train`, one command line at a time."""

  def __init__(self, folder: pathlib.Path):
    """Imports it; what children print goes into `folder`."""
    self._folder = folder
    self._server = subprocess.Popen(
      [sys.executable, '-m', 'benchmarks.reliability.fault_process'],
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      text=True,
      cwd=_ROOT,
    )
    self._began = 0.0
    self._answer()  # It is ready.

  def start(
    self, args: tuple[str, ...], hooks: Mapping[str, Mapping[str, Any]]
  ) -> int:
    """Starts one; returns the process.

    Args:
      args: its flags.
      hooks: functions of `fault_hooks` and their arguments.
    """
    request = {'args': args, 'hooks': hooks, 'folder': str(self._folder)}
    assert self._server.stdin
    print(json.dumps(request), file=self._server.stdin, flush=True)
    self._began = time.monotonic()
    return int(self._answer())

  def is_running(self, seconds: float = _POLL) -> bool:
    """Waits that long; returns whether the child has not ended by then."""
    assert self._server.stdout
    return not select.select([self._server.stdout], [], [], seconds)[0]

  def wait(self) -> Done:
    """Waits for the end of what was started."""
    code = int(self._answer())
    seconds = time.monotonic() - self._began
    stdout, stderr = (
      (self._folder / name).read_text(encoding='utf-8', errors='replace')
      for name in ('stdout', 'stderr')
    )
    lines = stderr.replace('\r', '\n').splitlines()
    errors = tuple(x for x in lines if x.strip() and not _EXPECTED.search(x))
    return Done(code, stdout, errors, seconds)

  def run(
    self,
    args: tuple[str, ...],
    hooks: Mapping[str, Mapping[str, Any]],
  ) -> Done:
    """Starts one and waits for its end."""
    self.start(args, hooks)
    return self.wait()

  def close(self) -> None:
    """Ends the process that forks."""
    assert self._server.stdin and self._server.stdout
    self._server.stdin.close()
    self._server.stdout.close()
    self._server.wait()

  def _answer(self) -> str:
    assert self._server.stdout
    answer = self._server.stdout.readline()
    if not answer:
      raise RuntimeError('The process that starts trainings has died.')
    return answer


def _warm_up() -> None:
  """Imports what is imported late, and compiles a model."""
  from tensorboard.compat.proto import event_pb2  # noqa: F401
  from tensorboard.summary.writer import record_writer  # noqa: F401
  import torch

  from dmc_multimode.modes import library
  from dmc_multimode.suite import multimode_biped
  from dmc_multimode.suite.imitation import batched_env

  torch.optim.Adam([torch.zeros(1)])
  task = multimode_biped.make_task(library.mode_set('idle'))
  batched_env.BatchedImitation(task, 1, 0, 1)


def _child(request: Mapping[str, Any]) -> int:
  """Runs a command line in this process; returns its exit code."""
  from benchmarks.reliability import fault_hooks

  train = importlib.import_module(_COMMAND)
  signal.alarm(_TIMEOUT)
  os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
  for number, name in ((1, 'stdout'), (2, 'stderr')):
    path = os.path.join(request['folder'], name)
    os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
  sys.argv = ['train', *request['args']]
  try:
    for name, values in request['hooks'].items():
      getattr(fault_hooks, name)(**values)
    train.cli()
  except SystemExit as error:
    return int(error.code or 0)
  except BaseException:  # As the interpreter would.
    traceback.print_exc()
    return 1
  return 0


def main() -> None:
  """Forks for every line that comes in."""
  importlib.import_module(_COMMAND)
  _warm_up()
  print('ready', flush=True)
  for line in sys.stdin:
    pid = os.fork()
    if not pid:
      code = _child(json.loads(line))
      sys.stdout.flush()
      sys.stderr.flush()
      os._exit(code)  # To take down what was imported takes a second.
    print(pid, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


if __name__ == '__main__':
  main()
