"""Reaching a place by mode commands alone (Sec. II-E), in many worlds at once.

All worlds of a problem begin in the same state. A planner runs them from knot
to knot, each under a mode of its own, and may let worlds go on from where
others are. The policy is the only one who sees the robot: a plan is open-loop.
"""

import dataclasses
from typing import NamedTuple, Protocol

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import reference
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import batched
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes
from dmc_multimode.suite import multimode_biped

_NEAR_X, _NEAR_Z = 0.3, 0.12  # Metres from the goal that count as there.
_UPRIGHT = 0.7  # Cosine of the trunk's tilt.
_BLOCK = 16  # Observations that the policy sees at once are a multiple.


class Policy(Protocol):
  """What a problem asks of a policy; `pretrained.Policy` has it."""

  @property
  def motions(self) -> tuple[reference.ReferenceMotion, ...]:
    """The modes that it knows."""

  @property
  def codebook(self) -> codebook_lib.Codebook:
    """Their latents."""

  @property
  def config(self) -> config_lib.ImitationConfig:
    """The task that it was trained for."""

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    """Joint targets [B, 10] for observations [B, D], without exploration."""


@dataclasses.dataclass(frozen=True)
class ReachingConfig:
  """What is to be reached, and how a plan is cut up.

  Attributes:
    goal: of the trunk in the world, metres (x, y, z).
    knots: of the plan.
    knot_duration: seconds from knot to knot.
    seed: of the terrain and of the initial state's noise.
  """

  goal: tuple[float, float, float] = (2.0, 0.0, 0.5)
  knots: int = 11
  knot_duration: float = 0.3
  seed: int = 0

  def __post_init__(self) -> None:
    if len(self.goal) != 3 or not np.isfinite(self.goal).all():
      raise ValueError(f'A goal is x, y and z in metres, got {self.goal}.')
    if self.knots < 1:
      raise ValueError(f'A plan has at least one knot, got {self.knots}.')
    if not (np.isfinite(self.knot_duration) and self.knot_duration > 0):
      raise ValueError(
        f'Knots must last longer than 0 s, got {self.knot_duration}.'
      )
    if self.seed < 0:
      raise ValueError(f'seed must not be negative, got {self.seed}.')


class Progress(NamedTuple):
  """Where the B worlds are; see `ReachingProblem.run_knot`.

  Attributes:
    reward: of the knot, sum of exp(-|goal - p|) over its control steps, zero
      after a fall, [B].
    path: of the trunk in the world after each control step, metres, [S, B, 3].
    alive: whether the robot has never fallen, [B].
    reached: whether it stands at the goal, upright, [B].
  """

  reward: np.ndarray
  path: np.ndarray
  alive: np.ndarray
  reached: np.ndarray

  @property
  def position(self) -> np.ndarray:
    """Of the trunk in the world at the end of the knot, metres, [B, 3]."""
    return self.path[-1]


class Trials(NamedTuple):
  """Whole plans in N worlds.

  Attributes:
    returns: sums of the knots' rewards, [N].
    position: of the trunk in the end, metres, [N, 3].
    success: whether the goal is reached in the end, without a fall, [N].
    paths: of the trunk after every control step, metres, [N, T, 3].
  """

  returns: np.ndarray
  position: np.ndarray
  success: np.ndarray
  paths: np.ndarray


class ReachingProblem:
  """B worlds on one track that all begin alike."""

  def __init__(
    self,
    policy: Policy,
    arena: track_lib.Track,
    config: ReachingConfig,
    num_worlds: int,
    num_threads: int = 0,
  ):
    """Compiles the worlds and puts the robots at the start.

    Args:
      policy: turns mode commands into motion.
      arena: the track.
      config: goal and knots.
      num_worlds: B.
      num_threads: of the physics; 0 takes every core.

    Raises:
      ValueError: a knot is no whole number of control steps, or the goal is not
        over the track.
    """
    self.policy, self.config = policy, config
    self.bank = reference.ReferenceBank(policy.motions)
    self.num_worlds, self.num_modes = num_worlds, len(self.bank)
    self._worlds = batched.BatchedImitation(
      multimode_biped.make_task(
        policy.motions,
        policy.codebook,
        episodes.ScheduledEpisodes(schedule_lib.single(np.zeros(1))),
        arena,
        self._task_config(),
      ),
      num_worlds,
      config.seed,
      num_threads,
      auto_reset=False,
    )
    self.knot_steps = self._knot_steps()
    self.control_steps = 0
    self._alive = np.ones(num_worlds, dtype=bool)
    self._goal = np.array(config.goal)
    self._observation = self._worlds.reset_alike()
    self._start = self._worlds.state()
    self._check_goal()

  def _task_config(self) -> config_lib.ImitationConfig:
    """The policy's task without a reference to be lost."""
    config, task = self.config, self.policy.config
    limits = task.limits._replace(distance=np.inf, reward=-np.inf)
    return dataclasses.replace(
      config_lib.for_evaluation(task),
      limits=limits,
      time_limit=max(
        config.knots * config.knot_duration, task.control_timestep
      ),
    )

  def _knot_steps(self) -> int:
    duration, step = self.config.knot_duration, self._worlds.control_timestep
    steps = round(duration / step)
    if steps < 1 or abs(steps * step - duration) > 1e-6:
      raise ValueError(
        f'A knot of {duration} s is no multiple of the control step, {step} s.'
      )
    return steps

  def _check_goal(self) -> None:
    terrain = self.terrain
    used = np.isfinite(terrain.starts)
    first, last = terrain.starts[used].min(), terrain.ends[used].max()
    x = self._goal[0]
    on_top = used & (terrain.starts <= x) & (x <= terrain.ends)
    if not on_top.any():
      raise ValueError(
        f'The goal, x = {x:g} m, is not over the track, which runs from '
        f'{first:g} to {last:g} m and has gaps.'
      )
    top = float(terrain.tops[on_top].max())
    if not 0 < self._goal[2] - top < 1:
      raise ValueError(
        f'The goal, z = {self._goal[2]:g} m, is not where a trunk can be over '
        f'the ground at {top:g} m.'
      )

  @property
  def terrain(self) -> terrain_lib.Terrain:
    """Of the first world, a batch of one; all have the same."""
    return self._worlds.core.terrain.rows(np.array([0]))

  @property
  def control_timestep(self) -> float:
    """Seconds of a control step."""
    return self._worlds.control_timestep

  def reset(self) -> None:
    """Puts all worlds back to the start."""
    self._observation = self._worlds.restore(self._start)
    self._alive[:] = True

  def take(self, sources: np.ndarray) -> None:
    """Lets every world go on from where another is.

    Args:
      sources: index of the world that world i takes after, [B].
    """
    self._observation = self._worlds.take(sources)
    self._alive = self._alive[sources]

  def run_knot(self, modes: np.ndarray) -> Progress:
    """Runs all worlds for one knot.

    Args:
      modes: index of the mode that each world commands, [B].
    """
    self._observation = self._worlds.command(np.asarray(modes))
    reward, path = np.zeros(self.num_worlds), []
    for _ in range(self.knot_steps):
      step = self._worlds.step(self._act())
      self._observation = step.observation
      self.control_steps += self.num_worlds
      self._alive &= step.discount > 0
      path.append(self._worlds.qpos[:, :3].copy())
      distance = np.linalg.norm(self._goal - path[-1], axis=1)
      reward += np.where(self._alive, np.exp(-distance), 0.0)
    return Progress(reward, np.array(path), self._alive.copy(), self._reached())

  def rollout(self, plans: np.ndarray) -> Trials:
    """Runs whole plans from the start, as many as there are worlds.

    Args:
      plans: mode indices, [B, K].
    """
    self.reset()
    knots = [self.run_knot(modes) for modes in np.asarray(plans).T]
    return Trials(
      np.sum([knot.reward for knot in knots], axis=0),
      knots[-1].position,
      knots[-1].reached,
      np.concatenate([knot.path for knot in knots]).swapaxes(0, 1),
    )

  def _act(self) -> np.ndarray:
    """Acts with batches of one size, so that a world's action is its own.

    A single world acts as one in a Composer environment does.
    """
    seen = self._observation
    if len(seen) == 1:
      return self.policy.select_action(seen)
    missing = -len(seen) % _BLOCK
    padded = np.concatenate([seen, np.repeat(seen[:1], missing, axis=0)])
    actions = [
      self.policy.select_action(padded[i : i + _BLOCK])
      for i in range(0, len(padded), _BLOCK)
    ]
    return np.concatenate(actions)[: len(seen)]

  def _reached(self) -> np.ndarray:
    """Who stands at the goal, or past it on the same support, [B]."""
    qpos = self._worlds.qpos
    x, z = qpos[:, 0], qpos[:, 2]
    support = self._worlds.core.support
    same = support(x) == support(np.full_like(x, self._goal[0]))
    there = np.abs(x - self._goal[0]) <= _NEAR_X
    there |= (x > self._goal[0]) & same
    # The third column of the rotation matrix: how upright the trunk is.
    up = 1 - 2 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2)
    level = np.abs(z - self._goal[2]) <= _NEAR_Z
    return self._alive & there & level & (up > _UPRIGHT)
