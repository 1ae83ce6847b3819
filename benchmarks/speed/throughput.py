r"""Environment steps per second: raw physics, both engines, the whole PPO loop.

    python -m benchmarks.speed.throughput --modes=pi2 --out=throughput.json
    python -m benchmarks.speed.throughput --robot=go1 --modes=quadruped \
      --only_worlds

Everything is measured in turns, round after round, and compared with the raw
physics of the same round: noise of the machine hits all alike. Raw physics
steps the very states and controls that BatchedImitation steps right after it.
All act at random around standing, as a training begins; PPO learns with its
defaults. With --policy=NAME, what is trained by then acts, explores and learns
on, as most of a training goes; the Composer task is left out.
"""

import contextlib
import cProfile
import dataclasses
import functools
import pathlib
import pstats
import time
from typing import Any, Callable, Sequence

from absl import flags
from mujoco import batch as mujoco_batch
import numpy as np
import torch

from benchmarks import common
import dmc_multimode
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import acting
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

_POLICY = config_flags.define_path(
  'policy', None, 'A policy that acts, by name or folder; --modes must be its.'
)
_ROBOT = config_flags.define_path(
  'robot', None, 'A robot, by file or name; --modes must be for its feet.'
)
_ROUNDS = flags.DEFINE_integer('rounds', 5, 'Medians are over these.', 1)
_SECONDS = flags.DEFINE_float(
  'seconds', 3.0, 'Of each measurement in a round.', lower_bound=0.01
)
_OUT = common.define_out()
_ONLY_WORLDS = flags.DEFINE_bool(
  'only_worlds', False, 'Measure raw physics and BatchedImitation alone.'
)
_PROFILE = flags.DEFINE_enum(
  'profile',
  None,
  ['environment', 'loop'],
  'Show where the time of BatchedImitation, or of the PPO loop, goes instead.',
)
common.define_run_flags()

_ACTION_STD = 0.2  # Radians around the standing action.
_BURN_IN = 50  # Control steps until episodes end at all times.
_LEAST_SHARE = 0.1  # Percent of a step that the profile shows.

_RAW, _BATCHED = 'raw Batch.step', 'BatchedImitation'
_COMPOSER, _ASYNC = 'Composer', 'AsyncVectorEnv'
_PPO = 'PPO loop'

_COLUMNS = (
  'control steps per second=name | median=steps_per_second:,.0f | '
  'to raw=ratio_to_raw:.3f | in the rounds=ratio_range:.3f'
)

# Runs for that many seconds; returns environment steps per second by name.
Measure = Callable[[float], dict[str, float]]


class _Worlds:
  """BatchedImitation, and its physics alone on the same states."""

  def __init__(self, config: run_config.RunConfig):
    run = _build(config)
    self.environment = run.environment
    self._actor = acting.BatchedActor(run.network, config.seed)
    self._draw = _draw_around(self.environment, config.seed)
    self._ctrl = self.environment.physics.batch.bind('ctrl')
    self._observation = self.environment.reset()
    for _ in range(_BURN_IN):
      self.step(self.draw())

  def draw(self) -> np.ndarray:
    """Returns actions for all worlds."""
    if _POLICY.value:
      return self._actor.sample(torch.from_numpy(self._observation))[0].numpy()
    return self._draw(self.environment.num_worlds)

  def step(self, actions: np.ndarray) -> None:
    """Steps the environment."""
    self._observation = self.environment.step(actions).observation

  def measure(self, seconds: float) -> dict[str, float]:
    """Steps raw, puts the states back, steps the environment; and so on."""
    spent, steps = {_RAW: 0.0, _BATCHED: 0.0}, 0
    batch = self.environment.physics.batch
    while min(spent.values()) < seconds:
      actions, rows = self.draw(), batch.state.copy()
      self._ctrl[:] = actions
      spent[_RAW] += _time(self._step_raw)
      batch.state[:] = rows
      spent[_BATCHED] += _time(functools.partial(self.step, actions))
      steps += self.environment.num_worlds
    return {name: steps / seconds for name, seconds in spent.items()}

  def _step_raw(self) -> None:
    with contextlib.suppress(mujoco_batch.SimulationError):
      self.environment.physics.batch.step(
        nstep=self.environment.config.substeps
      )


def _draw_around(environment: Any, seed: int) -> Callable[..., np.ndarray]:
  """Returns what draws random actions around standing, [*shape, A]."""
  standing = environment.standing_action()
  random_state = np.random.RandomState(seed)
  return lambda *shape: (
    standing
    + _ACTION_STD * random_state.standard_normal((*shape, len(standing)))
  )


def _composer(
  config: run_config.RunConfig,
  draw: Callable[..., np.ndarray],
  stack: contextlib.ExitStack,
) -> Measure:
  """Returns what steps the Composer task in a loop."""
  environment = multimode_biped.imitation(
    config.modes, random=config.seed, config=config.task
  )
  stack.callback(environment.close)
  timestep = [environment.reset()]

  def step() -> None:
    if timestep[0].last():
      environment.reset()
    timestep[0] = environment.step(draw())

  return lambda seconds: {_COMPOSER: _rate(step, 1, seconds)}


def _processes(
  config: run_config.RunConfig,
  draw: Callable[..., np.ndarray],
  stack: contextlib.ExitStack,
) -> Measure:
  """Returns what steps Gymnasium's AsyncVectorEnv, a process a thread."""
  from gymnasium import vector

  from dmc_multimode.suite.wrappers import gymnasium_env

  make = lambda: gymnasium_env.GymnasiumEnv(
    multimode_biped.imitation(config.modes, config=config.task)
  )
  # Forked children would inherit the locks of our threads.
  environments = vector.AsyncVectorEnv(
    [make] * config.threads,
    context='spawn',
    autoreset_mode=vector.AutoresetMode.SAME_STEP,
  )
  stack.callback(environments.close)
  environments.reset(seed=config.seed)
  count = environments.num_envs
  step = lambda: environments.step(draw(count).astype(np.float32))
  return lambda seconds: {_ASYNC: _rate(step, count, seconds)}


def _iterations(config: run_config.RunConfig) -> Callable[[], None]:
  """Returns what acts, steps and learns once."""
  loop = _build(config).loop

  def iterate() -> None:
    length = runner.TrainingConfig(steps=loop.steps + 1)
    loop.run(length, loggers.Dispatcher([]), save=lambda: None)

  iterate()  # The first one allocates.
  return iterate


def _time(function: Callable[[], Any]) -> float:
  """Returns the seconds that a call takes."""
  began = time.perf_counter()
  function()
  return time.perf_counter() - began


def _rate(step: Callable[[], Any], count: int, seconds: float) -> float:
  """Returns control steps per second, `count` of them a call."""
  calls, began, now = 0, time.perf_counter(), 0.0
  while now < seconds:
    step()
    calls, now = calls + 1, time.perf_counter() - began
  return calls * count / now


def _build(config: run_config.RunConfig) -> setup.Run:
  height = config.task.robot.stand_height
  mode_set = library.mode_set(config.modes, stand_height=height)
  if not _POLICY.value:
    return setup.build(config, mode_set)
  trained = policy_lib.load(_POLICY.value)
  if trained.mode_set.names != mode_set.names:
    raise ValueError(
      f'--policy knows {trained.mode_set.names}: pass them as --modes.'
    )
  extra = trained.config.extra_observations  # Its weights are made for them.
  task = dataclasses.replace(config.task, extra_observations=extra)
  run = setup.build(dataclasses.replace(config, task=task), trained.mode_set)
  run.network.load_state_dict(trained.network.state_dict())
  return run


def compare(config: run_config.RunConfig) -> list[common.Row]:
  """Measures all contenders in turns; returns the rows of the table."""
  rates: dict[str, list[float]] = {}
  with contextlib.ExitStack() as stack:
    worlds = _Worlds(config)
    samples = config.num_worlds * config.ppo.rollout_length
    contenders: list[Measure] = [worlds.measure]
    if not (_POLICY.value or _ONLY_WORLDS.value):
      contenders += [
        make(config, _draw_around(worlds.environment, config.seed), stack)
        for make in (_composer, _processes)
      ]
    if not _ONLY_WORLDS.value:
      iterate = _iterations(config)
      contenders.append(lambda s: {_PPO: _rate(iterate, samples, s)})
    for _ in progress_bar.Bar(range(_ROUNDS.value), unit='round'):
      for measure in contenders:
        for name, rate in measure(_SECONDS.value).items():
          rates.setdefault(name, []).append(rate)
  rows = []
  for name, found in rates.items():
    ratios = np.array(found) / rates[_RAW]
    row = {'name': name, 'steps_per_second': float(np.median(found))}
    row['ratio_to_raw'] = float(np.median(ratios))
    rows.append(row | {'ratio_range': [ratios.min(), ratios.max()]})
  return rows


def profile(config: run_config.RunConfig) -> list[common.Row]:
  """Returns what share of a step, or of an iteration, each function takes.

  Only the calling thread is seen, and that it waits for others.
  """
  profiler = cProfile.Profile()
  once: Callable[[], Any]
  if _PROFILE.value == 'loop':
    once = functools.partial(profiler.runcall, _iterations(config))
  else:
    worlds = _Worlds(config)
    once = lambda: profiler.runcall(worlds.step, worlds.draw())
  _rate(once, 1, _SECONDS.value)
  stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
  ours = (
    str(pathlib.Path(dmc_multimode.__file__).parent),
    mujoco_batch.__file__,
  )
  found = [
    (f'{pathlib.Path(file).stem}.{function}', cumulative)
    for (file, _, function), (*_, cumulative, _) in stats.items()
    if file.startswith(ours)
  ]
  total = max(seconds for _, seconds in found)
  rows = [{'name': name, 'percent': 100 * s / total} for name, s in found]
  rows.sort(key=lambda row: -row['percent'])
  return [row for row in rows if row['percent'] >= _LEAST_SHARE]


def main(argv: Sequence[str]) -> None:
  """Measures, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  config = common.configured(_ROBOT.value)
  print(common.describe(config))
  if _PROFILE.value:
    rows = profile(config)
    columns = f'{_PROFILE.value}=name | percent:.2f'
    common.print_table(columns, rows)
  else:
    rows = compare(config)
    common.print_table(_COLUMNS, rows)
    ratios = {row['name']: row['ratio_to_raw'] for row in rows}
    if _ASYNC in ratios:
      ratio = ratios[_BATCHED] / ratios[_ASYNC]
      print(f'{_BATCHED} to {_ASYNC}: {ratio:.1f}')
  report = {'benchmark': 'throughput', 'table': rows, 'seed': config.seed}
  for flag in (_POLICY, _ROUNDS, _SECONDS):
    report[flag.name] = flag.value
  report['config'] = run_config.to_dict(config)
  common.write_report(out, report, ['gymnasium'])


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
