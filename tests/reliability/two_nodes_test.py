"""Two nodes that share nothing but a network cable train one network.

The nodes are network namespaces of this machine, which takes root and Debian's
iproute2; without, they share its network. Each has a disk of its own, too: only
that of rank 0 is written to.
"""

import os
import pathlib
import signal
import socket
import subprocess
import sys
import time
from typing import Iterator, NamedTuple

import pytest

from tests.bin import processes

_ROOT = pathlib.Path(__file__).parents[2]
_TIMEOUT = 300  # Seconds.
_ADDRESSES = ('10.77.0.1', '10.77.0.2')
_FLAGS = (
  *('--steps=3200', '--threads=1', '--num_worlds=8', '--one_hot'),
  *('--modes=idle,walk_forward', '--ppo_rollout_length=4'),
  *('--ppo_hidden_sizes=16', '--ppo_epochs=1', '--ppo_minibatches=1'),
)
# Trains; every node also notes its process, and what it has learned. The file
# has no metadata, whose order is drawn anew by every process.
_NODE = """
import os, pathlib, runpy, sys
import safetensors.torch
from dmc_multimode.agents import runner
folder, node = pathlib.Path(sys.argv.pop(1)), os.environ['NODE']
(folder / f'pid{node}').write_text(str(os.getpid()))
run = runner.TrainingLoop.run
def run_and_note(self, *args, **kwargs):
  run(self, *args, **kwargs)
  weights = self._learner.network.state_dict()
  safetensors.torch.save_file(weights, folder / f'network{node}')
runner.TrainingLoop.run = run_and_note
runpy.run_module('dmc_multimode.bin.train', run_name='__main__')
"""


class _Node(NamedTuple):
  """Begin of its command lines, its address, and whose that is."""

  command: tuple[str, ...]
  address: str
  interface: str


def _ip(*words: str) -> None:
  subprocess.run(['ip', *words], check=True, capture_output=True)


@pytest.fixture
def nodes() -> Iterator[list[_Node]]:
  """Network namespaces with a cable between them, where they can be made."""
  names = [f'dmc{os.getpid()}{end}' for end in 'ab']
  ends = [['cable', 'netns', name] for name in names]
  try:
    for name in names:
      _ip('netns', 'add', name)
      _ip('-n', name, 'link', 'set', 'lo', 'up')
    _ip('link', 'add', *ends[0], 'type', 'veth', 'peer', *ends[1])
    for name, address in zip(names, _ADDRESSES, strict=True):
      _ip('-n', name, 'addr', 'add', f'{address}/24', 'dev', 'cable')
      _ip('-n', name, 'link', 'set', 'cable', 'up')
    yield [
      _Node(('ip', 'netns', 'exec', name), address, 'cable')
      for name, address in zip(names, _ADDRESSES, strict=True)
    ]
  except (OSError, subprocess.CalledProcessError):
    yield 2 * [_Node((), '127.0.0.1', 'lo')]
  finally:
    for name in names:
      subprocess.run(['ip', 'netns', 'del', name], capture_output=True)


def _start(
  number: int, node: _Node, endpoint: str, folder: pathlib.Path
) -> subprocess.Popen[bytes]:
  """Starts one rank on a node; its output goes to a log."""
  script = folder / 'node.py'
  script.write_text(_NODE)
  # is_host, local_addr: both nodes have the name of this machine, which tells
  # them nothing. TORCH_DISABLE_...: restarts hang without in torch 2.13.
  return subprocess.Popen(
    [
      *(*node.command, sys.executable, '-m', 'torch.distributed.run'),
      *('--nnodes=2', '--nproc_per_node=1', '--max_restarts=3'),
      *('--rdzv_backend=c10d', '--rdzv_id=two_nodes'),
      f'--rdzv_endpoint={endpoint}',
      f'--rdzv_conf=is_host={1 - number}',
      f'--local_addr={node.address}',
      *(str(script), str(folder), f'--run_dir={folder / "run"}', *_FLAGS),
    ],
    stdout=open(folder / f'log{number}', 'wb'),
    stderr=subprocess.STDOUT,
    env={
      **os.environ,
      'NODE': str(number),
      'PYTHONPATH': str(_ROOT),
      'GLOO_SOCKET_IFNAME': node.interface,
      'TORCH_DISABLE_SHARE_RDZV_TCP_STORE': '1',
      'OMP_NUM_THREADS': '1',
    },
  )


def _wait_for_rows(path: pathlib.Path) -> None:
  deadline = time.monotonic() + _TIMEOUT
  while not (path.exists() and path.stat().st_size):
    assert time.monotonic() < deadline
    time.sleep(0.05)


@pytest.mark.slow
def test_two_nodes_hold_one_network(
  nodes: list[_Node], tmp_path: pathlib.Path
) -> None:
  """Although one dies on the way, with a checkpoint behind it or none."""
  with socket.socket() as server:
    server.bind(('127.0.0.1', 0))
    endpoint = f'{nodes[0].address}:{server.getsockname()[1]}'
  started = [
    _start(i, node, endpoint, tmp_path) for i, node in enumerate(nodes)
  ]
  try:
    _wait_for_rows(tmp_path / 'run' / 'metrics.csv')
    processes.send(int((tmp_path / 'pid1').read_text()), signal.SIGKILL)
    codes = [process.wait(_TIMEOUT) for process in started]
  finally:
    for process in started:
      process.terminate()
  logs = [(tmp_path / f'log{i}').read_text() for i in range(2)]
  assert codes == [0, 0], '\n'.join(logs)[-3000:]
  first, second = ((tmp_path / f'network{i}').read_bytes() for i in range(2))
  assert first == second
