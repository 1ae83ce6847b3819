"""Beam search over modes, with the worlds' states saved at the knots."""

import dataclasses
from typing import Callable, NamedTuple

import numpy as np

from dmc_multimode.planner import problem as problem_lib

_CELL = 0.15  # Metres: robots closer than this are in the same place.


class Solution(NamedTuple):
  """What a planner found.

  Attributes:
    plans: the best first, mode indices, [N, K].
    returns: of these, [N].
    success: whether they reached the goal when they were found, [N].
    episodes: plans that were tried, or parts of plans.
  """

  plans: np.ndarray
  returns: np.ndarray
  success: np.ndarray
  episodes: int


@dataclasses.dataclass(frozen=True)
class BeamConfig:
  """Parameters of the planner.

  Attributes:
    beams: states that are kept at each knot.
  """

  beams: int = 24

  def __post_init__(self) -> None:
    if self.beams < 1:
      raise ValueError(f'beams must be positive, got {self.beams}.')


def beam_search(
  problem: problem_lib.ReachingProblem,
  config: BeamConfig,
  report: Callable[[int, float, float], None] = lambda *args: None,
) -> Solution:
  """Follows the most promising plans, kept apart by place and mode.

  At each knot every kept state is continued under every mode. What is kept then
  is the best of each mode in each stretch of the track in turns, so that not
  all of them stand at one edge and fall together.

  Args:
    problem: of `config.beams` times the number of modes worlds.
    config: how many to keep.
    report: is told the knot, the best return, and the least distance from the
      goal along x.

  Raises:
    ValueError: the problem has another number of worlds.
  """
  beams, modes = config.beams, problem.num_modes
  if problem.num_worlds != beams * modes:
    raise ValueError(
      f'{beams} beams of {modes} modes need {beams * modes} worlds, the '
      f'problem has {problem.num_worlds}.'
    )
  knots = problem.config.knots
  problem.reset()
  commands = np.tile(np.arange(modes), beams)
  parents = np.zeros(beams * modes, dtype=np.int64)
  plans = np.zeros((beams * modes, 0), dtype=np.int64)
  returns = np.zeros(beams * modes)
  # All begin alike: at first only one beam is worth following.
  distinct = np.arange(beams * modes) < modes
  for knot in range(knots):
    progress = problem.run_knot(commands)
    plans = np.concatenate([plans[parents], commands[:, None]], axis=1)
    returns = returns[parents] + progress.reward
    worth = distinct & progress.alive
    if not worth.any():
      break
    report(knot + 1, float(returns[worth].max()), _nearest(problem, progress))
    if knot == knots - 1:
      break
    kept = _select(progress.position[:, 0], commands, returns, worth, beams)
    parents = np.repeat(np.resize(kept, beams), modes)
    distinct = np.arange(beams * modes) < len(kept) * modes
    problem.take(parents)
  finished = plans.shape[1] == knots
  success = progress.reached & distinct & finished
  order = np.lexsort((-returns, ~progress.alive, ~success))
  order = order[distinct[order]]
  plans = np.pad(plans, ((0, 0), (0, knots - plans.shape[1])))
  return Solution(
    plans[order], returns[order], success[order], beams * modes * knots
  )


def _nearest(
  problem: problem_lib.ReachingProblem, progress: problem_lib.Progress
) -> float:
  """Least distance from the goal along x of those that are alive, metres."""
  ahead = np.abs(problem.config.goal[0] - progress.position[:, 0])
  return float(ahead[progress.alive].min())


def _select(
  x: np.ndarray,
  commands: np.ndarray,
  returns: np.ndarray,
  worth: np.ndarray,
  count: int,
) -> np.ndarray:
  """Returns the worlds to go on from, at most `count`.

  The best of every cell of place and mode come first, then the second best of
  every cell, and so on.
  """
  candidates = np.flatnonzero(worth)
  candidates = candidates[np.argsort(-returns[candidates], kind='stable')]
  cells = np.stack([np.floor(x[candidates] / _CELL), commands[candidates]])
  seen: dict[tuple[float, ...], int] = {}
  ranks = np.zeros(len(candidates), dtype=np.int64)
  for i, cell in enumerate(map(tuple, cells.T)):
    ranks[i] = seen[cell] = seen.get(cell, -1) + 1
  return candidates[np.argsort(ranks, kind='stable')][:count]
