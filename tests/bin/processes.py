"""Runs a binary's command lines in processes that start at once.

Importing a binary takes seconds, and flags are global while binaries share
names of theirs. One process therefore imports it and forks for every command
line: each has flags, signals and an exit code of its own, as a user's would.
"""

import json
import os
import pathlib
import signal
import subprocess
import sys
from typing import NamedTuple

_ROOT = pathlib.Path(__file__).parents[2]
_TIMEOUT = 300  # Seconds after which a command line is killed.

# Takes {args, folder, before} a line; answers with the process and, once it
# has ended, with its exit code.
_SERVER = f"""
import json, os, signal, sys, traceback
from dmc_multimode.bin import {{name}} as binary
{{warm_up}}
for line in sys.stdin:
  request = json.loads(line)
  pid = os.fork()
  if not pid:
    signal.alarm({_TIMEOUT})
    os.chdir(request['folder'])
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, name in ((1, 'stdout'), (2, 'stderr')):
      path = os.path.join(request['folder'], name)
      os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.argv = ['{{name}}', *request['args']]
    try:
      exec(request['before'])
      binary.cli()
    except SystemExit as error:
      code = error.code or 0
    except BaseException:
      traceback.print_exc()
      code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # To take down what was imported takes a second.
  print(pid, flush=True)
  print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


class Done(NamedTuple):
  """Result of a command line; a negative code is that of a signal."""

  code: int
  stdout: str
  stderr: str

  @property
  def error(self) -> str:
    """The only line on stderr, which must be an error's."""
    (line,) = self.stderr.splitlines()
    assert line.startswith('error: '), line
    return line


class Binary:
  """The binary `dmc_multimode.bin.NAME`, one command line at a time."""

  def __init__(
    self, name: str, folder: pathlib.Path, warm_up: str = ''
  ) -> None:
    """Imports it.

    Args:
      name: of the binary.
      folder: for its output.
      warm_up: code that is run once.
    """
    self._folder = folder
    self._server = subprocess.Popen(
      [sys.executable, '-c', _SERVER.format(name=name, warm_up=warm_up)],
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      text=True,
      cwd=_ROOT,
    )

  def start(self, *args: str, before: str = '') -> int:
    """Starts it; returns the process.

    Args:
      *args: its command line.
      before: code that is run first, in which the module is `binary`.
    """
    request = {'args': args, 'folder': str(self._folder), 'before': before}
    assert self._server.stdin
    print(json.dumps(request), file=self._server.stdin, flush=True)
    return int(self._answer())

  def wait(self) -> Done:
    """Waits for what `start` has started."""
    code = int(self._answer())
    texts = [(self._folder / n).read_text() for n in ('stdout', 'stderr')]
    return Done(code, *texts)

  def __call__(self, *args: str) -> Done:
    """Runs a command line."""
    self.start(*args)
    return self.wait()

  def close(self) -> None:
    """Ends the process."""
    assert self._server.stdin and self._server.stdout
    self._server.stdin.close()
    self._server.stdout.close()
    self._server.wait()

  def _answer(self) -> str:
    assert self._server.stdout
    answer = self._server.stdout.readline()
    assert answer, 'the process has died'
    return answer


def send(process: int, number: signal.Signals) -> None:
  """Sends a signal."""
  os.kill(process, number)


def torchrun(ranks: int, *flags: str) -> tuple[str, ...]:
  """Returns what comes after `python` to start so many ranks on one machine."""
  return (
    '-m',
    'torch.distributed.run',
    '--standalone',
    f'--nproc_per_node={ranks}',
    *flags,
  )


def run_ranks(module: str, *args: str) -> Done:
  """Runs a command line in two processes that work together."""
  done = subprocess.run(
    [sys.executable, *torchrun(2), '-m', module, *args],
    capture_output=True,
    text=True,
    cwd=_ROOT,
    timeout=_TIMEOUT,
    check=False,
  )
  return Done(done.returncode, done.stdout, done.stderr)
