"""Tabular Q-learning over knots, the paper's planner (Sec. II-E).

The state is the index of a knot, the action the mode that is commanded there.
The robot is not part of the state, so that values of later knots are means over
different histories.
"""

from typing import Annotated, Callable

import numpy as np
import pydantic

from dmc_multimode.planner import beam_search
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.utils import config as config_lib


@config_lib.dataclass
class QLearningConfig:
  """Parameters of the planner.

  Attributes:
    trials: number of independent trials in parallel; the best plan counts.
    episodes: number of episodes of each trial.
    learning_rate: alpha, in (0, 1].
    discount: gamma from knot to knot, in [0, 1].
    initial_epsilon, final_epsilon: probability that a knot begins a random
      mode, in the first and in the last episode, linear between.
    exploration_time: mean duration of a random mode, seconds, in whole knots
      (temporally extended epsilon-greedy, Dabney et al. 2021); 0 for one knot,
      plain epsilon-greedy. Jumps take longer than a knot, and independent draws
      at each knot hardly ever try them.
  """

  trials: config_lib.PositiveInt = 5
  episodes: config_lib.PositiveInt = 100
  learning_rate: Annotated[float, pydantic.Field(gt=0, le=1)] = 0.5
  discount: config_lib.Share = 1.0
  initial_epsilon: config_lib.Share = 0.5
  final_epsilon: config_lib.Share = 0.05
  exploration_time: config_lib.NonNegative = 0.6

  @property
  def description(self) -> str:
    """Name of the search, for its progress."""
    return f'{self.trials} trials'

  def num_worlds(self, num_modes: int) -> int:
    """Returns the number of worlds that a search takes."""
    del num_modes
    return self.trials

  def rounds(self, knots: int) -> int:
    """Returns the number of reports of a search over so many knots."""
    del knots
    return self.episodes

  def search(
    self,
    problem: problem_lib.ReachingProblem,
    selector: object,
    report: Callable[[int, float, float], None],
    stop: object,
  ) -> beam_search.Solution:
    """Runs all trials; see `q_learning`. Nothing stops it before their end."""
    del selector, stop
    return q_learning(problem, self, report)

  def epsilon(self, episode: int) -> float:
    """Returns epsilon in an episode, counted from 0."""
    share = episode / max(self.episodes - 1, 1)
    return self.initial_epsilon + share * (
      self.final_epsilon - self.initial_epsilon
    )


class QTables:
  """One table for each of T independent trials."""

  def __init__(
    self,
    trials: int,
    knots: int,
    modes: int,
    config: QLearningConfig,
    knot_duration: float = 1.0,
  ):
    """Initialises the tables with zeros, [T, K, M].

    Args:
      trials, knots, modes: T, K and M.
      config: of the planner.
      knot_duration: seconds from knot to knot.
    """
    self._config = config
    self._persistence = 1 - min(
      knot_duration / max(config.exploration_time, knot_duration), 1.0
    )
    self.values = np.zeros((trials, knots, modes))
    self._exploring = np.zeros(trials, dtype=bool)
    self._explored = np.zeros(trials, dtype=np.int64)

  def act(
    self, knot: int, epsilon: float, random_state: np.random.RandomState
  ) -> np.ndarray:
    """Returns epsilon-greedy modes at a knot, ties broken by chance, [T]."""
    values = self.values[:, knot]
    trials, modes = values.shape
    best = values == values.max(axis=1, keepdims=True)
    greedy = np.argmax(best * random_state.uniform(0.5, 1, best.shape), axis=1)
    drawn = random_state.randint(modes, size=(trials,))
    lasts = random_state.uniform(size=trials) < self._persistence
    going_on = lasts & self._exploring & (knot > 0)
    begin = ~going_on & (random_state.uniform(size=trials) < epsilon)
    self._explored[begin] = drawn[begin]
    self._exploring = going_on | begin
    return np.where(self._exploring, self._explored, greedy)

  def update(self, plans: np.ndarray, rewards: np.ndarray) -> None:
    """Updates the tables by one episode of each trial, last knot first.

    Args:
      plans: commanded modes, [T, K].
      rewards: of the knots, [T, K].
    """
    config, rows = self._config, np.arange(len(plans))
    following = np.zeros(len(plans))
    for knot in reversed(range(plans.shape[1])):
      cell = rows, knot, plans[:, knot]
      target = rewards[:, knot] + config.discount * following
      self.values[cell] += config.learning_rate * (target - self.values[cell])
      following = self.values[:, knot].max(axis=1)


def q_learning(
  problem: problem_lib.ReachingProblem,
  config: QLearningConfig,
  report: Callable[[int, float, float], None] = lambda *args: None,
) -> beam_search.Solution:
  """Returns the plans of all episodes, best first.

  Args:
    problem: of as many worlds as trials.
    config: of the planner.
    report: called with the number of episodes, the best return, and the least
      final distance from the goal along x.

  Raises:
    ValueError: the problem has another number of worlds.
  """
  trials, knots = config.trials, problem.knots
  if problem.num_worlds != trials:
    raise ValueError(
      f'{trials} trials need as many worlds, not {problem.num_worlds}.'
    )
  tables = QTables(
    trials, knots, problem.num_modes, config, problem.config.knot_duration
  )
  random_state = np.random.RandomState(problem.config.seed)
  plans = np.zeros((config.episodes, trials, knots), dtype=np.int64)
  returns = np.zeros((config.episodes, trials))
  success = np.zeros((config.episodes, trials), dtype=bool)
  nearest = np.inf
  for episode in range(config.episodes):
    epsilon, rewards = config.epsilon(episode), np.zeros((trials, knots))
    problem.reset()
    for knot in range(knots):
      modes = tables.act(knot, epsilon, random_state)
      progress = problem.run_knot(modes)
      plans[episode, :, knot], rewards[:, knot] = modes, progress.reward
    tables.update(plans[episode], rewards)
    returns[episode] = rewards.sum(axis=1)
    success[episode] = problem.rest().reached
    ahead = np.abs(problem.config.goal[0] - progress.position[:, 0])
    nearest = min(nearest, ahead[progress.alive].min(initial=np.inf))
    report(episode + 1, float(returns[: episode + 1].max()), float(nearest))
  order = np.lexsort((-returns.ravel(), ~success.ravel()))
  return beam_search.Solution(
    plans.reshape(-1, knots)[order],
    returns.ravel()[order],
    success.ravel()[order],
    config.episodes * trials,
  )
