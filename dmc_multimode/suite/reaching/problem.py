"""Reaching a place by mode commands alone: goals, rewards, problems.

Krishna and Nguyen, Sec. II-E: a plan commands a mode at each of k knots, dt
seconds apart. It sees neither the robot nor the ground; a low-level policy
turns its commands into motion. Its return is the sum over the control steps of

    exp(-|goal - p|),   p: position of the trunk, world metres.

The goal is reached by a robot that stands there, upright and slow.
"""

import dataclasses
import math
from typing import Mapping, NamedTuple, Protocol

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.suite.imitation import config as imitation_config
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import constants
from dmc_multimode.utils import durations
from dmc_multimode.walkers import kinematics

_NEAR = np.array([0.25, 0.2, 0.12])  # Metres along x, y, z: bounds of reached.
_SLOW = 0.15  # m/s.
_UPRIGHT = 0.9  # Cosine of the trunk's tilt.
_EXACT = 1e-6  # Metres: rounding of sums.

RANDOM_TRACK = 'parkour'
_BEYOND = 0.4  # Metres behind the last edge of a track: its goal.
_SPEED = 0.3  # Least speed along the track that the knots suffice for, m/s.
_KNOT = 0.15  # Seconds.

AHEAD = tuple(0.05 * i for i in range(1, 31))  # Metres ahead.
GAP = -1.0  # Metres: value of `ground_ahead` over a gap.


class Policy(Protocol):
  """Policy that turns commands into motion; `pretrained.Policy` is one."""

  @property
  def mode_set(self) -> mode_set_lib.ModeSet:
    """Modes of the policy."""

  @property
  def config(self) -> imitation_config.ImitationConfig:
    """Task that it was trained for."""

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    """Returns mean joint targets [B, 10] for observations [B, D]."""


@config_lib.dataclass
class ReachingConfig:
  """Reaching problem: the goal and the knots of its plan.

  Attributes:
    goal: of the trunk in the world, metres (x, y, z).
    knots: number of mode commands in the plan.
    knot_duration: seconds from knot to knot.
    seed: of the terrain and the noise of the initial state.
  """

  goal: tuple[float, float, float] = (2.0, 0.0, 0.5)
  knots: config_lib.PositiveInt = 11
  knot_duration: config_lib.Positive = 0.3
  seed: config_lib.Count = 0


class Problem(NamedTuple):
  """A track of the paper's Table III.

  Attributes:
    goal: of the trunk, metres.
    knots: number of mode commands in a plan.
    knot_duration: seconds from knot to knot.
    paper_seconds: time of the paper's planner, seconds.
  """

  goal: tuple[float, float, float]
  knots: int
  knot_duration: float
  paper_seconds: float

  def config(self, seed: int) -> ReachingConfig:
    """Returns this problem's `ReachingConfig` with `seed`."""
    return ReachingConfig(self.goal, self.knots, self.knot_duration, seed)


PROBLEMS: Mapping[str, Problem] = {  # By the name of the track.
  'gap': Problem((2.0, 0.0, 0.5), 11, 0.3, 185.0),
  'plateau': Problem((2.0, 0.0, 0.5), 11, 0.3, 213.0),
  'gap_block': Problem((2.0, 0.0, 0.9), 30, 0.15, 161.0),
}


# By name, and not from `arenas.layouts`: names of tasks need no Composer.
TRACKS = (
  *PROBLEMS,
  RANDOM_TRACK,
  'block',
  'block_down',
  'stairs',
  'stepping_stones',
  'slope',
  'rough',
  'obstacle_course',
  'gaps_and_blocks',
)


def problem(
  track: str, terrain: terrain_lib.Terrain, seed: int = 0
) -> ReachingConfig:
  """Returns the paper's problem of a track, or else that of crossing it.

  Where sizes of one's own put an edge at the paper's goal or beyond, a robot
  that stood there would have crossed nothing: then the track is to be crossed.

  Args:
    track: its name.
    terrain: a batch of one, as the track drew it.
    seed: of the draw of the terrain.
  """
  if track in PROBLEMS and PROBLEMS[track].goal[0] > _last_edge(terrain):
    x, y, _ = PROBLEMS[track].goal
    top = float(terrain_lib.support_height(terrain, np.array([x]))[0])
    return dataclasses.replace(
      PROBLEMS[track].config(seed), goal=(x, y, top + constants.STAND_HEIGHT)
    )
  return crossing(terrain, seed)


def crossing(terrain: terrain_lib.Terrain, seed: int = 0) -> ReachingConfig:
  """Returns the problem of crossing a track.

  The goal is on the ground behind the last edge, in time for 0.3 m/s.

  Args:
    terrain: a batch of one, as the track drew it.
    seed: of the draw of the terrain.
  """
  last = np.flatnonzero(np.isfinite(terrain.starts[0]))[-1]
  if not last:  # Level ground has no edge to cross.
    return ReachingConfig(seed=seed)
  x = _last_edge(terrain) + _BEYOND
  z = float(terrain.tops[0, last]) + constants.STAND_HEIGHT
  return ReachingConfig((x, 0.0, z), round(x / _SPEED / _KNOT), _KNOT, seed)


def _last_edge(terrain: terrain_lib.Terrain) -> float:
  """Returns where the last segment starts along x, metres."""
  return float(terrain.starts[np.isfinite(terrain.starts)].max())


def random_problem(
  seed: int,
  track: str = RANDOM_TRACK,
  sizes: Mapping[str, float] | None = None,
) -> ReachingConfig:
  """Returns the problem on a track as a seed draws it.

  Args:
    seed: of the draw.
    track: its name.
    sizes: of the track, where they are not its defaults.

  Raises:
    ValueError: the track or a size is unknown, a size is invalid, or the goal
      not over the track.
  """
  # Late: a track needs Composer, which the names of problems do not.
  from dmc_multimode.arenas import track as track_lib

  arena = track_lib.make(track, sizes=sizes)
  terrain = arena.generate(np.random.RandomState(seed))
  config = problem(track, terrain, seed)
  check_goal(config.goal, terrain)
  return config


def within(config: ReachingConfig, time_limit: float | None) -> ReachingConfig:
  """Returns the problem with the knots that fit into a time.

  Args:
    config: the problem.
    time_limit: seconds; None leaves the problem as it is.

  Raises:
    ValueError: no knot fits.
  """
  if time_limit is None:
    return config
  if not config.knot_duration <= time_limit < math.inf:
    raise ValueError(
      f'time_limit must be finite here and have room for a knot, '
      f'{config.knot_duration} s, got {time_limit}.'
    )
  knots = math.floor(time_limit / config.knot_duration + 1e-6)
  return dataclasses.replace(config, knots=knots)


def in_knots(config: ReachingConfig, knot_duration: float) -> ReachingConfig:
  """Returns the problem in knots of another duration, seconds; as long."""
  knots = max(round(config.knots * config.knot_duration / knot_duration), 1)
  return dataclasses.replace(config, knots=knots, knot_duration=knot_duration)


def task_config(
  policy: Policy,
  reaching: ReachingConfig,
  disturbed: events_lib.TrainingEvents = events_lib.NONE,
) -> imitation_config.ImitationConfig:
  """Returns the task with tracking limits off: only falls terminate.

  Args:
    policy: of the robot.
    reaching: goal and knots.
    disturbed: see `events.fixed`.

  Raises:
    ValueError: the robot is another than the mini biped, for which tracks,
      goals and knots are made.
  """
  task = policy.config
  if not task.robot.is_mini_biped:
    raise ValueError(
      f'Tracks are crossed by the mini biped alone, not by {task.robot}.'
    )
  duration = reaching.knots * reaching.knot_duration
  return imitation_config.evaluated(
    task,
    events=disturbed,
    limits=terminations.falls_alone(task.limits),
    time_limit=max(duration, task.control_timestep),
  )


def knot_steps(reaching: ReachingConfig, control_timestep: float) -> int:
  """Returns the number of control steps in a knot.

  Raises:
    ValueError: the number is not whole.
  """
  return durations.whole_steps(
    reaching.knot_duration, control_timestep, 'A knot'
  )


def check_goal(goal: tuple[float, ...], terrain: terrain_lib.Terrain) -> None:
  """Raises ValueError where no robot that went there could stand.

  Tracks are crossed along +x: a goal lies ahead of the start, x = 0, over the
  ground, and as high as the legs hold a trunk.

  Args:
    goal: x, y and z, world metres.
    terrain: a batch of one.
  """
  if goal[0] < 0:
    raise ValueError(
      f'The goal, x = {goal[0]:g} m, is behind the start, x = 0.'
    )
  if abs(goal[1]) > terrain_lib.HALF_WIDTH:
    raise ValueError(
      f'The goal, y = {goal[1]:g} m, is not over the track, which reaches '
      f'{terrain_lib.HALF_WIDTH:g} m to either side.'
    )
  used = np.isfinite(terrain.starts)
  first, last = terrain.starts[used].min(), terrain.ends[used].max()
  on_top = used & (terrain.starts <= goal[0]) & (goal[0] <= terrain.ends)
  if not on_top.any():
    raise ValueError(
      f'The goal, x = {goal[0]:g} m, is not over the track, which runs from '
      f'{first:g} to {last:g} m and has gaps.'
    )
  top = float(terrain.tops[on_top].max())
  lowest, highest = top + kinematics.LOWEST, top + kinematics.HIGHEST
  if not lowest - _EXACT <= goal[2] <= highest + _EXACT:
    raise ValueError(
      f'The goal, z = {goal[2]:g} m, is not where a trunk stands over the '
      f'ground at {top:g} m: that is {lowest:g} to {highest:g} m high.'
    )


def rewards(position: np.ndarray, goal: np.ndarray) -> np.ndarray:
  """Returns exp(-|goal - p|) of a control step, [B].

  Args:
    position: p, of the trunk, world metres, [B, 3].
    goal: world metres, [3], or one for each, [B, 3].
  """
  return np.exp(-np.linalg.norm(goal - position, axis=-1))


def reached(
  qpos: np.ndarray,
  qvel: np.ndarray,
  terrain: terrain_lib.Terrain,
  goal: np.ndarray,
) -> np.ndarray:
  """Returns whether robots stand at the goal, [B].

  Their trunks are within 0.25 m along x, 0.2 m along y and 0.12 m along z of
  it, over its support plane, upright, and slower than 0.15 m/s.

  Args:
    qpos, qvel: generalised positions [B, 17] and velocities [B, 16].
    terrain: under the B robots.
    goal: world metres, [3], or one for each, [B, 3].
  """
  x = qpos[:, 0]
  at_goal = terrain_lib.support_height(
    terrain, np.broadcast_to(goal, (len(x), 3))[:, 0]
  )
  there = terrain_lib.support_height(terrain, x) == at_goal
  there &= (np.abs(qpos[:, :3] - goal) <= _NEAR).all(axis=1)
  # The third column of the rotation matrix: how upright the trunk is.
  up = 1 - 2 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2)
  slow = np.linalg.norm(qvel[:, :3], axis=1) < _SLOW
  return there & slow & (up > _UPRIGHT)


def ground_ahead(
  terrain: terrain_lib.Terrain,
  x: np.ndarray,
  shift: float | np.ndarray = 0.0,
) -> np.ndarray:
  """Returns the heights of the ground `AHEAD` of robots, metres, [B, 30].

  They are relative to the support planes under the robots, and `GAP` where
  there is no ground.

  Args:
    terrain: under the B robots.
    x: of their trunks, world metres, [B].
    shift: of the places that are looked at, an error, metres, [B] or one for
      all.
  """
  places = x + shift
  top = terrain_lib.profile(terrain, places[:, None] + np.array(AHEAD))
  support = terrain_lib.support_height(terrain, x)[:, None]
  return np.where(np.isfinite(top), top - support, GAP)
