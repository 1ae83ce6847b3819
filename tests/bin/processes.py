"""Runs a binary's command lines in processes that start at once.

Importing a binary takes seconds, and flags are global while binaries share
names of theirs. One process therefore imports it and forks for every command
line: each has flags, signals and an exit code of its own, as a user's would.
So do the ranks of a command line that several processes share.
"""

import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
from typing import NamedTuple

_ROOT = pathlib.Path(__file__).parents[2]
_TIMEOUT = 300  # Seconds after which a command line is killed.

# Takes {args, folder, before, ranks} a line, of each rank its environment
# variables; answers with the processes and, once they have ended, exit codes.
_SERVER = f"""
import json, os, signal, sys, traceback
from dmc_multimode.bin import {{name}} as binary
{{warm_up}}
for line in sys.stdin:
  request, children = json.loads(line), []
  for rank, variables in enumerate(request['ranks']):
    children.append(os.fork())
    if children[-1]:
      continue
    signal.alarm({_TIMEOUT})
    os.chdir(request['folder'])
    os.environ.update(variables)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, name in ((1, 'stdout'), (2, 'stderr')):
      path = os.path.join(request['folder'], name + str(rank))
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
  print(*children, flush=True)
  status = [os.waitpid(child, 0)[1] for child in children]
  print(*map(os.waitstatus_to_exitcode, status), flush=True)
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

  def start(self, *args: str, before: str = '', ranks: int = 1) -> int:
    """Starts it; returns the process, the first of several.

    Args:
      *args: its command line.
      before: code that is run first, in which the module is `binary`.
      ranks: processes that work together, with the variables of `torchrun`.
    """
    request = {
      'args': args,
      'folder': str(self._folder),
      'before': before,
      'ranks': _variables(ranks),
    }
    assert self._server.stdin
    print(json.dumps(request), file=self._server.stdin, flush=True)
    return int(self._answer().split()[0])

  def wait(self) -> Done:
    """Waits for what `start` has started; of ranks, adds up what they say."""
    codes = [int(code) for code in self._answer().split()]
    read = lambda name: ''.join(
      (self._folder / f'{name}{rank}').read_text() for rank in range(len(codes))
    )
    return Done(max(codes, key=abs), read('stdout'), read('stderr'))

  def __call__(self, *args: str, before: str = '', ranks: int = 1) -> Done:
    """Runs a command line: see `start`."""
    self.start(*args, before=before, ranks=ranks)
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


def _variables(ranks: int) -> list[dict[str, str]]:
  """Returns what `torchrun` would tell each rank; of one alone, nothing."""
  if ranks == 1:
    return [{}]
  with socket.socket() as server:
    server.bind(('127.0.0.1', 0))
    port = server.getsockname()[1]
  shared = {'MASTER_ADDR': '127.0.0.1', 'MASTER_PORT': str(port)}
  shared |= dict.fromkeys(('WORLD_SIZE', 'LOCAL_WORLD_SIZE'), str(ranks))
  each = ('RANK', 'LOCAL_RANK')
  return [shared | dict.fromkeys(each, str(rank)) for rank in range(ranks)]


def send(process: int, number: signal.Signals) -> None:
  """Sends a signal."""
  os.kill(process, number)
