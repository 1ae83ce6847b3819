"""Deterministic episodes of one policy, distributed over the ranks."""

import copy
import dataclasses
from typing import Any, Callable, Protocol

import numpy as np

from dmc_multimode.agents import distributed
from dmc_multimode.arenas import track
from dmc_multimode.evaluation import episodes as evaluation_episodes
from dmc_multimode.evaluation import gait_metrics
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.utils import durations
from dmc_multimode.utils import progress_bar


class Policy(Protocol):
  """Interface of policies to evaluate, such as `pretrained.Policy`."""

  @property
  def mode_set(self) -> mode_set_lib.ModeSet:
    """Modes of the policy."""

  def select_action(self, observation: np.ndarray) -> np.ndarray:
    """Returns mean joint targets [B, 10] for observations [B, D]."""


# Prepares worlds; returns what measures them after every step.
Recorder = Callable[[batched_env.BatchedImitation], evaluation_episodes.Measure]


class Evaluator:
  """Runs mode schedules with one policy, one episode a world.

  Of several ranks, each runs some of the episodes, and all get the same result
  as one process would.
  """

  def __init__(
    self,
    policy: Policy,
    config: task_config.ImitationConfig,
    seed: int,
    quiet: bool = False,
    communicator: distributed.Communicator = distributed.LOCAL,
  ):
    """Evaluates `policy` on the task of `config`; `quiet` hides progress."""
    self.policy, self.config, self.seed = policy, config, seed
    self._quiet = quiet or communicator.rank > 0
    self._communicator = communicator
    self.mode_set = policy.mode_set

  def changed(self, **fields: Any) -> 'Evaluator':
    """Returns an evaluator with other values of these task fields."""
    other = copy.copy(self)
    other.config = dataclasses.replace(self.config, **fields)
    return other

  def traces(
    self, episodes: evaluation_episodes.Episodes, cycle: float
  ) -> list[gait_metrics.Trace]:
    """Returns traces of a mode's episodes; `cycle` is in seconds."""
    return gait_metrics.traces(
      episodes.traces, episodes.lengths, self.config.control_timestep, cycle
    )

  def make_worlds(
    self, schedule: schedule_lib.ModeSchedule
  ) -> batched_env.BatchedImitation:
    """Returns a world for each row of `schedule`, without auto-reset."""
    motions = self.policy.mode_set.motions
    is_ledge = np.array([motion.ledge is not None for motion in motions])
    ledges = int(is_ledge[schedule.modes].sum(axis=1).max())
    arena = track.make('flat')
    if ledges >= arena.num_segments:
      arena = track.make('flat', ledges + 1)
    task = multimode_biped.make_task(
      self.policy.mode_set,
      episodes_lib.ScheduledEpisodes(schedule),
      arena,
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
    # All worlds draw from one stream, so that each rank needs all of them.
    # Those of other ranks are not stepped and cost next to nothing.
    worlds.moving[:] = self._mine(schedule)
    return worlds

  def _mine(self, schedule: schedule_lib.ModeSchedule) -> np.ndarray:
    """Returns the mask of the rows that this rank runs, [B]."""
    rows = np.arange(len(schedule))
    return rows % self._communicator.size == self._communicator.rank

  def run(
    self,
    schedule: schedule_lib.ModeSchedule,
    label: str,
    recorder: Recorder | None = None,
  ) -> evaluation_episodes.Episodes:
    """Runs one episode of each row of `schedule`.

    Args:
      schedule: of the worlds.
      label: of the progress bar.
      recorder: measures something else than the environment does.

    Raises:
      ValueError: the task has no time limit.
    """
    if self.config.horizon == durations.UNBOUNDED:
      raise ValueError('An evaluation needs a finite time_limit.')
    worlds = self.make_worlds(schedule)
    measure = recorder(worlds) if recorder else None
    with progress_bar.Bar(
      total=self.config.horizon, desc=label, unit='step', disable=self._quiet
    ) as bar:
      found = evaluation_episodes.run_episodes(
        worlds, self.policy.select_action, bar.update, measure
      )
    return evaluation_episodes.of_all_ranks(
      found, np.flatnonzero(self._mine(schedule)), self._communicator
    )
