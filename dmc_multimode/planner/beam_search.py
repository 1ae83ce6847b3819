"""Beam search over modes that copies the worlds' states at the knots."""

from typing import Callable, Iterator, NamedTuple

import numpy as np

from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.utils import config as config_lib

_CELL = 0.15  # Metres: length of a cell along the track.
_PHASES = 4  # Cells of a mode's phase.
# Beams up to which `BeamConfig.doubling` goes. A world takes some 8 kB, and a
# search of more would take a quarter of an hour and gigabytes.
_MOST_BEAMS = 4096
_RESTED = 32  # Worlds that rest where a search is stopped.
# Share of a knot's time that worlds take which are not moved, as measured.
_OVERHEAD = 0.25


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
      beams of the one before. With a budget of seconds it does not matter.
  """

  beams: config_lib.PositiveInt = 24
  attempts: config_lib.PositiveInt = 3

  @property
  def description(self) -> str:
    """Name of the search, for its progress."""
    return f'{self.beams} beams'

  def num_worlds(self, num_modes: int) -> int:
    """Returns the number of worlds that a search takes."""
    return self.beams * num_modes

  def rounds(self, knots: int) -> int:
    """Returns the number of reports of a search over so many knots."""
    return knots

  def search(
    self,
    problem: problem_lib.ReachingProblem,
    selector: object,
    report: Callable[[int, float, float], None],
    stop: Callable[[float], bool],
  ) -> Solution:
    """Runs one search; see `beam_search`. It needs no selector."""
    del selector
    return beam_search(problem, self, report, stop)

  def escalation(self) -> 'list[BeamConfig]':
    """Returns one config per attempt, doubling `beams` each time."""
    return [BeamConfig(self.beams << i, 1) for i in range(self.attempts)]

  def doubling(self) -> 'Iterator[BeamConfig]':
    """Yields the configs of `escalation`, for as long as there is memory."""
    for beams in doublings(self.beams):
      yield BeamConfig(beams, 1)


def doublings(count: int) -> Iterator[int]:
  """Yields a count of beams or samples and its doubles, up to 4096."""
  yield count
  while (count := 2 * count) <= _MOST_BEAMS:
    yield count


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

  @property
  def rollouts(self) -> int:
    """Number of parts of plans, of a knot each, so far."""
    return self._plans.size

  def solution(
    self, alive: np.ndarray, reached: np.ndarray, knots: int, filler: int = 0
  ) -> Solution:
    """Returns the plans by how they ended.

    Args:
      alive, reached: masks of the worlds that have not fallen, and that stand
        at the goal, [W].
      knots: length to which the plans are padded.
      filler: mode index to pad with.
    """
    missing = knots - self._plans.shape[1]
    success = reached & self.distinct
    order = np.lexsort((-self.returns, ~alive, ~success))
    order = order[self.distinct[order]]
    plans = np.pad(self._plans, ((0, 0), (0, missing)), constant_values=filler)
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
  stop: Callable[[float], bool] = lambda ahead: False,
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
    stop: called after each knot with the seconds that would be simulated until
      the search ends, were it to be stopped at the next knot; ends the search
      if true.

  Returns:
    The plans of the last knot. Where the search is stopped some of the robots
    rest, and the plans, which go on with rest, begin with those of the robots
    that then stand, by their returns so far.

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
    report(knot + 1, best, nearest(problem, progress))
    is_last = knot == knots - 1
    duration = problem.config.knot_duration
    place = np.floor(progress.position[:, 0] / _CELL)
    if stop(plan_lib.REST if is_last else least_work(duration, len(worth))):
      return _stopped(problem, front, place, worth)
    if not is_last:
      phase = np.floor(problem.phase * _PHASES)
      cells = np.stack([place, front.commands, phase])
      kept = _select(cells, front.returns, worth, beams)
      problem.copy_state(front.branch(kept))
  rest = problem.rest()
  return front.solution(rest.alive, rest.reached, knots)


def least_work(knot_duration: float, worlds: int) -> float:
  """Returns the seconds to simulate in a knot after which a search is stopped.

  Few worlds rest then: that counts as the part of a knot that takes as long.

  Args:
    knot_duration: seconds.
    worlds: number of worlds of the search.
  """
  moved = min(1.0, _RESTED / worlds)
  return knot_duration + plan_lib.REST * (_OVERHEAD + (1 - _OVERHEAD) * moved)


def _stopped(
  problem: problem_lib.ReachingProblem,
  front: _Front,
  place: np.ndarray,
  worth: np.ndarray,
) -> Solution:
  """Returns the plans of a search that ends after a knot.

  The best may be in the air over a gap. So robots of every place rest, and the
  plans of those who then stand come first.

  Args:
    problem: of the search.
    front: its plans so far.
    place: cells of the robots along the track, [W].
    worth: mask of the plans that count, [W].
  """
  rested = np.zeros_like(worth)
  rested[_select(place[None], front.returns, worth, _RESTED)] = True
  rest = problem.rest(rested)
  stands = rest.alive & rested
  return front.solution(
    stands, rest.reached, problem.knots, problem.rest_mode
  )._replace(episodes=front.rollouts)


def nearest(
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
