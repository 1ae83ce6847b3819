"""Trains the PPO of libraries through the shipped adapters.

    python -m benchmarks.learning.adapters --out=adapters.json

Stable-Baselines3's and rsl_rl's PPO with their own networks and, but for a
few, their own hyperparameters: their exploration of 1 rad fells the robot at
once, and 150,000 steps are few. `learning` compares them with all that alike
instead. A return is the mean over the episodes of the training, exploration
and all, that ended within the first and within the last tenth of the steps.
"""

import contextlib
import functools
import io
import sys
from typing import Any, Callable, Mapping, Sequence

from absl import flags
import numpy as np
import torch

from benchmarks import common
from benchmarks.learning import learners
from dmc_multimode.bin import app
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.utils import files

_STEPS = flags.DEFINE_integer('steps', 150_000, 'Environment steps.', 1)
_MODES = flags.DEFINE_string('modes', 'walk_forward', 'A mode set, or modes.')
_WORLDS = flags.DEFINE_integer('num_worlds', 32, 'Worlds of each.', 1)
_SEED = flags.DEFINE_integer('seed', 0, 'Of all randomness.', 0)
_THREADS = flags.DEFINE_integer('threads', common.CORES, 'Of torch.', 1)
_OUT = common.define_out()

_ROLLOUT = 64  # Steps of each world; libraries leave it to their users.
_STD = 0.2  # Radians, at first.
_DISCOUNT, _EPOCHS = 0.97, 10
_SAMPLES = 128  # In a minibatch.
_COLUMNS = (
  '=name | steps:,d | episodes:,d | first=return_first:.3f | '
  'last=return_last:.3f | ratio=ratio:.2f'
)


class RecordedWorlds(batched_env.BatchedImitation):
  """Worlds that remember the normalised returns of their episodes.

  Attributes:
    ends: environment steps at the ends of episodes.
    returns: of these episodes.
  """

  def __init__(self, modes: str, num_worlds: int, seed: int):
    """Builds the worlds of a mode set, or of modes."""
    task = multimode_biped.make_modes_task(modes)
    super().__init__(task, num_worlds, seed)
    self.ends: list[int] = []
    self.returns: list[float] = []

  def step(self, actions: Any) -> batched_env.BatchedTimeStep:
    step = super().step(actions)
    self.returns += step.results.returns.tolist()
    self.ends += [self.steps] * len(step.results.returns)
    return step


def sb3(worlds: RecordedWorlds, steps: int, seed: int) -> None:
  """Learns by Stable-Baselines3's PPO."""
  try:
    import stable_baselines3

    from dmc_multimode.suite.wrappers import stable_baselines3_env
  except ModuleNotFoundError as error:
    raise learners.missing(error) from None
  env = stable_baselines3_env.StableBaselines3VecEnv(worlds)
  model = stable_baselines3.PPO(
    'MlpPolicy',
    env,
    5e-4,  # Learning rate.
    _ROLLOUT,
    _SAMPLES,
    _EPOCHS,
    _DISCOUNT,
    policy_kwargs={'log_std_init': float(np.log(_STD))},
    seed=seed,
    device='cpu',
  )
  model.learn(steps)


def rsl_rl(worlds: RecordedWorlds, steps: int, seed: int) -> None:
  """Learns by rsl_rl's runner."""
  try:
    from rsl_rl import runners

    from dmc_multimode.suite.wrappers import rsl_rl_env
  except ModuleNotFoundError as error:
    raise learners.missing(error) from None
  torch.manual_seed(seed)
  network = {'class_name': 'MLPModel', 'hidden_dims': [64, 64]}
  noise = {'class_name': 'GaussianDistribution', 'init_std': _STD}
  settings = {
    'num_steps_per_env': _ROLLOUT,
    'obs_groups': {'actor': ['policy'], 'critic': ['policy']},
    'algorithm': {
      'class_name': 'PPO',
      'num_learning_epochs': _EPOCHS,
      'num_mini_batches': max(_ROLLOUT * worlds.num_worlds // _SAMPLES, 1),
      'gamma': _DISCOUNT,
      'schedule': 'fixed',
      'entropy_coef': 0.0,
    },
    'actor': {**network, 'distribution_cfg': noise},
    'critic': network,
  }
  env = rsl_rl_env.RslRlVecEnv(worlds)
  with contextlib.redirect_stdout(io.StringIO()):  # It prints a page a rollout.
    runner = runners.OnPolicyRunner(env, settings, device='cpu')
    runner.learn(-(-steps // (_ROLLOUT * worlds.num_worlds)))


LEARNERS: Mapping[str, Callable[[RecordedWorlds, int, int], None]] = {
  'sb3': sb3,
  'rsl_rl': rsl_rl,
}


def row(name: str, worlds: RecordedWorlds) -> common.Row:
  """Returns the first and the last return of a training that is over."""
  ends, returns = np.array(worlds.ends), np.array(worlds.returns)
  tenth = worlds.steps / 10
  first = float(returns[ends <= tenth].mean())
  last = float(returns[ends > worlds.steps - tenth].mean())
  return {
    'name': name,
    'steps': worlds.steps,
    'episodes': len(returns),
    'return_first': first,
    'return_last': last,
    'ratio': last / first,
  }


def main(argv: Sequence[str]) -> None:
  """Trains, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  torch.set_num_threads(_THREADS.value)
  make = functools.partial(RecordedWorlds, _MODES.value, _WORLDS.value)
  rows = []
  for name, learn in LEARNERS.items():
    worlds = make(_SEED.value)
    learn(worlds, _STEPS.value, _SEED.value)
    rows.append(row(name, worlds))
  common.print_table(_COLUMNS, rows)
  report = {
    'benchmark': 'adapters',
    'rows': rows,
    'modes': _MODES.value,
    'num_worlds': _WORLDS.value,
    'seed': _SEED.value,
  }
  common.write_report(out, report, ('rsl-rl-lib', 'stable-baselines3'))


def cli() -> None:
  """Runs the benchmark."""
  app.run(main, sys.argv)


if __name__ == '__main__':
  cli()
