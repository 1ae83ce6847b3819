"""Receding-horizon planning, from the current state of the robot.

The planner knows the robot's state at the knot of planning, but not the pushes
that follow, nor what disturbs the robot. It plans to the end, the robot follows
for some knots, and it plans again. If the rest of the former plan still
succeeds in simulation, it is kept.
"""

import contextlib
import dataclasses
import os
import time
from typing import Any, Iterator, Mapping, Sequence

import numpy as np

from dmc_multimode.arenas import track
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import guided_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.reaching import environment as reaching_env
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import progress_bar


def solve(
  policy: str | os.PathLike[str] | reaching.Policy,
  arena: str = 'gap_block',
  seed: int = 0,
  problem: reaching.ReachingConfig | None = None,
  sizes: Mapping[str, float] | None = None,
  planner: str | solver_lib.PlannerConfig | None = None,
  pushes: Sequence[pushes_lib.Push] = (),
  replan_every: int = 0,
  num_threads: int = 0,
  quiet: bool = False,
  seconds: float | None = None,
  disturbed: events_lib.TrainingEvents = events_lib.NONE,
  map_error: float = 0.0,
) -> plan_lib.PlanResult:
  """Plans across a track, once or, with `replan_every`, again on the way.

  Without a budget of `seconds` the result depends on nothing but the arguments;
  with one also on the speed of the machine.

  Args:
    policy: name of a shipped policy, a folder, or a policy object.
    arena: name of the track: flat, gap, plateau, block, block_down, gap_block,
      stairs, stepping_stones, slope, rough, parkour, obstacle_course or
      gaps_and_blocks; or several, joined by +, one of which is drawn.
    seed: of the track, if it is random, and of the initial state's noise.
    problem: goal, knots and seed; by default those of the track, and `seed`.
    sizes: of the track, metres, where they are not its defaults.
    planner: 'beam', 'guided', 'q_learning' or 'selector', or a configuration:
      a `BeamConfig`, `GuidedConfig`, `QLearningConfig` or `SteeringConfig`
      (`planner.steering`). A selector sees the robot and the ground at every
      knot, and does not plan; a guided search samples its plans from one, and
      has its knots. By default a guided search for a policy with a selector
      beside it, and a beam search for others.
    pushes: on the robot, at knots; unknown to the planner.
    replan_every: knots after which to plan again; 0 for never, an open loop.
    num_threads: of the physics; 0 takes every core.
    quiet: hides the progress bar.
    seconds: wall-clock budget of each planning, checked at knots; compilation
      of worlds does not count. A search that fails then begins anew with
      twice the beams or samples, up to 4096, until the time is up, whatever its
      `attempts`, and is ended in mid-search if need be. None for no budget.
    disturbed: of the robot and the ground, see `events.fixed`; searches are for
      the nominal ones. An action delay is at most two control steps.
    map_error: by which all edges are nearer where a search plans than where the
      robot is, metres. A selector has no map; see `SteeringConfig.scan_errors`.

  Returns:
    The best plan found, successful or not, as the robot carried it out.

  Raises:
    FileNotFoundError, TypeError: `policy` is not a policy, or it has no
      selector.
    ValueError: the track, a size or the planner is unknown, the goal is not
      over the track, a knot is not a whole number of control steps, a push is
      not at a knot, or `seconds` is not positive and finite, or `seconds` or
      `map_error` is not for this planner.
  """
  import torch  # Late: reading a plan's file needs no torch.

  if isinstance(planner, str):
    if planner not in solver_lib.PLANNERS:
      raise ValueError(
        f'Unknown planner {planner!r}; there are '
        f'{", ".join(solver_lib.PLANNERS)}.'
      )
    planner = solver_lib.PLANNERS[planner]
  _check_replanning(replan_every)
  solver_lib.check_seconds(seconds, planner or beam_search.BeamConfig())
  if map_error and isinstance(planner, steering.SteeringConfig):
    raise ValueError('A selector has no map, and no map_error: scan_errors.')
  terrain = track.make(arena, sizes=sizes).generate(np.random.RandomState(seed))
  problem = problem or reaching.problem(arena, terrain, seed)
  pushes_lib.by_knot(pushes, problem.knots, problem.knot_duration)
  if planner is None:
    planner = solver_lib.PLANNERS[solver_lib.default_name(policy)]
  origin: dict[str, Any] = {
    'replan_every': replan_every,
    'planner': solver_lib.name_of(planner),
  }
  if isinstance(policy, (str, os.PathLike)):
    origin['policy'] = os.fspath(policy)
  # Batches are small: the physics has the cores.
  threads = torch.get_num_threads()
  torch.set_num_threads(1)
  try:
    if isinstance(planner, steering.SteeringConfig):
      course = plan_lib.Course(arena, dict(sizes or {}), seed, tuple(pushes))
      found = _steer(policy, course, problem, planner, disturbed)
      return dataclasses.replace(found, origin={**found.origin, **origin})
    selector = None
    if isinstance(planner, guided_search.GuidedConfig):
      selector = steering.load(planner.steering, policy)
    solver = solver_lib.Solver(
      reaching_env.load_policy(policy),
      arena,
      problem,
      planner,
      num_threads,
      sizes,
      seconds,
      selector=selector,
      map_error=map_error,
    )
    with _progress(planner, quiet) as report:
      found = follow(solver, pushes, replan_every, report, disturbed)
  finally:
    torch.set_num_threads(threads)
  return dataclasses.replace(found, origin=origin)


def _steer(
  policy: str | os.PathLike[str] | reaching.Policy,
  course: plan_lib.Course,
  problem: reaching.ReachingConfig,
  config: steering.SteeringConfig,
  disturbed: events_lib.TrainingEvents,
) -> plan_lib.PlanResult:
  """Returns what a selector commands across a track, as a plan."""
  selector = steering.load(config, policy)
  robot = problem_lib.ReachingProblem(
    reaching_env.load_policy(policy),
    track.make(course.arena, sizes=course.sizes),
    reaching.in_knots(problem, selector.knot_duration),
    1,
    1,
    course.pushes,
    config.scan_errors,
    disturbed,
  )
  began = time.perf_counter()
  steered = steering.steer(robot, selector)
  found = solver_lib.pack(
    robot,
    course,
    steered.modes,
    steered.trials,
    time.perf_counter() - began,
    1,
    robot.control_steps,
  )
  return dataclasses.replace(found, origin=steering.details(steered))


@contextlib.contextmanager
def _progress(
  planner: solver_lib.SearchConfig, quiet: bool
) -> Iterator[solver_lib.Report]:
  """Yields a `Report` that shows a progress bar, reset for every search."""
  learns = solver_lib.name_of(planner) == 'q_learning'
  unit = 'episode' if learns else 'knot'
  with progress_bar.Bar(unit=unit, disable=quiet) as bar:

    def report(status: solver_lib.Status) -> None:
      if status.done <= bar.n:
        bar.reset()
      bar.total = status.total
      bar.set_description(status.search, refresh=False)
      bar.set_postfix_str(
        f'return {status.best:.1f}, {status.distance:.2f} m to go',
        refresh=False,
      )
      bar.update(status.done - bar.n)

    yield report


def _check_replanning(every: int) -> None:
  """Raises ValueError if `every` is negative."""
  if every < 0:
    raise ValueError(f'replan_every must not be negative, got {every}.')


def follow(
  solver: solver_lib.Solver,
  pushes: Sequence[pushes_lib.Push] = (),
  every: int = 0,
  report: solver_lib.Report = lambda status: None,
  disturbed: events_lib.TrainingEvents = events_lib.NONE,
) -> plan_lib.PlanResult:
  """Moves a robot to the goal; plans at the start and on the way.

  Args:
    solver: planner.
    pushes: on the robot, each right after the planning at its knot.
    every: knots between plannings; 0 for an open loop.
    report: progress of the searches.
    disturbed: of the robot; see `solve`.

  Returns:
    The commanded modes and their result, pushes and disturbances included; the
    costs are those of all plannings.

  Raises:
    ValueError: `every` is negative, or a push is not at a knot.
  """
  _check_replanning(every)
  robot = solver.make_robot(pushes, disturbed)
  every = every or robot.knots
  plan: np.ndarray | None = None
  executed: list[int] = []
  plannings: list[plan_lib.PlanResult] = []
  knots: list[problem_lib.Progress] = []
  while robot.remaining:
    if plan is None or robot.alive[0]:  # After a fall there is nothing to plan.
      plannings.append(solver.solve(report, robot, plan))
      plan = plannings[-1].plan.indices(robot.mode_set)
    now, plan = plan[:every], plan[every:]
    knots += [robot.run_knot(mode[None]) for mode in now]
    executed += now.tolist()
  return solver.result(
    executed,
    problem_lib.trials(knots, robot.rest()),
    sum(found.solve_seconds for found in plannings),
    sum(found.rollouts for found in plannings),
    sum(found.control_steps for found in plannings),
    pushes,
  )
