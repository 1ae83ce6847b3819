"""The same bits? Physics and training at several thread counts, twice each.

    python -m benchmarks.reliability.fault_threads

Every row is a process of its own: so equal hashes also mean that a restart
changes nothing. `physics` is a hash of all states that random actions lead to
in 64 worlds; `training` one of everything that a checkpoint holds after some
iterations of a network of the default size.
"""

import subprocess
import sys

import numpy as np
import torch

from benchmarks.reliability import fault_hooks
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set

_THREADS = (1, 2, 4)
_REPEATS = 2
_MODES = 'idle,walk_forward,launch'
_WORLDS, _STEPS, _ITERATIONS = 64, 60, 3


def _build(threads: int) -> setup.Run:
  config = setup.RunConfig(
    modes=_MODES, num_worlds=_WORLDS, threads=threads, one_hot=True
  )
  config = setup.RunConfig(
    **{
      **{name: getattr(config, name) for name in config.__dataclass_fields__},
      'ppo': type(config.ppo)(symmetry='none'),
    }
  )
  return setup.build(config, mode_set.one_hot(library.resolve(_MODES)))


def physics(threads: int) -> str:
  """Returns a hash of what random actions lead to."""
  worlds, random = _build(threads).environment, np.random.RandomState(0)
  seen = [worlds.reset()]
  for _ in range(_STEPS):
    action = worlds.standing_action() + random.uniform(-0.4, 0.4, (_WORLDS, 10))
    step = worlds.step(action)
    seen += [step.observation, step.reward.astype(np.float32)[:, None]]
  return fault_hooks.digest(
    {'seen': np.concatenate(seen, axis=1), **worlds.state()}
  )


def train(threads: int) -> str:
  """Returns a hash of a training's state."""
  loop = _build(threads).loop
  steps = _ITERATIONS * _WORLDS * setup.RunConfig().ppo.rollout_length
  config = runner.TrainingConfig(steps=steps)
  loop.run(config, loggers.Dispatcher([]), lambda: None)
  return fault_hooks.digest(loop.state()[0])


def main() -> None:
  """Prints the table, a process a row."""
  if len(sys.argv) > 1:
    threads = int(sys.argv[1])
    print(physics(threads), train(threads), torch.get_num_threads())
    return
  print(f'{"threads":8}{"of torch":>9}  {"physics":18}{"training":18}')
  for threads in _THREADS:
    for _ in range(_REPEATS):
      done = subprocess.run(
        [
          sys.executable,
          '-m',
          'benchmarks.reliability.fault_threads',
          str(threads),
        ],
        check=True,
        capture_output=True,
        text=True,
      )
      found, trained, of_torch = done.stdout.split()
      print(
        f'{threads:<8}{of_torch:>9}  {found:18}{trained:18}',
        flush=True,
      )


if __name__ == '__main__':
  main()
