"""The scores of a policy: every mode, every transition, what modes promise."""

import copy
import dataclasses
import itertools
from typing import Any, Protocol, Sequence

import numpy as np
import tqdm

from dmc_multimode.agents import core as agents_core
from dmc_multimode.agents import distributed
from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import episodes as evaluation_episodes
from dmc_multimode.evaluation import gait_metrics
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.suite.imitation import terminations

MODE_FACTOR = 4  # Episodes of a mode for one of each transition.


class Policy(Protocol):
  """What is evaluated: what `pretrained.Policy` has, and others may have."""

  @property
  def mode_set(self) -> mode_set_lib.ModeSet:
    """The modes that it knows."""

  def select_action(self, observation: np.ndarray) -> np.ndarray:
    """Joint targets [B, 10] for observations [B, D], without exploration."""


class Evaluator:
  """Runs schedules of one policy, one episode a world.

  Where there are several ranks, each runs some of the episodes, and all of them
  get the result, which is what one process would find.
  """

  def __init__(
    self,
    policy: Policy,
    config: task_config.ImitationConfig,
    seed: int,
    quiet: bool = False,
    communicator: distributed.Communicator = distributed.LOCAL,
  ):
    """Evaluates `policy` on the task of `config`, with progress bars or not."""
    self.policy, self.config, self.seed = policy, config, seed
    self._quiet = quiet or communicator.rank > 0
    self._communicator = communicator
    self.mode_set = policy.mode_set

  def changed(self, **fields: Any) -> 'Evaluator':
    """Returns one whose task has other values in these fields."""
    other = copy.copy(self)
    other.config = dataclasses.replace(self.config, **fields)
    return other

  def traces(
    self, episodes: evaluation_episodes.Episodes, cycle: float
  ) -> list[gait_metrics.Trace]:
    """Returns what the body did in episodes of a mode with that cycle, s."""
    return gait_metrics.traces(
      episodes.traces, episodes.lengths, self.config.control_timestep, cycle
    )

  def make_worlds(
    self, schedule: schedule_lib.ModeSchedule
  ) -> agents_core.MeasuredEnvironment:
    """Returns a world for each row of `schedule`, none of which begins anew."""
    task = multimode_biped.make_task(
      self.policy.mode_set,
      episodes_lib.ScheduledEpisodes(schedule),
      config=self.config,
    )
    is_alone = self._communicator.size == 1
    worlds = batched_env.BatchedImitation(
      task,
      len(schedule),
      self.seed,
      0 if is_alone else distributed.local_cores(),
      auto_reset=False,
    )
    # All worlds draw from one stream: it takes all of them to draw the same.
    # Those of other ranks then stand still, which costs next to nothing.
    worlds.moving[:] = self._mine(schedule)
    return worlds

  def _mine(self, schedule: schedule_lib.ModeSchedule) -> np.ndarray:
    """Returns whether this rank runs each row, [B]."""
    rows = np.arange(len(schedule))
    return rows % self._communicator.size == self._communicator.rank

  def run(
    self, schedule: schedule_lib.ModeSchedule, label: str
  ) -> evaluation_episodes.Episodes:
    """Runs one episode of each row of `schedule`."""
    worlds = self.make_worlds(schedule)
    with tqdm.tqdm(
      total=self.config.horizon, desc=label, unit='step', disable=self._quiet
    ) as bar:
      found = evaluation_episodes.run_episodes(
        worlds, self.policy.select_action, bar.update
      )
    return evaluation_episodes.of_all_ranks(
      found, np.flatnonzero(self._mine(schedule)), self._communicator
    )


def evaluate_modes(
  evaluator: Evaluator, episodes: int, clock_rate: float
) -> dict[str, dict[str, float]]:
  """Every mode alone: its MRA, survival and what the body did."""
  bank = evaluator.mode_set.bank
  modes = np.repeat(np.arange(len(bank)), episodes)
  found = evaluator.run(schedule_lib.single(modes, clock_rate), 'modes')
  result = {}
  for i, name in enumerate(bank.names):
    mine = found.rows(np.flatnonzero(modes == i))
    traces = evaluator.traces(mine, bank.durations[i] / clock_rate)
    rows = [gait_metrics.metrics(trace) for trace in traces]
    result[name] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
      **{key: float(np.mean([row[key] for row in rows])) for key in rows[0]},
    }
  return result


def evaluate_clock_rates(
  evaluator: Evaluator, episodes: int, rates: Sequence[float]
) -> dict[str, dict[str, dict[str, float]]]:
  """How fast every mode that travels goes at other rates of its clock.

  A robot that cannot keep up with its reference goes on: only a fall ends an
  episode.

  Returns:
    By rate and mode: velocity along the mode's way and that of its reference,
    m/s, and survival. Empty where no mode travels.
  """
  bank = evaluator.mode_set.bank
  limits = terminations.falls_alone(evaluator.config.limits)
  free = evaluator.changed(limits=limits)
  lengths = np.linalg.norm(bank.displacements[:, :2], axis=1)
  travelling = np.flatnonzero(lengths)
  if not len(travelling):
    return {}
  modes = np.repeat(travelling, episodes)
  result: dict[str, dict[str, dict[str, float]]] = {}
  for rate in rates:
    found = free.run(schedule_lib.single(modes, rate), f'clock rate {rate:g}')
    row = result[f'{rate:g}'] = {}
    for i in travelling:
      mine = found.rows(np.flatnonzero(modes == i))
      way = bank.displacements[i, :2] / lengths[i]
      traces = free.traces(mine, bank.durations[i] / rate)
      speeds = [t.velocity(t.position)[:2] @ way for t in traces]
      row[bank.names[i]] = {
        'reference': float(rate * lengths[i] / bank.durations[i]),
        'velocity': float(np.mean(speeds)),
        'survival': float(mine.survived.mean()),
      }
  return result


def evaluate_behaviour(
  evaluator: Evaluator, episodes: int
) -> dict[str, dict[str, dict[str, Any]]]:
  """Judges every mode by its acceptance criteria: see `acceptance`."""
  bank = evaluator.mode_set.bank
  longer = evaluator.changed(time_limit=acceptance.DURATION)
  modes = np.repeat(np.arange(len(bank)), episodes)
  found = longer.run(schedule_lib.single(modes), 'behaviour')
  result = {}
  for i, motion in enumerate(bank.motions):
    mine = found.rows(np.flatnonzero(modes == i))
    traces = longer.traces(mine, motion.duration)
    result[motion.name] = {
      verdict.metric: {
        'value': verdict.value,
        'worst': verdict.worst,
        'least': verdict.least if np.isfinite(verdict.least) else None,
        'most': verdict.most if np.isfinite(verdict.most) else None,
        'kept': verdict.kept,
      }
      for verdict in acceptance.judge(motion, traces)
    }
  return result


def evaluate_transitions(
  evaluator: Evaluator, episodes: int
) -> dict[str, dict[str, float]]:
  """All n x n transitions, at every switch phase and clip of Algorithm 1."""
  mode_set = evaluator.mode_set
  n = len(mode_set)
  cases = np.array(
    list(
      itertools.product(
        range(n),
        range(n),
        schedule_lib.CLIPS,
        schedule_lib.SWITCH_PHASES,
        range(episodes),
      )
    )
  )
  initial, final = cases[:, 0].astype(int), cases[:, 1].astype(int)
  found = evaluator.run(
    schedule_lib.transitions(
      mode_set,
      initial,
      final,
      cases[:, 2],
      cases[:, 3],
      evaluator.config.commands_from_ground,
    ),
    'transitions',
  )
  result = {}
  for i, f in itertools.product(range(n), range(n)):
    mine = found.rows(np.flatnonzero((initial == i) & (final == f)))
    result[f'{mode_set.names[i]}->{mode_set.names[f]}'] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
    }
  return result


def report(
  evaluator: Evaluator, episodes: int, clock_rate: float
) -> dict[str, Any]:
  """Returns the whole report as JSON-able values."""
  modes = evaluate_modes(evaluator, MODE_FACTOR * episodes, clock_rate)
  transitions = evaluate_transitions(evaluator, episodes)
  gather = lambda rows, key: np.array([row[key] for row in rows.values()])
  return {
    'mra_modes': evaluation_episodes.summary(gather(modes, 'mra')),
    'mra_transitions': evaluation_episodes.summary(gather(transitions, 'mra')),
    'survival_modes': float(gather(modes, 'survival').mean()),
    'survival_transitions': float(gather(transitions, 'survival').mean()),
    'modes': modes,
    'behaviour': evaluate_behaviour(evaluator, MODE_FACTOR * episodes),
    'transitions': transitions,
    'seed': evaluator.seed,
    'episodes_per_case': episodes,
    'clock_rate': clock_rate,
    'task': task_config.to_dict(evaluator.config),
  }
