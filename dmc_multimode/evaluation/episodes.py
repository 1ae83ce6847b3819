"""Evaluation episodes: returns, survival and measurements."""

from typing import Any, Callable, Mapping, NamedTuple

import numpy as np
import torch

from dmc_multimode.agents import core as agents_core
from dmc_multimode.agents import distributed

SelectAction = Callable[[np.ndarray], np.ndarray]
Measure = Callable[[], Mapping[str, np.ndarray]]
_ON_TIME = 0  # Cause of an end at the time limit.


class Episodes(NamedTuple):
  """One episode of each of B worlds, over T steps.

  Attributes:
    returns: normalised returns, [B].
    survived: whether they ran to the time limit, [B].
    lengths: control steps until the end, [B].
    traces: measurements after each step by name, [T, B, ...]; only the first
      `lengths` steps of a world are valid.
  """

  returns: np.ndarray
  survived: np.ndarray
  lengths: np.ndarray
  traces: dict[str, np.ndarray]

  def rows(self, ids: np.ndarray) -> 'Episodes':
    """Returns the episodes `ids`."""
    return Episodes(
      self.returns[ids],
      self.survived[ids],
      self.lengths[ids],
      {name: trace[:, ids] for name, trace in self.traces.items()},
    )


def run_episodes(
  environment: agents_core.MeasuredEnvironment,
  select_action: SelectAction,
  progress: Callable[[], Any] = lambda: None,
  measure: Measure | None = None,
) -> Episodes:
  """Runs one episode in every world.

  Args:
    environment: must not reset its worlds itself.
    select_action: maps observations float32 [B, D] to actions [B, A].
    progress: called after every step.
    measure: returns the measurements of a step by name, [B, ...] each; that of
      the environment if None.
  """
  measure = measure or environment.measure
  count = environment.num_worlds
  returns, lengths = np.zeros(count), np.zeros(count, dtype=np.int64)
  survived, ended = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
  traces: dict[str, list[np.ndarray]] = {}
  observation = environment.reset()
  while not ended.all():
    step = environment.step(select_action(observation))
    observation = step.observation
    for name, value in measure().items():
      traces.setdefault(name, []).append(value)
    worlds = step.results.worlds
    returns[worlds] = step.results.returns
    lengths[worlds] = step.results.lengths
    survived[worlds] = step.results.causes == _ON_TIME
    ended[worlds] = True
    progress()
  stacked = {name: np.stack(values) for name, values in traces.items()}
  return Episodes(returns, survived, lengths, stacked)


def of_all_ranks(
  episodes: Episodes, mine: np.ndarray, communicator: distributed.Communicator
) -> Episodes:
  """Returns all episodes, of which every rank has run some.

  Args:
    episodes: all B as this rank has them.
    mine: mask of the episodes that this rank has run, [B].
    communicator: of the ranks.
  """
  if communicator.size == 1:
    return episodes
  gather = lambda rows: communicator.gather(torch.from_numpy(rows)).numpy()
  places = np.argsort(gather(mine))
  share = lambda values: gather(values[mine])[places]
  steps = [len(trace) for trace in episodes.traces.values()][:1]
  longest = int(gather(np.array(steps, dtype=np.int64)).max(initial=0))

  def share_trace(trace: np.ndarray) -> np.ndarray:
    # Shorter traces are padded by their last step.
    times = np.minimum(np.arange(longest), len(trace) - 1)
    rows = share(np.moveaxis(trace[times], 1, 0))
    return np.ascontiguousarray(np.moveaxis(rows, 0, 1))

  return Episodes(
    share(episodes.returns),
    share(episodes.survived),
    share(episodes.lengths),
    {name: share_trace(trace) for name, trace in episodes.traces.items()},
  )


def summary(values: np.ndarray) -> dict[str, float]:
  """Returns the mean and standard deviation by name."""
  return {'mean': float(np.mean(values)), 'std': float(np.std(values))}
