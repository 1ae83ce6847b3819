"""Statistics of the episodes that end during a training."""

import math
from typing import Mapping, NamedTuple

import numpy as np
import torch

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed

_MOST_DIVERGED = 0.001  # Share of environment steps.
_WINDOW = 20_000  # Environment steps of a window.


class Episodes(NamedTuple):
  """Finished episodes; implements `core.Outcomes`."""

  initial: np.ndarray
  final: np.ndarray
  returns: np.ndarray
  causes: np.ndarray
  lengths: np.ndarray


class EpisodeTable:
  """Collects the episodes that end during one rollout."""

  def __init__(self) -> None:
    """Starts empty."""
    self._rows: list[np.ndarray] = []

  def add(self, time: int, results: core.Outcomes) -> None:
    """Adds the episodes that ended at a time step of the rollout."""
    times = np.full(len(results.initial), time)
    columns = (
      *(results.initial, results.final, results.causes),
      *(results.lengths, results.returns),
    )
    self._rows.append(np.stack((times, *columns), axis=1).astype(np.float64))

  def gather(self, communicator: distributed.Communicator) -> Episodes:
    """Returns the episodes of all ranks.

    The order is that of time, then ranks, then worlds.
    """
    mine = torch.from_numpy(np.concatenate(self._rows))
    table = communicator.gather(mine).numpy()
    table = table[np.argsort(table[:, 0], kind='stable')]
    initial, final, causes, lengths = table[:, 1:5].T.astype(np.int64)
    return Episodes(initial, final, table[:, 5], causes, lengths)


class ReturnTracker:
  """Running means of return, survival and length, per transition.

  Attributes:
    returns: normalised, [M, M] by initial and final mode, as all that follow.
    survival: shares of episodes that reached their time limit.
    seconds: mean lengths of episodes, seconds.
    seen: numbers of episodes that have ended.
    timed: likewise, since lengths are recorded: earlier checkpoints have none.
  """

  _MEMORY = 0.98  # A mean follows about the last 50 episodes.
  _FIELDS = ('returns', 'survival', 'seen')
  _NEW_FIELDS = ('seconds', 'timed')

  def __init__(self, num_modes: int, control_timestep: float):
    """Starts without episodes of control steps of so many seconds."""
    self._control_timestep = control_timestep
    self.returns = np.zeros((num_modes, num_modes))
    self.survival = np.zeros((num_modes, num_modes))
    self.seconds = np.zeros((num_modes, num_modes))
    self.seen = np.zeros((num_modes, num_modes))
    self.timed = np.zeros((num_modes, num_modes))

  def update(self, results: core.Outcomes) -> None:
    """Updates the means by finished episodes, in order."""
    for i, f, value, cause, length in zip(
      results.initial,
      results.final,
      results.returns,
      results.causes,
      results.lengths * self._control_timestep,
      strict=True,
    ):
      self.seen[i, f] += 1
      self.timed[i, f] += 1
      rate = max(1 - self._MEMORY, 1 / self.seen[i, f])
      self.returns[i, f] += rate * (value - self.returns[i, f])
      self.survival[i, f] += rate * ((cause == 0) - self.survival[i, f])
      rate = max(1 - self._MEMORY, 1 / self.timed[i, f])
      self.seconds[i, f] += rate * (length - self.seconds[i, f])

  def summary(self, names: tuple[str, ...]) -> dict[str, float]:
    """Returns MRA and survival, in all and per mode and transition.

    Adds the mean length of episodes, seconds, in all and per mode: a robot that
    learns to stay up falls later long before it survives. A value is NaN where
    no episode has ended yet; means in all leave those out.
    """
    is_known = self.seen > 0
    returns = np.where(is_known, self.returns, np.nan)
    survival = np.where(is_known, self.survival, np.nan)
    seconds = np.where(self.timed > 0, self.seconds, np.nan)
    result = {
      'mra_modes': _mean(np.diagonal(returns)),
      'mra_transitions': _mean(returns),
      'survival': _mean(survival),
      'seconds': _mean(seconds),
      'worst_transition': float(np.fmin.reduce(returns, axis=None)),
    }
    for i, name in enumerate(names):
      result[f'return/{name}'] = float(returns[i, i])
      result[f'survival/{name}'] = float(survival[i, i])
      result[f'seconds/{name}'] = float(seconds[i, i])
    for i, first in enumerate(names):
      for f, second in enumerate(names):
        if i != f:
          key = f'{first}->{second}'
          result[f'return/{key}'] = float(returns[i, f])
          result[f'survival/{key}'] = float(survival[i, f])
    return result

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of the state for `restore`."""
    names = (*self._FIELDS, *self._NEW_FIELDS)
    return {name: getattr(self, name).copy() for name in names}

  def restore(self, state: Mapping[str, torch.Tensor]) -> None:
    """Restores a `state`; those of earlier versions have no lengths."""
    for name in self._FIELDS:
      getattr(self, name)[:] = state[name].numpy()
    for name in self._NEW_FIELDS:
      getattr(self, name)[:] = state[name].numpy() if name in state else 0.0


def _mean(values: np.ndarray) -> float:
  """Returns the mean of the values that are not NaN; NaN if all are."""
  known = values[~np.isnan(values)]
  return float(known.mean()) if known.size else math.nan


class DivergenceCounter:
  """Counts the worlds whose physics diverged and which were reset.

  Attributes:
    total: number of such worlds so far.
  """

  def __init__(self) -> None:
    """Starts at zero."""
    self.restore(0)

  def restore(self, total: int) -> None:
    """Continues from `total`, in a new window."""
    self.total = total
    self._window = np.zeros(2, dtype=np.int64)  # Worlds that diverged, steps.

  def update(self, diverged: int, steps: int) -> None:
    """Adds the worlds that diverged in `steps` environment steps.

    Raises:
      FloatingPointError: in the current window of at least `_WINDOW` steps,
        more than the share `_MOST_DIVERGED` of the steps diverged.
    """
    self.total += diverged
    self._window += diverged, steps
    count, length = self._window.tolist()
    if count > _MOST_DIVERGED * max(length, _WINDOW):
      raise FloatingPointError(
        f'The physics of {count} worlds diverged in {length:,} environment '
        f'steps; {_MOST_DIVERGED:.1%} of {max(length, _WINDOW):,} is the most. '
        'The last checkpoint is unharmed: resume from it; if it recurs, start '
        'anew with a shorter physics_timestep or a lower learning rate.'
      )
    if length >= _WINDOW:
      self._window[:] = 0
