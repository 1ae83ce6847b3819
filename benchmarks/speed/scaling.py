"""Measures training in one, two, ... processes on this machine.

    python -m benchmarks.speed.scaling --processes=1,2 --out=scaling.json

Every count trains the same task under `torchrun` with the same number of cores
in all, or, with --cores_each, with so many for each process. Speed is the mean
over the rows that a run logs after its first. The machine must be idle.

Then, on paper, the same for many nodes: the bytes that each rank sends in an
iteration follow from the network and the number of minibatches, and the time of
a reduction from the network's bandwidth and latency. See docs/SCALING.md.
"""

import functools
import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any, Sequence

from absl import flags
import numpy as np

from benchmarks import common
from dmc_multimode.agents.ppo import networks
from dmc_multimode.bin import app
from dmc_multimode.experiments import config as run_config
from dmc_multimode.utils import files

_PROCESSES = flags.DEFINE_list('processes', ['1', '2'], 'How many, in turn.')
_STEPS = flags.DEFINE_integer('steps', 400_000, 'Control steps of each run.', 1)
_CORES_EACH = flags.DEFINE_integer(
  'cores_each', 0, 'Threads of each process; 0 to share all cores.', 0
)
_MODEL_ONLY = flags.DEFINE_bool('model_only', False, 'Measure nothing.')
_OUT = common.define_out()
# Of the model.
_NODES = flags.DEFINE_list('nodes', ['1', '2', '10', '100'], 'Of the model.')
_NODE_SPEED = flags.DEFINE_float(
  'node_speed', 9000.0, 'Control steps per second of one node alone.'
)
_LATENCY = flags.DEFINE_float('latency', 50e-6, 'Of a message, seconds.')
_BANDWIDTH = flags.DEFINE_float('bandwidth', 1.25e9, 'Of a link, bytes/s.')

common.define_run_flags()

_FLOAT = 4  # Bytes.
_REDUCTIONS_BESIDES = 16  # Small ones in an iteration: statistics, agreements.
_LATENT, _STATE, _PRIVILEGED, _ACTIONS = 4, 33, 13, 10  # Sizes, with 4 latents.

_MEASURED = 'processes:d | steps/s=speed:.0f | spread:.0f | ratio:.2f'
_MODEL = (
  'nodes:d | worlds | MB sent=megabytes:.2f | work s=work_seconds:.4f | '
  'talk s=talk_seconds:.4f | steps/s=steps_per_second:.0f | efficiency:.2f'
)


def _train(processes: int, folder: pathlib.Path) -> np.ndarray:
  """Trains; returns the speeds that were logged, control steps per second."""
  threads = _CORES_EACH.value or max(common.CORES // processes, 1)
  run_dir = folder / str(processes)
  command = [
    sys.executable,
    *('-m', 'torch.distributed.run', '--standalone'),
    f'--nproc_per_node={processes}',
    *('-m', 'dmc_multimode.bin.train', f'--run_dir={run_dir}', '--one_hot'),
    f'--steps={_STEPS.value}',
    f'--threads={threads}',
    *_given_run_flags(),
  ]
  done = subprocess.run(
    command, capture_output=True, text=True, env=os.environ, check=False
  )
  if done.returncode:
    raise ValueError(f'{processes} processes: {done.stderr[-2000:]}')
  speeds = np.genfromtxt(run_dir / 'metrics.csv', delimiter=',', names=True)
  found = np.atleast_1d(speeds['steps_per_second'])[1:]
  if not len(found):
    raise ValueError('--steps are too few for two rows in the log.')
  return found


def _given_run_flags() -> list[str]:
  """Returns what of this command line is of the training."""
  parts, always = ('ppo_', 'sampling_', 'task_'), ('modes', 'num_worlds')
  return [
    flags.FLAGS[name].serialize()
    for name in flags.FLAGS
    if name in always or (name.startswith(parts) and flags.FLAGS[name].present)
  ]


def parameters(hidden_sizes: tuple[int, ...]) -> dict[str, int]:
  """Returns how many numbers of each part are reduced a minibatch."""
  network = networks.ActorCritic(
    _LATENT + _STATE,
    _ACTIONS,
    hidden_sizes,
    privileged_size=_PRIVILEGED,
  )
  count = lambda part: sum(p.numel() for p in part.parameters())
  value = count(network.value)
  return {'policy': count(network) - value, 'value': value}


def model(nodes: int, config: Any, worlds: int) -> common.Row:
  """Returns what an iteration costs in so many nodes, one rank each.

  A ring reduces n bytes in 2 (N - 1) messages of n / N bytes each; `worlds` are
  those of all nodes.
  """
  sizes = parameters(config.hidden_sizes)
  count = config.epochs * config.minibatches
  sent = 2 * (nodes - 1) / nodes * _FLOAT * count * sum(sizes.values())
  # Policy and value are fitted at the same time: messages of one wait for none
  # of the other, but both share the link.
  messages = 2 * (nodes - 1) * (count + _REDUCTIONS_BESIDES)
  talk = messages * _LATENCY.value + sent / _BANDWIDTH.value
  steps = worlds * config.rollout_length
  work = steps / nodes / _NODE_SPEED.value
  return {
    'nodes': nodes,
    'worlds': worlds,
    'megabytes': sent / 1e6,
    'work_seconds': work,
    'talk_seconds': talk,
    'steps_per_second': steps / (work + talk),
    'efficiency': work / (work + talk),
  }


def _numbers(flag: flags.FlagHolder[list[str]]) -> list[int]:
  try:
    values = [int(value) for value in flag.value]
  except ValueError as error:
    raise ValueError(f'--{flag.name}: {error}.') from error
  if not values or min(values) < 1:
    raise ValueError(f'--{flag.name} must be positive.')
  return values


def _measure() -> list[common.Row]:
  rows: list[common.Row] = []
  with tempfile.TemporaryDirectory() as folder:
    for processes in _numbers(_PROCESSES):
      speeds = _train(processes, pathlib.Path(folder))
      row = {'processes': processes, 'speed': float(speeds.mean())}
      basis = rows[0]['speed'] if rows else row['speed']
      row |= {'spread': float(speeds.std()), 'ratio': row['speed'] / basis}
      rows.append(row)
  common.print_table(_MEASURED, rows)
  return rows


def _compute(config: run_config.RunConfig) -> list[common.Row]:
  """Strong scaling, with the worlds given; and weak, with as many a node."""
  ppo, sizes = config.ppo, parameters(config.ppo.hidden_sizes)
  print(
    f'\nOn paper: {sizes["policy"]:,} parameters of the policy and '
    f'{sizes["value"]:,} of the value; {ppo.epochs} x {ppo.minibatches} '
    'minibatches an iteration'
  )
  rows = [
    model(nodes, ppo, config.num_worlds * (nodes if is_weak else 1))
    for is_weak in (False, True)
    for nodes in _numbers(_NODES)
  ]
  common.print_table(_MODEL, rows)
  return rows


def main(argv: Sequence[str]) -> None:
  """Measures, computes, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  config = common.configured()
  print(common.describe(config))
  measured = [] if _MODEL_ONLY.value else _measure()
  report = {'measured': measured, 'model': _compute(config)}
  common.write_report(out, {'benchmark': 'scaling', **report})


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
