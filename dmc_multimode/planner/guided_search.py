"""Guided search: plans sampled from a selector, weeded out by its values.

A selector commands many robots at once: one takes the likeliest modes, the
others sample, each at a higher temperature than the one before, so that plans
are found which the selector itself would hardly choose. A robot that falls goes
on from the state of one that stands and has the best prospects, by the
selector's values, as particles are resampled in sequential Monte Carlo. The
search ends as soon as a robot stands at the goal.
"""

import dataclasses
from typing import Callable, Iterator, TYPE_CHECKING

import numpy as np

from dmc_multimode.planner import beam_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import steering
from dmc_multimode.utils import config as config_lib

if TYPE_CHECKING:
  from dmc_multimode.planner import selector as selector_lib


@config_lib.dataclass
class GuidedConfig:
  """Parameters of the planner.

  Attributes:
    samples: robots that a selector commands at once.
    attempts: number of such searches until a plan succeeds, each with twice the
      samples of the one before; a beam search follows. With a budget of seconds
      it does not matter, and none follows.
    temperature: of the last robot; see `Selector.sample`.
    folder: of the selector; by default the one beside the policy.
  """

  samples: config_lib.PositiveInt = 32
  attempts: config_lib.PositiveInt = 2
  temperature: config_lib.Positive = 8.0
  folder: str = ''

  @property
  def steering(self) -> steering.SteeringConfig:
    """Configuration that names the folder of the selector."""
    return steering.SteeringConfig(self.folder)

  @property
  def description(self) -> str:
    """Name of the search, for its progress."""
    return f'{self.samples} samples'

  def num_worlds(self, num_modes: int) -> int:
    """Returns the number of worlds that a search takes."""
    del num_modes
    return self.samples

  def rounds(self, knots: int) -> int:
    """Returns the number of reports of a search over so many knots."""
    return knots

  def search(
    self,
    problem: problem_lib.ReachingProblem,
    selector: 'selector_lib.Selector | None',
    report: Callable[[int, float, float], None],
    stop: Callable[[float], bool],
  ) -> beam_search.Solution:
    """Runs one search; see `guided_search`. A `Solver` has its selector."""
    assert selector is not None
    return guided_search(problem, selector, report, stop, self.temperature)

  def escalation(self) -> 'list[GuidedConfig | beam_search.BeamConfig]':
    """Returns one config per attempt, and those of the beam search."""
    return [
      *(
        dataclasses.replace(self, samples=self.samples << i, attempts=1)
        for i in range(self.attempts)
      ),
      *beam_search.BeamConfig().escalation(),
    ]

  def doubling(self) -> 'Iterator[GuidedConfig]':
    """Yields configs with ever more samples, for as long as there is memory."""
    for samples in beam_search.doublings(self.samples):
      yield dataclasses.replace(self, samples=samples, attempts=1)


def guided_search(
  problem: problem_lib.ReachingProblem,
  selector: 'selector_lib.Selector',
  report: Callable[[int, float, float], None] = lambda *args: None,
  stop: Callable[[float], bool] = lambda ahead: False,
  temperature: float = GuidedConfig.temperature,
) -> beam_search.Solution:
  """Samples plans from a selector, one a world.

  Args:
    problem: of the track; its knots are as long as the selector's.
    selector: of the problem's policy.
    report, stop: see `beam_search`.
    temperature: see `GuidedConfig`.

  Returns:
    Plans of the knots, which go on with rest where the search ended earlier:
    those of the robots that stand at the goal come first, by their returns so
    far.

  Raises:
    ValueError: the selector is of another policy.
  """
  steering.check(selector, problem.mode_set.names, problem.layout)
  worlds, knots = problem.num_worlds, problem.knots
  random_state = np.random.RandomState(problem.config.seed)
  problem.reset()
  plans = np.full((worlds, knots), problem.rest_mode)
  returns, rollouts = np.zeros(worlds), 0
  alive = standing = np.zeros(worlds, dtype=bool)
  for knot in range(knots):
    modes = selector.sample(
      problem.observe(), problem.obeyed(), random_state, temperature
    )
    progress = problem.run_knot(modes)
    plans[:, knot] = modes
    returns += progress.reward
    rollouts += worlds
    alive, standing = progress.alive, problem.reached()
    if not alive.any():
      break
    nearest = beam_search.nearest(problem, progress)
    report(knot + 1, float(returns[alive].max()), nearest)
    least = beam_search.least_work(problem.config.knot_duration, worlds)
    if standing.any() or stop(plan_lib.REST if knot == knots - 1 else least):
      break
    if knot < knots - 1 and not alive.all():
      sources = _resampled(alive, selector.values(problem.observe()))
      problem.copy_state(sources)
      plans, returns = plans[sources], returns[sources]
  rest = problem.rest(standing if standing.any() else alive)
  order = np.lexsort((-returns, ~rest.alive, ~rest.reached))
  return beam_search.Solution(
    plans[order], returns[order], rest.reached[order], rollouts
  )


def _resampled(alive: np.ndarray, values: np.ndarray) -> np.ndarray:
  """Returns the world from which each goes on, [B].

  Args:
    alive: mask of the robots that stand, at least one, [B].
    values: the selector's, of the robots as they are, [B].
  """
  sources = np.arange(len(alive))
  best = np.flatnonzero(alive)
  best = best[np.argsort(-values[best], kind='stable')]
  sources[~alive] = np.resize(best, (~alive).sum())
  return sources
