"""Deterministic evaluation: returns, survival, and what the body did."""

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


def body_metrics(
  episodes: Episodes, durations: np.ndarray, control_timestep: float
) -> dict[str, float]:
  """What the trunk did in episodes of one mode, as means over the episodes.

  Args:
    episodes: B episodes.
    durations: seconds of a cycle of the mode, [B].
    control_timestep: seconds.

  Returns:
    velocity, lateral_velocity: mean over the episode without its first second,
      m/s; reference_velocity: that of the reference; height: mean of the trunk
      over its support, m; apex: highest trunk over its support in a cycle, mean
      over the cycles, m; rise: highest minus lowest in a cycle, m; flight:
      longest time without contact in a cycle, s; single_support: share of the
      time with just one foot on the ground, which alternating feet have much
      of; drift: distance from where the episode began, at its end, m;
      position_error: mean distance from the reference, m; final_height: world
      height at the end, m.
  """
  rows = [
    _one_body(episodes, world, durations[world], control_timestep)
    for world in range(len(episodes.returns))
  ]
  return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def _one_body(
  episodes: Episodes, world: int, duration: float, timestep: float
) -> dict[str, float]:
  """`body_metrics` of one world."""
  length = int(episodes.lengths[world])
  trace = {k: v[:length, world] for k, v in episodes.traces.items()}
  position, reference = trace['position'], trace['reference']
  height = position[:, 2] - trace['support']
  settled = min(round(1.0 / timestep), max(length - 2, 0))
  span = max((length - 1 - settled) * timestep, timestep)
  velocity = (position[-1] - position[settled]) / span
  cycle = max(round(duration / timestep), 1)
  cycles = range(0, max(length - cycle, 0) + 1, cycle)
  heights = [height[start : start + cycle] for start in cycles]
  airborne = [
    _longest_run(trace['contact'][start : start + cycle].sum(axis=-1) == 0)
    for start in cycles
  ]
  moved = reference[-1] - reference[settled]
  return {
    'velocity': float(velocity[0]),
    'lateral_velocity': float(velocity[1]),
    'reference_velocity': float(moved[0] / span),
    'height': float(height.mean()),
    'apex': float(np.mean([h.max() for h in heights])),
    'rise': float(np.mean([h.max() - h.min() for h in heights])),
    'flight': float(np.mean(airborne)) * timestep,
    'single_support': float((trace['contact'].sum(axis=-1) == 1).mean()),
    'drift': float(np.linalg.norm(position[-1, :2] - position[0, :2])),
    'position_error': float(
      np.linalg.norm(position - reference, axis=-1).mean()
    ),
    'final_height': float(position[-1, 2]),
  }


def _longest_run(flags: np.ndarray) -> int:
  """Length of the longest run of True, [T] -> int."""
  longest = current = 0
  for flag in flags:
    current = current + 1 if flag else 0
    longest = max(longest, current)
  return longest


def summary(values: np.ndarray) -> dict[str, float]:
  """Returns mean and standard deviation."""
  return {'mean': float(np.mean(values)), 'std': float(np.std(values))}
