"""Reaching a place by mode commands alone (Sec. II-E), in many worlds at once.

All worlds of a problem begin in the same state. A planner runs them from knot
to knot, each under a mode of its own, and may let worlds go on from where
others are. The policy is the only one who sees the robot: a plan is open-loop.
Robots that have fallen lie where they fell.
"""

from typing import NamedTuple, Sequence

import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.reaching import problem as reaching

_BLOCK = 16  # Observations that the policy sees at once are a multiple.


class Progress(NamedTuple):
  """Outcome of a knot in B worlds; see `ReachingProblem.run_knot`.

  Attributes:
    reward: of the knot, sum of exp(-|goal - p|) over its control steps, zero
      after a fall, [B].
    path: of the trunk in the world after each control step, metres, [S, B, 3].
    alive: true while the robot has never fallen, [B].
    reached: true where it stands at the goal, upright, [B].
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
    alive: true where the robot never fell, [N].
    success: true where the goal is reached in the end without a fall, [N].
    paths: of the trunk after every control step, metres, [N, T, 3].
  """

  returns: np.ndarray
  position: np.ndarray
  alive: np.ndarray
  success: np.ndarray
  paths: np.ndarray


def trials(knots: Sequence[Progress]) -> Trials:
  """Returns what knots, one after another, amount to."""
  return Trials(
    np.sum([knot.reward for knot in knots], axis=0),
    knots[-1].position,
    knots[-1].alive,
    knots[-1].reached,
    np.concatenate([knot.path for knot in knots]).swapaxes(0, 1),
  )


class _Start(NamedTuple):
  """State that `ReachingProblem.reset` returns to.

  Attributes:
    worlds: their state.
    knot: of the whole plan.
    alive: true while a robot has never fallen, [B].
  """

  worlds: dict[str, np.ndarray]
  knot: int
  alive: np.ndarray


class ReachingProblem:
  """B worlds on one track that all begin alike."""

  def __init__(
    self,
    policy: reaching.Policy,
    arena: track_lib.Track,
    config: reaching.ReachingConfig,
    num_worlds: int,
    num_threads: int = 0,
    pushes: Sequence[pushes_lib.Push] = (),
  ):
    """Compiles the worlds and puts the robots at the start.

    Args:
      policy: turns mode commands into motion.
      arena: the track.
      config: goal and knots.
      num_worlds: B.
      num_threads: of the physics; 0 takes every core.
      pushes: that all robots meet, at knots, right after the mode is chosen.

    Raises:
      ValueError: a knot is no whole number of control steps, the goal is not
        over the track, or a push is not at a knot.
    """
    self.policy, self.config = policy, config
    self.mode_set = policy.mode_set
    self.num_worlds, self.num_modes = num_worlds, len(self.mode_set)
    self._worlds = batched_env.BatchedImitation(
      multimode_biped.make_task(
        policy.mode_set,
        episodes.ScheduledEpisodes(schedule_lib.single(np.zeros(1))),
        arena,
        reaching.task_config(policy, config),
      ),
      num_worlds,
      config.seed,
      num_threads,
      auto_reset=False,
    )
    self.knot_steps = reaching.knot_steps(config, self.control_timestep)
    self._pushes = pushes_lib.by_knot(
      pushes, config.knots, config.knot_duration
    )
    self.control_steps = 0
    self._goal = np.array(config.goal)
    self._observation = self._worlds.reset_alike()
    alive = np.ones(num_worlds, dtype=bool)
    self._start = _Start(self._worlds.state(), 0, alive)
    self._knot, self._alive = 0, alive.copy()
    reaching.check_goal(config.goal, self.terrain)

  @property
  def terrain(self) -> terrain_lib.Terrain:
    """Of the first world, a batch of one; all have the same."""
    return self._worlds.core.terrain.rows(np.array([0]))

  @property
  def control_timestep(self) -> float:
    """Seconds of a control step."""
    return self._worlds.control_timestep

  @property
  def knots(self) -> int:
    """Of a plan from the start that `reset` returns to."""
    return self.config.knots - self._start.knot

  @property
  def remaining(self) -> int:
    """Knots that are left from where the worlds are."""
    return self.config.knots - self._knot

  @property
  def alive(self) -> np.ndarray:
    """Robots that have never fallen, bool [B]."""
    return self._alive.copy()

  @property
  def phase(self) -> np.ndarray:
    """Phase of each running mode, in [0, 1], [B]."""
    return self._worlds.core.tracker.state.phase.copy()

  def begin_at(self, other: 'ReachingProblem') -> None:
    """Begins, now and after each `reset`, where another problem is.

    Args:
      other: on the same track, with the same knots; its first world counts.

    Raises:
      ValueError: it is of another task.
    """
    self._worlds.copy_state(
      np.zeros(self._worlds.num_worlds, dtype=np.int64), other._worlds
    )
    alive = np.repeat(other._alive[:1], self.num_worlds)
    self._start = _Start(self._worlds.state(), other._knot, alive)
    self.reset()

  def reset(self) -> None:
    """Puts all worlds back to the start."""
    self._observation = self._worlds.restore(self._start.worlds)
    self._knot, self._alive = self._start.knot, self._start.alive.copy()

  def copy_state(self, sources: np.ndarray) -> None:
    """Continues world i from the state of world `sources[i]`.

    Args:
      sources: indices of worlds, [B].
    """
    self._observation = self._worlds.copy_state(sources)
    self._alive = self._alive[sources]

  def run_knot(self, modes: np.ndarray) -> Progress:
    """Runs all worlds for one knot.

    Args:
      modes: index of the mode that each world commands, [B].
    """
    if self._knot in self._pushes:
      self._worlds.qvel[:, :3] += self._pushes[self._knot]
    self._knot += 1
    self._observation = self._worlds.command(np.asarray(modes))
    reward, path = np.zeros(self.num_worlds), []
    for _ in range(self.knot_steps):
      path.append(self._step())
      worth = reaching.rewards(path[-1], self._goal)
      reward += np.where(self._alive, worth, 0.0)
    return Progress(reward, np.array(path), self._alive.copy(), self._reached())

  def _step(self) -> np.ndarray:
    """Makes a control step; returns the positions of the trunks, [B, 3].

    A robot that falls stays where it is: it would tumble on until its state is
    no longer finite. One whose state is so at once stays where it was.
    """
    if self._alive.any():
      state = self._worlds.physics.state
      before = state.copy()
      self._worlds.moving[:] = self._alive
      self.control_steps += int(self._alive.sum())
      step = self._worlds.step(self._act())
      self._observation = step.observation
      self._alive &= step.discount > 0
      diverged = ~np.isfinite(state).all(axis=1)
      state[diverged] = before[diverged]
    return self._worlds.qpos[:, :3].copy()

  def rollout(self, plans: np.ndarray) -> Trials:
    """Runs whole plans from the start, as many as there are worlds.

    Args:
      plans: mode indices, [B, K].
    """
    self.reset()
    return trials([self.run_knot(modes) for modes in np.asarray(plans).T])

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
    """Returns robots that stand at the goal and never fell, bool [B]."""
    there = reaching.reached(
      self._worlds.qpos, self._worlds.core.terrain, self._goal
    )
    return self._alive & there
