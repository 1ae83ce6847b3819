"""Environment steps per second: raw physics, both engines, the whole PPO loop.

    python -m benchmarks.speed.throughput --modes=pi2 --out=throughput.json

Everything is measured in turns, round after round, and compared with the raw
physics of the same round: noise of the machine hits all alike. Raw physics
steps the very states and controls that BatchedImitation steps right after it.
All act at random around standing, as a training begins; PPO learns with its
defaults. With --policy=NAME, what is trained by then acts, explores and learns
on, as most of a training goes; the Composer task is left out.
"""

import contextlib
import cProfile
import functools
import pathlib
import pstats
import time
from typing import Any, Callable, Mapping, Sequence

from absl import flags
from dm_control import composer
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np
import torch
import tqdm

from benchmarks import common
import dmc_multimode
from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import acting
from dmc_multimode.bin import app
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import files

_MODES = flags.DEFINE_string('modes', 'pi2', 'A mode set, or modes.')
_NUM_WORLDS = flags.DEFINE_integer(
  'num_worlds',
  run_config.RunConfig().num_worlds,
  'Worlds that are stepped together.',
  lower_bound=1,
)
_THREADS = flags.DEFINE_integer(
  'threads',
  common.CORES,
  'Threads of physics and torch, processes of Gymnasium.',
  lower_bound=1,
)
_POLICY = flags.DEFINE_string(
  'policy', None, 'A policy that acts, by name or folder; --modes must be its.'
)
_ROUNDS = flags.DEFINE_integer('rounds', 5, 'Medians are over these.', 1)
_SECONDS = flags.DEFINE_float(
  'seconds', 3.0, 'Of each measurement in a round.', lower_bound=0.01
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of actions and episodes.', 0)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')
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

Row = dict[str, Any]


# Runs for that many seconds; returns environment steps per second by name.
Measure = Callable[[float], dict[str, float]]


class _Actions:
  """Random actions around standing."""

  def __init__(self, standing: np.ndarray, seed: int):
    self._standing = standing
    self._random_state = np.random.RandomState(seed)

  def draw(self, *shape: int) -> np.ndarray:
    size = (*shape, len(self._standing))
    noise = self._random_state.standard_normal(size)
    return self._standing + _ACTION_STD * noise


class _Worlds:
  """BatchedImitation, and its physics alone on the same states."""

  def __init__(self, config: run_config.RunConfig):
    run = _build(config)
    self.environment = run.environment
    self._actor = acting.BatchedActor(run.network, config.seed)
    standing = self.environment.standing_action()
    self._actions = _Actions(standing, config.seed)
    self._ctrl = self.environment.physics.batch.bind('ctrl')
    self._observation = self.environment.reset()
    for _ in range(_BURN_IN):
      self.step(self.draw())

  def draw(self) -> np.ndarray:
    """Returns actions for all worlds."""
    if _POLICY.value:
      return self._actor.sample(torch.from_numpy(self._observation))[0].numpy()
    return self._actions.draw(self.environment.num_worlds)

  def step(self, actions: np.ndarray) -> None:
    """Steps the environment."""
    self._observation = self.environment.step(actions).observation

  def measure(self, seconds: float) -> dict[str, float]:
    """Steps raw, puts the states back, steps the environment; and so on."""
    spent, steps = {_RAW: 0.0, _BATCHED: 0.0}, 0
    while min(spent.values()) < seconds:
      actions, rows = self.draw(), self.environment.physics.batch.state.copy()
      self._ctrl[:] = actions
      spent[_RAW] += _time(self._step_raw)
      self.environment.physics.batch.state[:] = rows
      step = functools.partial(self.step, actions)
      spent[_BATCHED] += _time(step)
      steps += self.environment.num_worlds
    return {name: steps / seconds for name, seconds in spent.items()}

  def profile(self, profiler: cProfile.Profile) -> None:
    """Profiles a step, without the choice of its actions."""
    profiler.runcall(self.step, self.draw())

  def _step_raw(self) -> None:
    with contextlib.suppress(mujoco_batch.SimulationError):
      self.environment.physics.batch.step(
        nstep=self.environment.config.substeps
      )


def _measure_composer(
  config: run_config.RunConfig, actions: _Actions, stack: contextlib.ExitStack
) -> Measure:
  """Returns what steps the Composer task in a loop."""
  environment = _composer(config.modes, config.task, config.seed)
  stack.callback(environment.close)
  timestep = [environment.reset()]

  def step() -> None:
    if timestep[0].last():
      environment.reset()
    timestep[0] = environment.step(actions.draw())

  return lambda seconds: {_COMPOSER: _rate(step, 1, seconds)}


def _measure_processes(
  config: run_config.RunConfig, actions: _Actions, stack: contextlib.ExitStack
) -> Measure:
  """Returns what steps Gymnasium's AsyncVectorEnv, a process a thread."""
  from gymnasium import vector

  make = functools.partial(_gymnasium, config.modes, config.task)
  # Forked children would inherit the locks of our threads.
  environments = vector.AsyncVectorEnv(
    [make] * config.threads,
    shared_memory=True,
    context='spawn',
    autoreset_mode=vector.AutoresetMode.SAME_STEP,
  )
  stack.callback(environments.close)
  environments.reset(seed=config.seed)
  count = environments.num_envs

  def step() -> None:
    environments.step(actions.draw(count).astype(np.float32))

  return lambda seconds: {_ASYNC: _rate(step, count, seconds)}


class _Training:
  """Whole iterations of PPO: acting, stepping, learning."""

  def __init__(self, config: run_config.RunConfig):
    self._loop = _build(config).loop
    self._iteration()  # The first one allocates.

  def _iteration(self) -> None:
    length = runner.TrainingConfig(steps=self._loop.steps + 1)
    self._loop.run(length, loggers.Dispatcher([]), save=lambda: None)

  def measure(self, seconds: float) -> dict[str, float]:
    """Runs iterations until the time is up."""
    before, spent = self._loop.steps, 0.0
    while spent < seconds:
      spent += _time(self._iteration)
    return {_PPO: (self._loop.steps - before) / spent}

  def profile(self, profiler: cProfile.Profile) -> None:
    """Profiles an iteration."""
    profiler.runcall(self._iteration)


def _time(function: Callable[[], Any]) -> float:
  """Returns the seconds that a call takes."""
  began = time.perf_counter()
  function()
  return time.perf_counter() - began


def _rate(step: Callable[[], None], count: int, seconds: float) -> float:
  """Returns control steps per second, `count` of them a call."""
  calls, began, now = 0, time.perf_counter(), 0.0
  while now < seconds:
    step()
    calls, now = calls + 1, time.perf_counter() - began
  return calls * count / now


def _build(config: run_config.RunConfig) -> setup.Run:
  mode_set = library.mode_set(config.modes)
  if not _POLICY.value:
    return setup.build(config, mode_set)
  trained = policy_lib.load(_POLICY.value)
  if trained.mode_set.names != mode_set.names:
    raise ValueError(
      f'--policy knows {trained.mode_set.names}: pass them as --modes.'
    )
  run = setup.build(config, trained.mode_set)
  run.network.load_state_dict(trained.network.state_dict())
  return run


def _composer(
  modes: str, config: task_config.ImitationConfig, seed: int | None
) -> composer.Environment:
  return multimode_biped.imitation(modes, random=seed, config=config)


def _gymnasium(modes: str, config: task_config.ImitationConfig) -> Any:
  from dmc_multimode.suite.wrappers import gymnasium_env

  return gymnasium_env.GymnasiumEnv(_composer(modes, config, None))


def compare(config: run_config.RunConfig) -> list[Row]:
  """Measures all contenders in turns; returns the rows of the table."""
  rates: dict[str, list[float]] = {}
  with contextlib.ExitStack() as stack:
    worlds = _Worlds(config)
    contenders: list[Measure] = [worlds.measure, _Training(config).measure]
    if not _POLICY.value:
      standing = worlds.environment.standing_action()
      contenders[1:1] = [
        make(config, _Actions(standing, config.seed), stack)
        for make in (_measure_composer, _measure_processes)
      ]
    with tqdm.tqdm(total=_ROUNDS.value * len(contenders)) as bar:
      for _ in range(_ROUNDS.value):
        for measure in contenders:
          for name, rate in measure(_SECONDS.value).items():
            rates.setdefault(name, []).append(rate)
          bar.update()
  return [_row(name, rates) for name in rates]


def _row(name: str, rates: Mapping[str, list[float]]) -> Row:
  ratios = np.array(rates[name]) / np.array(rates[_RAW])
  return {
    'name': name,
    'steps_per_second': float(np.median(rates[name])),
    'ratio_to_raw': float(np.median(ratios)),
    'ratio_range': [float(ratios.min()), float(ratios.max())],
  }


def profile(config: run_config.RunConfig) -> list[Row]:
  """Returns what share of a step, or of an iteration, each function takes."""
  whole = _PROFILE.value == 'loop'
  contender = _Training(config) if whole else _Worlds(config)
  profiler, spent = cProfile.Profile(), 0.0
  with tqdm.tqdm(total=round(_SECONDS.value, 2), unit='s') as bar:
    while spent < _SECONDS.value:
      seconds = _time(functools.partial(contender.profile, profiler))
      bar.update(round(seconds, 3))
      spent += seconds
  rows = _shares(pstats.Stats(profiler).stats)  # type: ignore[attr-defined]
  column = 'percent' if whole else 'own_percent'
  if whole:
    # Ours are called by torch, too, which `own` knows nothing of.
    rows = [{key: row[key] for key in ('name', column)} for row in rows]
  rows.sort(key=lambda row: -row[column])
  return [row for row in rows if row[column] >= _LEAST_SHARE]


def _shares(stats: Mapping[Any, Any]) -> list[Row]:
  """Returns what each of our functions and the engine's takes.

  Own is what it spends without any other of these. In a step of the
  environment, where numpy and scipy call none of ours, they add up to 100
  percent. Only the calling thread is seen, and that it waits for others.
  """
  ours = str(pathlib.Path(dmc_multimode.__file__).parent)
  files = (ours, mujoco_batch.__file__)
  chosen = {key: s for key, s in stats.items() if key[0].startswith(files)}
  own = {key: cumulative for key, (*_, cumulative, _) in chosen.items()}
  for *_, callers in chosen.values():
    for caller, (*_, cumulative) in callers.items():
      if caller in own:
        own[caller] -= cumulative
  total = max(cumulative for *_, cumulative, _ in chosen.values())
  return [
    {
      'name': f'{pathlib.Path(file).stem}.{function}',
      'own_percent': 100 * own[file, line, function] / total,
      'percent': 100 * cumulative / total,
    }
    for (file, line, function), (*_, cumulative, _) in chosen.items()
  ]


def _print_comparison(rows: list[Row]) -> None:
  print(f'{"control steps per second":26}{"":>11}{"to raw":>9}  in the rounds')
  for row in rows:
    low, high = row['ratio_range']
    print(
      f'{row["name"]:26}{row["steps_per_second"]:11,.0f}'
      f'{row["ratio_to_raw"]:9.3f}  {low:.3f} to {high:.3f}'
    )
  ratios = {row['name']: row['ratio_to_raw'] for row in rows}
  if _ASYNC in ratios:
    print(f'{_BATCHED} to {_ASYNC}: {ratios[_BATCHED] / ratios[_ASYNC]:.1f}')


def _print_profile(rows: list[Row]) -> None:
  whole = _PROFILE.value == 'loop'
  title = f'percent of {"an iteration" if whole else "a step"}'
  print(f'{title:36}{"in all":>8}{"" if whole else "own":>8}')
  for row in rows:
    own = '' if whole else f'{row["own_percent"]:8.2f}'
    print(f'{row["name"]:36}{row["percent"]:8.2f}{own}')


def _report(config: run_config.RunConfig, rows: list[Row]) -> dict[str, Any]:
  """Returns what the JSON file holds."""
  return {
    'benchmark': 'throughput',
    'table': rows,
    'policy': _POLICY.value,
    'rounds': _ROUNDS.value,
    'seconds': _SECONDS.value,
    'seed': config.seed,
    'config': run_config.to_dict(config),
  }


def main(argv: Sequence[str]) -> None:
  """Measures, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  config = common.configured(
    modes=_MODES.value,
    seed=_SEED.value,
    num_worlds=_NUM_WORLDS.value,
    threads=_THREADS.value,
  )
  print(
    f'{config.modes}, {config.num_worlds} worlds, {config.threads} threads on '
    f'{common.CORES} cores, mujoco {mujoco.__version__}'
  )
  rows = profile(config) if _PROFILE.value else compare(config)
  (_print_profile if _PROFILE.value else _print_comparison)(rows)
  common.write_report(out, _report(config, rows), ['gymnasium'])


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
