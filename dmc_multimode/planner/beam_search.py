"""Beam search over modes, with the worlds' states saved at the knots."""

from typing import Callable, NamedTuple

import numpy as np
from pydantic import dataclasses as pydantic_dataclasses

from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.utils import config as config_lib

_CELL = 0.15  # Metres: robots closer than this are in the same place.
_PHASES = 4  # Parts of a mode that are told apart.


class Solution(NamedTuple):
  """Plans that a planner found.

  Attributes:
    plans: the best first, mode indices, [N, K].
    returns: of these, [N].
    success: true for those that reached the goal when found, [N].
    episodes: plans that were tried, or parts of plans.
  """

  plans: np.ndarray
  returns: np.ndarray
  success: np.ndarray
  episodes: int


@pydantic_dataclasses.dataclass(frozen=True, config=config_lib.STRICT)
class BeamConfig:
  """Parameters of the planner.

  Attributes:
    beams: states that are kept at each knot.
    attempts: searches until one finds a plan that succeeds, each with twice the
      beams of the one before.
  """

  beams: config_lib.PositiveInt = 24
  attempts: config_lib.PositiveInt = 3

  def escalation(self) -> 'list[BeamConfig]':
    """Returns the attempts, each a single one."""
    return [BeamConfig(self.beams << i, 1) for i in range(self.attempts)]


class _Front:
  """Plans that are followed side by side, one a world; W = beams x modes."""

  def __init__(self, beams: int, modes: int):
    """Begins with empty plans, each world to command the next mode in turn."""
    self._beams, self._modes = beams, modes
    self.commands = np.tile(np.arange(modes), beams)  # [W]
    self._parents = np.arange(beams * modes)
    self._plans = np.zeros((beams * modes, 0), dtype=np.int64)
    self.returns = np.zeros(beams * modes)
    # All begin alike: at first only one beam is worth following.
    self.distinct = np.arange(beams * modes) < modes

  def extend(self, reward: np.ndarray) -> None:
    """Adds what was commanded, and what it earned, [W], to the plans."""
    grown = self._plans[self._parents], self.commands[:, None]
    self._plans = np.concatenate(grown, axis=1)
    self.returns = self.returns[self._parents] + reward

  def branch(self, kept: np.ndarray) -> np.ndarray:
    """Continues from the worlds `kept`; returns the source of each, [W]."""
    self._parents = np.repeat(np.resize(kept, self._beams), self._modes)
    self.distinct = np.arange(len(self.commands)) < len(kept) * self._modes
    return self._parents

  def solution(self, progress: problem_lib.Progress, knots: int) -> Solution:
    """Returns the plans, padded to `knots`, after the last knot's progress."""
    missing = knots - self._plans.shape[1]
    success = progress.reached & self.distinct & (missing == 0)
    order = np.lexsort((-self.returns, ~progress.alive, ~success))
    order = order[self.distinct[order]]
    plans = np.pad(self._plans, ((0, 0), (0, missing)))
    return Solution(
      plans[order],
      self.returns[order],
      success[order],
      len(self.commands) * knots,
    )


def beam_search(
  problem: problem_lib.ReachingProblem,
  config: BeamConfig,
  report: Callable[[int, float, float], None] = lambda *args: None,
) -> Solution:
  """Follows the most promising plans, kept apart by place, mode and phase.

  At each knot every kept state is continued under every mode. What is kept then
  is the best of each part of each mode in each stretch of the track in turns,
  so that not all of them stand at one edge, or jump at one moment, and fall
  together.

  Args:
    problem: of `config.beams` times the number of modes worlds.
    config: how many to keep; this is one attempt.
    report: is told the knot, the best return, and the least distance from the
      goal along x.

  Raises:
    ValueError: the problem has another number of worlds.
  """
  beams, modes, knots = config.beams, problem.num_modes, problem.knots
  if problem.num_worlds != beams * modes:
    raise ValueError(
      f'{beams} beams of {modes} modes need {beams * modes} worlds, the '
      f'problem has {problem.num_worlds}.'
    )
  front = _Front(beams, modes)
  problem.reset()
  for knot in range(knots):
    progress = problem.run_knot(front.commands)
    front.extend(progress.reward)
    worth = front.distinct & progress.alive
    if not worth.any():
      break
    best = float(front.returns[worth].max())
    report(knot + 1, best, _nearest(problem, progress))
    if knot < knots - 1:
      cells = np.stack(
        [
          np.floor(progress.position[:, 0] / _CELL),
          front.commands,
          np.floor(problem.phase * _PHASES),
        ]
      )
      kept = _select(cells, front.returns, worth, beams)
      problem.copy_state(front.branch(kept))
  return front.solution(progress, knots)


def _nearest(
  problem: problem_lib.ReachingProblem, progress: problem_lib.Progress
) -> float:
  """Least distance from the goal along x of those that are alive, metres."""
  ahead = np.abs(problem.config.goal[0] - progress.position[:, 0])
  return float(ahead[progress.alive].min())


def _select(
  cells: np.ndarray, returns: np.ndarray, worth: np.ndarray, count: int
) -> np.ndarray:
  """Returns the worlds to go on from, at most `count`.

  The best of every cell come first, then the second best of every cell, and so
  on.

  Args:
    cells: what tells the W worlds apart, [D, W].
    returns: of their plans so far, [W].
    worth: which may be gone on from, [W].
    count: most that are kept.
  """
  candidates = np.flatnonzero(worth)
  candidates = candidates[np.argsort(-returns[candidates], kind='stable')]
  seen: dict[tuple[float, ...], int] = {}
  ranks = np.zeros(len(candidates), dtype=np.int64)
  for i, cell in enumerate(map(tuple, cells.T[candidates])):
    ranks[i] = seen[cell] = seen.get(cell, -1) + 1
  return candidates[np.argsort(ranks, kind='stable')][:count]
