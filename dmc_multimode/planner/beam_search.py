"""Beam search over modes that copies the worlds' states at the knots."""

from typing import Callable, NamedTuple

import numpy as np

from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.utils import config as config_lib

_CELL = 0.15  # Metres: length of a cell along the track.
_PHASES = 4  # Cells of a mode's phase.


class Solution(NamedTuple):
  """Plans that a planner found.

  Attributes:
    plans: mode indices, best plan first, [N, K].
    returns: of the plans, [N].
    success: whether the plans reached the goal in the search, [N].
    episodes: number of plans, or parts of plans, that were rolled out.
  """

  plans: np.ndarray
  returns: np.ndarray
  success: np.ndarray
  episodes: int


@config_lib.dataclass
class BeamConfig:
  """Parameters of the planner.

  Attributes:
    beams: number of states kept at each knot.
    attempts: number of searches until a plan succeeds, each with twice the
      beams of the one before.
  """

  beams: config_lib.PositiveInt = 24
  attempts: config_lib.PositiveInt = 3

  def escalation(self) -> 'list[BeamConfig]':
    """Returns one config per attempt, doubling `beams` each time."""
    return [BeamConfig(self.beams << i, 1) for i in range(self.attempts)]


class _Front:
  """Plans of the search, one a world; W = beams x modes."""

  def __init__(self, beams: int, modes: int):
    """Starts with empty plans; world i commands mode i modulo modes."""
    self._beams, self._modes = beams, modes
    self.commands = np.tile(np.arange(modes), beams)  # [W]
    self._parents = np.arange(beams * modes)
    self._plans = np.zeros((beams * modes, 0), dtype=np.int64)
    self.returns = np.zeros(beams * modes)
    # All worlds begin alike: at first only one beam counts.
    self.distinct = np.arange(beams * modes) < modes

  def extend(self, reward: np.ndarray) -> None:
    """Appends the commanded modes and adds their rewards, [W]."""
    grown = self._plans[self._parents], self.commands[:, None]
    self._plans = np.concatenate(grown, axis=1)
    self.returns = self.returns[self._parents] + reward

  def branch(self, kept: np.ndarray) -> np.ndarray:
    """Branches the worlds `kept`; returns the source of each world, [W]."""
    self._parents = np.repeat(np.resize(kept, self._beams), self._modes)
    self.distinct = np.arange(len(self.commands)) < len(kept) * self._modes
    return self._parents

  def solution(
    self, alive: np.ndarray, reached: np.ndarray, knots: int
  ) -> Solution:
    """Returns the plans, padded to `knots`, by how they ended, [W] each."""
    missing = knots - self._plans.shape[1]
    success = reached & self.distinct
    order = np.lexsort((-self.returns, ~alive, ~success))
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
  """Searches plans, with beams spread over place, mode and phase.

  At each knot every kept state is continued with every mode. The new states
  fall into cells by place, mode and phase, and the best of every cell are kept
  in turns, so that the beams do not all stand at one edge, or jump at one
  moment, and fall together.

  Args:
    problem: of `config.beams` times the number of modes worlds.
    config: of one attempt.
    report: called with the knot, the best return, and the least distance from
      the goal along x.

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
    if not worth.any():  # Nobody is left to reach it.
      return front.solution(progress.alive, worth, knots)
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
  rest = problem.rest()
  return front.solution(rest.alive, rest.reached, knots)


def _nearest(
  problem: problem_lib.ReachingProblem, progress: problem_lib.Progress
) -> float:
  """Returns the least distance from the goal along x, metres."""
  ahead = np.abs(problem.config.goal[0] - progress.position[:, 0])
  return float(ahead[progress.alive].min())


def _select(
  cells: np.ndarray, returns: np.ndarray, worth: np.ndarray, count: int
) -> np.ndarray:
  """Returns the worlds to keep, at most `count`.

  The best of every cell come first, then the second best of every cell, and so
  on.

  Args:
    cells: D cell indices of the W worlds, [D, W].
    returns: of their plans so far, [W].
    worth: mask of the worlds that may be kept, [W].
    count: maximum to keep.
  """
  candidates = np.flatnonzero(worth)
  candidates = candidates[np.argsort(-returns[candidates], kind='stable')]
  seen: dict[tuple[float, ...], int] = {}
  ranks = np.zeros(len(candidates), dtype=np.int64)
  for i, cell in enumerate(map(tuple, cells.T[candidates])):
    ranks[i] = seen[cell] = seen.get(cell, -1) + 1
  return candidates[np.argsort(ranks, kind='stable')][:count]
