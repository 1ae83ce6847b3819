"""Observations of the `reach_*` tasks, flat, for many worlds at once."""

from typing import NamedTuple

import numpy as np

from dmc_multimode.suite.imitation import core as imitation_core
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import config as config_lib

Layout = tuple[tuple[str, int], ...]


@config_lib.dataclass
class ScanErrors:
  """Errors of the observed ground.

  Attributes:
    noise: standard deviation of each height, metres.
    shift: half-width of the uniform error of all edges' places, metres, drawn
      for each episode.
    dropouts: share of the heights that are missed, and read as level ground.
    nearer: by which all edges seem nearer than they are, metres, besides the
      error that is drawn.
  """

  noise: config_lib.NonNegative = 0.0
  shift: config_lib.NonNegative = 0.0
  dropouts: config_lib.Share = 0.0
  nearer: float = 0.0

  def draw_shift(
    self, count: int, random_state: np.random.RandomState
  ) -> np.ndarray:
    """Returns by how much edges seem nearer in episodes, metres, [N]."""
    return self.nearer + random_state.uniform(-self.shift, self.shift, count)


EXACT = ScanErrors()


class Situation(NamedTuple):
  """Goals and errors that the observations of B worlds depend on.

  Attributes:
    goal: of the trunk, world metres, [B, 3] or [3].
    knots_left: share of the episode's knots that are left, [B].
    shift: by which edges seem nearer than they are, metres, [B].
  """

  goal: np.ndarray
  knots_left: np.ndarray
  shift: np.ndarray


class Observer:
  """Observes worlds as the `reach_*` tasks do.

  Attributes:
    layout: (name, size) of every part of an observation, in order; see
      `ReachingEnvironment`.
  """

  def __init__(
    self,
    policy: reaching.Policy,
    core: imitation_core.ImitationCore,
    errors: ScanErrors = EXACT,
  ):
    """Observes the worlds of `core`, in which `policy` moves the robots."""
    self._core, self._errors = core, errors
    extra = policy.config.extra_observations
    latent_dim, robot = policy.mode_set.latent_dim, policy.config.robot
    self._num_modes = len(policy.mode_set)
    self._places = {
      name: observations.part(name, latent_dim, False, extra, robot)
      for name, _ in observations.layout(latent_dim, extra=extra, robot=robot)
      if name != 'command'
    }
    self.layout: Layout = (
      ('goal', 3),
      *((name, part.stop - part.start) for name, part in self._places.items()),
      ('mode', self._num_modes),
      ('knots_left', 1),
      ('ground', len(reaching.AHEAD)),
    )

  @property
  def size(self) -> int:
    """Length D of an observation."""
    return sum(length for _, length in self.layout)

  def part(self, name: str) -> slice:
    """Returns the place of a part of an observation.

    Raises:
      ValueError: there is no such part.
    """
    return observations.place(name, self.layout)

  def observe(
    self,
    seen: np.ndarray,
    position: np.ndarray,
    situation: Situation,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Returns observations, float32 [B, D].

    Args:
      seen: the low-level policy's observations, [B, ...].
      position: of the trunks, world metres, [B, 3].
      situation: of the B worlds.
      random_state: source of the errors of the ground.
    """
    running = self._core.tracker.state.mode
    return np.concatenate(
      [
        situation.goal - position,
        *(seen[:, place] for place in self._places.values()),
        np.eye(self._num_modes)[running],
        situation.knots_left[:, None],
        self._scan(position[:, 0], situation.shift, random_state),
      ],
      axis=1,
      dtype=np.float32,
    )

  def _scan(
    self, x: np.ndarray, shift: np.ndarray, random_state: np.random.RandomState
  ) -> np.ndarray:
    """Returns the heights of the ground ahead as observed, metres."""
    errors = self._errors
    heights = reaching.ground_ahead(self._core.terrain, x, shift)
    if errors.noise:
      noise = random_state.standard_normal(heights.shape)
      heights += errors.noise * noise
    if errors.dropouts:
      missed = random_state.uniform(size=heights.shape) < errors.dropouts
      heights[missed] = 0.0
    return heights

  def obeyed(self) -> np.ndarray:
    """Returns the modes that would begin, or go on, at once, [B, M].

    A robot in flight, or about to take off, can only go on with its mode; see
    `ModeTracker.can_obey`. Another command would be held until it lands.
    """
    tracker = self._core.tracker
    can = tracker.can_obey(np.arange(len(tracker.state.mode)))
    running = np.eye(self._num_modes, dtype=bool)[tracker.state.mode]
    return running | can[:, None]
