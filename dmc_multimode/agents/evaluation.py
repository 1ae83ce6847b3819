"""Deterministic evaluation: returns, survival, and what was measured."""

from typing import Any, Callable, NamedTuple

import numpy as np

from dmc_multimode.agents import environment as environment_lib

SelectAction = Callable[[np.ndarray], np.ndarray]
_ON_TIME = 0  # Cause of the episodes that end at their time limit.


class Episodes(NamedTuple):
  """One episode of each of B worlds, over T steps.

  Attributes:
    returns: normalised returns, [B].
    survived: whether they ran to the time limit, [B].
    lengths: control steps until the end, [B].
    traces: what the environment measured after each step by name, [T, B, ...];
      only the first `lengths` steps of a world mean anything.
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
  environment: environment_lib.MeasuredEnvironment,
  select_action: SelectAction,
  progress: Callable[[], Any] = lambda: None,
) -> Episodes:
  """Runs one episode in every world.

  Args:
    environment: its worlds must not begin anew by themselves.
    select_action: observations float32 [B, D] to actions [B, A].
    progress: called after every step.
  """
  count = environment.num_worlds
  returns, lengths = np.zeros(count), np.zeros(count, dtype=np.int64)
  survived, ended = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
  traces: dict[str, list[np.ndarray]] = {}
  observation = environment.reset()
  while not ended.all():
    step = environment.step(select_action(observation))
    observation = step.observation
    for name, value in environment.measure().items():
      traces.setdefault(name, []).append(value)
    worlds = step.results.worlds
    returns[worlds] = step.results.returns
    lengths[worlds] = step.results.lengths
    survived[worlds] = step.results.causes == _ON_TIME
    ended[worlds] = True
    progress()
  stacked = {name: np.stack(values) for name, values in traces.items()}
  return Episodes(returns, survived, lengths, stacked)


def summary(values: np.ndarray) -> dict[str, float]:
  """Returns mean and standard deviation."""
  return {'mean': float(np.mean(values)), 'std': float(np.std(values))}
