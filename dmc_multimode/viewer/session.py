"""Live session: a policy that takes commands while it runs.

The caller calls `step` once a control period and other methods in between, all
from one thread. A search for a plan runs in its own thread.
"""

from typing import NamedTuple, Sequence

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import guided_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import solver
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.viewer import autopilot as autopilot_lib
from dmc_multimode.viewer import blends as blends_lib
from dmc_multimode.viewer import disturbing
from dmc_multimode.viewer import live_track
from dmc_multimode.viewer import plan_search
from dmc_multimode.viewer import rollout
from dmc_multimode.viewer import survival as survival_lib

CLOCK_RATES = (0.5, 3.0)  # The slowest and the fastest.
PUSH_SPEEDS = (0.0, 3.0)  # m/s.
MOST_SEEDS = 2**32 - 1  # The largest seed that numpy takes.
ENDLESS, ARENAS = live_track.ENDLESS, live_track.NAMES
SPEED_STEP = blends_lib.STEP  # Of the share of a gait's speed.
_LIE = 1.2  # Seconds from a fall to the reset.
_FALLEN = terminations.CAUSES[terminations.BASE_HEIGHT]
_INVALID = terminations.CAUSES[terminations.NON_FINITE]


class LiveState(NamedTuple):
  """State of a session after a step.

  Attributes:
    step: of the robot; the last finite one after a divergence. Of a blend, its
      mode is the one that `blends.Blends.main` names.
    running: name of the mode or blend that runs.
    survival: how long the robot has stayed up, and how often it has fallen.
    down: whether the robot has fallen, or its state is not finite.
    notice: message for people; may be empty.
    searching: progress of the search for a plan; None without one.
    plan: last plan found for this track; None before.
    replaying: whether the plan is being carried out.
  """

  step: rollout.Step
  running: str
  survival: survival_lib.Survival
  down: bool
  notice: str
  searching: solver.Status | None
  plan: plan_lib.PlanResult | None
  replaying: bool


class LiveSession:
  """A policy on a track that takes commands; starts in its first mode.

  Attributes:
    robot: roll-out of the policy; a new one for every track.
    arena: name of the track, one of `ARENAS`.
    seed: of the track, if it is random, and of the initial state's noise.
    autopilot: whether the selector commands the robot.
    clock_rate: of the modes, 1 being their own.
    speed: share of the speed of gaits, by a blend with the mode of rest.
    blends: of the policy's modes, which `blend` commands.
    notice: see `LiveState`.
  """

  def __init__(
    self,
    policy: pretrained.Policy,
    arena: str = 'flat',
    seed: int = 0,
    planner: solver.SearchConfig | None = None,
    threads: int = 1,
    disturbed: events.TrainingEvents = events.NONE,
    selector: selector_lib.Selector | None = None,
    difficulty: float = 0.5,
  ):
    """Compiles the model of the track.

    Args:
      policy: to run.
      arena: name of a track.
      seed: see the class.
      planner: configuration of the planner; by default a guided search with a
        selector, and a beam search without.
      threads: of the planner's physics.
      disturbed: result of `events.fixed`; plans are made for the nominal robot.
      selector: for the autopilot and the guided search.
      difficulty: of the endless track, 0 to 1.

    Raises:
      ValueError: the track is unknown, a number out of bounds, or the selector
        of another policy.
    """
    self._policy = policy
    self._planner = planner or (
      guided_search.GuidedConfig() if selector else beam_search.BeamConfig()
    )
    self._mode_set, self._threads = policy.mode_set, threads
    self.blends = blends_lib.Blends(policy.mode_set)
    self.speed = 1.0
    self._survival = survival_lib.SurvivalCount()
    self._replayed: plan_lib.ModePlan | None = None
    self._search: plan_search.PlanSearch | None = None
    self._disturbed = disturbed
    self._selector, self._difficulty = selector, difficulty
    self._pilot: autopilot_lib.Autopilot | None = None
    self.autopilot = False
    self.clock_rate = 1.0
    self.set_arena(arena, seed)

  @property
  def modes(self) -> tuple[str, ...]:
    """Names of the modes that the policy knows."""
    return self._mode_set.names

  @property
  def has_selector(self) -> bool:
    """True if there is an autopilot."""
    return self._selector is not None

  def set_arena(self, name: str, seed: int = 0) -> None:
    """Moves the robot to the start of another track; drops the plan.

    Raises:
      ValueError: the track is unknown, or the seed is no seed.
    """
    if not 0 <= seed <= MOST_SEEDS:
      raise ValueError(f'seed must be within 0 and {MOST_SEEDS}, got {seed}.')
    task = multimode_biped.make_task(
      self.blends.mode_set,
      # The same initial state as in a search.
      episodes.ScheduledEpisodes(schedule_lib.single(np.zeros(1))),
      live_track.make(name, self._difficulty),
      task_config.evaluated(
        self._policy.config,
        limits=terminations.NO_LIMITS,
        events=self._disturbed,
      ),
    )
    limits = terminations.falls_alone(self._policy.config.limits)
    self.robot = rollout.Robot(self._policy, task, limits, seed)
    self.arena, self.seed = name, seed
    self.close()
    self._plan: plan_lib.PlanResult | None = None
    self.robot.start()
    self._survival.restart()
    if self._selector:
      self._pilot = autopilot_lib.Autopilot(
        self._selector,
        self._policy,
        self.robot,
        live_track.goal(self.robot, name, seed),
      )
    self._start('')

  def set_autopilot(self, on: bool) -> None:
    """Hands the robot over to the selector, or takes it back.

    Raises:
      ValueError: there is no selector.
    """
    if on and self._pilot is None:
      raise ValueError('There is no selector: start with --selector=FOLDER.')
    self.autopilot = on
    if on:
      self._replayed = None
      self.set_clock_rate(1.0)

  def reset(self) -> None:
    """Resets the robot to the start of the track."""
    self.robot.reset()
    self._start()

  def dismiss(self) -> None:
    """Clears the notice, which stays until then or until the next one."""
    self.notice = ''

  def _start(self, notice: str | None = None) -> None:
    """Clears the state of before a reset; keeps the notice if None."""
    if notice is not None:
      self.notice = notice
    self._replayed = None
    self._lying, self._last = 0, self.robot.here()
    self.set_clock_rate(self.clock_rate)

  def command(self, mode: str) -> None:
    """Commands a mode; the running one continues.

    A mode that climbs or descends runs at its own clock rate.

    Raises:
      ValueError: the policy does not know the mode, or the mode needs a ledge
        and the track has no segment left.
    """
    self._mode_set.index(mode)  # Raises for what is none of the policy's.
    self._replayed, self.autopilot = None, False
    blend = self.blends.slower(mode, self.speed)
    index = self.robot.task.mode_set.index(blend or mode)
    if self.robot.task.mode_set.motions[index].ledge and self.clock_rate != 1:
      self.set_clock_rate(1.0)
      self.notice = f'{mode} keeps its own clock rate.'
    self.robot.command(index)

  def command_next(self, steps: int) -> None:
    """Commands the mode that is so many after the running one, in a ring."""
    index = self.modes.index(self.blends.main(self.robot.task.mode))
    self.command(self.modes[(index + steps) % len(self.modes)])

  def blend(self, first: str, second: str, share: float) -> None:
    """Commands a blend of two modes, whatever the speed of gaits is.

    Args:
      first, second: names of modes.
      share: of the second, one of 0, 0.1, ... 1.

    Raises:
      ValueError: the modes cannot be blended, or the share is another.
    """
    name = self.blends.find(first, second, share)
    if name is None:
      raise ValueError(f'{first} and {second} cannot be blended.')
    self._replayed, self.autopilot = None, False
    self.robot.command(self.robot.task.mode_set.index(name))

  def disturbance(self, name: str) -> float:
    """Returns one of `disturbing.RANGES` as it is."""
    return disturbing.value(self._disturbed, name)

  def disturb(self, **values: float) -> None:
    """Changes what is wrong with the robot from now on, where it is.

    Args:
      **values: by the names of `disturbing.RANGES`; others stay.

    Raises:
      ValueError: a number is out of bounds; all is as before.
    """
    changed = disturbing.changed(self._disturbed, **values)
    self.robot.set_events(changed)
    self._disturbed = changed
    self._survival.restart()

  def push(self, velocity: Sequence[float]) -> None:
    """Adds to the velocity of the trunk, world m/s (x, y).

    Raises:
      ValueError: the velocity is not finite, or out of `PUSH_SPEEDS`.
    """
    x, y = velocity
    if not np.hypot(x, y) <= PUSH_SPEEDS[1]:
      raise ValueError(f'A push adds at most {PUSH_SPEEDS[1]} m/s.')
    self.robot.push((x, y, 0.0))

  def set_speed(self, speed: float) -> None:
    """Sets the share of their speed with which gaits run from now on.

    Raises:
      ValueError: the share is not one of 0.1, 0.2, ... 1.
    """
    steps = speed / SPEED_STEP
    if not (0.5 < steps < 10.5 and abs(steps - round(steps)) < 1e-6):
      raise ValueError(f'A speed is one of 0.1, 0.2, ... 1, got {speed}.')
    self.speed = round(steps) * SPEED_STEP
    mode = self.blends.main(self.robot.task.mode)
    if self.blends.slower(mode, SPEED_STEP):
      self.command(mode)

  def set_clock_rate(self, rate: float) -> None:
    """Sets the rate at which the modes run from now on.

    Raises:
      ValueError: the rate is not within `CLOCK_RATES`, or so fast that a cycle
        of a mode is shorter than a control step.
    """
    slowest, fastest = CLOCK_RATES
    if not slowest <= rate <= fastest:
      raise ValueError(
        f'The clock rate must be within {slowest} and {fastest}, got {rate}.'
      )
    tracker = self.robot.task.core.tracker
    tracker.check_rate(rate)
    self.clock_rate = rate
    tracker.state.clock_rate[:] = rate

  def plan(self) -> None:
    """Starts the search for a plan across this track, from its start.

    Raises:
      ValueError: a search is running.
    """
    if self._search:
      raise ValueError('A plan is being searched for already.')
    if self.arena == live_track.ENDLESS:
      raise ValueError('An endless track has no goal to plan to.')
    terrain = self.robot.task.root_entity.terrain
    problem = reaching.problem(self.arena, terrain, self.seed)
    self._search = plan_search.PlanSearch(
      self._policy,
      self.arena,
      problem,
      self._planner,
      self._threads,
      self._selector,
    )

  def replay(self) -> None:
    """Carries out the plan from the start, at the modes' own clock rate.

    Raises:
      ValueError: there is no plan for this track.
    """
    if self._plan is None:
      raise ValueError('There is no plan for this track yet.')
    self.clock_rate, self.autopilot = 1.0, False
    self.reset()
    self._replayed = self._plan.plan

  def step(self) -> LiveState:
    """Advances by one control step; resets a robot some time after a fall."""
    self._take_plan()
    live_track.extend(self.robot)
    self._follow_plan()
    self._follow_pilot()
    if not self.robot.over:
      self._last = self.robot.step()
    if self.robot.over:  # Without limits: it diverged.
      self._last = self._last._replace(cause=_INVALID)
    if self._lying or self._last.cause in (_FALLEN, _INVALID):
      self._lie()
    else:
      self._survival.stand(self.robot.task.control_timestep)
    return LiveState(
      self._last._replace(mode=self.blends.main(self._last.mode)),
      self._last.mode,
      self._survival.now,
      self._lying > 0,
      self.notice,
      self._search.status if self._search else None,
      self._plan,
      self._replayed is not None,
    )

  def close(self) -> None:
    """Cancels a running search."""
    if self._search:
      self._search.cancel()
    self._search = None

  def _lie(self) -> None:
    """Counts the time since a fall, then resets the robot."""
    if not self._lying:
      fell = self._last.cause == _FALLEN
      self.notice = 'It has fallen.' if fell else 'Its state is not finite.'
      self._replayed = None
      self._survival.fall()
    self._lying += 1
    if self._lying * self.robot.task.control_timestep > _LIE:
      # The obstacles of an endless track would fell it at the same place again.
      anew = self.arena == ENDLESS
      self.robot.reset(anew)
      where = 'on new ground' if anew else 'back to the start'
      self._start(f'{self.notice} It was put {where}.')

  def _take_plan(self) -> None:
    """Takes the result of a finished search."""
    if not (self._search and self._search.done):
      return
    finished, self._search = self._search, None
    try:
      self._plan = finished.result()
    except ValueError as error:
      self.notice = f'No plan: {error}'
      return
    fate = 'reaches the goal' if self._plan.success else 'falls short'
    self.notice = (
      f'A plan that {fate}, found in {self._plan.solve_seconds:.1f} s.'
    )

  def _follow_pilot(self) -> None:
    """Issues the selector's mode."""
    if self.autopilot and self._pilot and not (self._lying or self.robot.over):
      mode = self._pilot.choose()
      if mode is not None:
        self.robot.command(mode)

  def _follow_plan(self) -> None:
    """Issues the active plan's mode for the current knot."""
    if self._replayed is None:
      return
    mode = plan_search.mode_at(self._replayed, self.robot)
    if mode == plan_search.DONE:
      self._replayed, self.notice = None, 'The plan is done.'
      self.robot.command(plan_lib.rest_mode(self._mode_set))
    elif mode:
      self.robot.command(self._mode_set.index(mode))
