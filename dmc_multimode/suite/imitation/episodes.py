"""What an episode is to practise: its mode schedule, drawn or given."""

from typing import Mapping, NamedTuple, Protocol

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import mode_sampler


class Episodes(NamedTuple):
  """N episodes.

  Attributes:
    schedule: what is commanded when.
    initial: index of the first mode, [N].
    final: index of the last mode, [N].
  """

  schedule: schedule_lib.ModeSchedule
  initial: np.ndarray
  final: np.ndarray


class EpisodeInitialiser(Protocol):
  """Chooses the episodes and learns from their outcome."""

  max_knots: int

  def sample(
    self, ids: np.ndarray, random_state: np.random.RandomState
  ) -> Episodes:
    """Returns the next episodes of the worlds `ids`, [N]."""

  def update(
    self, initial: np.ndarray, final: np.ndarray, returns: np.ndarray
  ) -> None:
    """Takes the returns of finished episodes, [N] each."""

  def advance(self, steps: int) -> None:
    """Is told of so many control steps of all worlds together."""

  def probabilities(self) -> dict[str, float]:
    """Returns what it samples how often, for logs; may be empty."""

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of what `restore` needs."""

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """Takes over a `state`."""


class TransitionEpisodes:
  """Algorithm 1: an initial mode, a switch at a phase, a final mode.

  Some modes may be practised more at first: see `SamplingConfig`.
  """

  max_knots = 2

  def __init__(
    self,
    mode_set: mode_set_lib.ModeSet,
    config: mode_sampler.SamplingConfig | None = None,
    commands_from_ground: bool = True,
  ):
    """Samples over the modes of `mode_set`; see `schedule.transitions`.

    Raises:
      ValueError: a mode that is to be practised more is none of these.
    """
    self._mode_set = mode_set
    self._config = config or mode_sampler.SamplingConfig()
    self._commands_from_ground = commands_from_ground
    self._gaits = np.flatnonzero(mode_set.bank.gaits)
    self._focused = np.array(
      [mode_set.index(name) for name in self._config.focused], dtype=np.int64
    )
    self._steps = 0
    self.sampler = mode_sampler.ModeSampler(len(mode_set), self._config)

  def sample(
    self, ids: np.ndarray, random_state: np.random.RandomState
  ) -> Episodes:
    """See `EpisodeInitialiser`."""
    initial, final = self.sampler.sample(len(ids), random_state)
    for modes, share in self._preferences():
      if len(modes) and share:
        shape = (2, len(ids))
        swap = random_state.uniform(size=shape) < share
        preferred = random_state.choice(modes, size=shape)
        initial, final = np.where(swap, preferred, (initial, final))
    clips = random_state.choice(schedule_lib.CLIPS, size=len(ids))
    phases = random_state.choice(schedule_lib.SWITCH_PHASES, size=len(ids))
    schedule = schedule_lib.transitions(
      self._mode_set, initial, final, clips, phases, self._commands_from_ground
    )
    return Episodes(schedule, initial, final)

  def _preferences(self) -> tuple[tuple[np.ndarray, float], ...]:
    """Returns modes that are practised more, and how often they replace one."""
    config = self._config
    return (
      (self._gaits, config.gait_fraction.at(self._steps)),
      (self._focused, config.focus_at(self._steps)),
    )

  def update(
    self, initial: np.ndarray, final: np.ndarray, returns: np.ndarray
  ) -> None:
    """See `EpisodeInitialiser`."""
    self.sampler.update(initial, final, returns)

  def advance(self, steps: int) -> None:
    """See `EpisodeInitialiser`."""
    self._steps += steps

  def probabilities(self) -> dict[str, float]:
    """Returns Algorithm 1's p_i by mode and p_f by transition."""
    names, result = self._mode_set.names, {}
    for i, p in enumerate(self.sampler.initial_probabilities):
      result[f'p/{names[i]}'] = float(p)
    for i, row in enumerate(self.sampler.final_probabilities):
      for f, p in enumerate(row):
        result[f'p/{names[i]}->{names[f]}'] = float(p)
    return result

  def state(self) -> dict[str, np.ndarray]:
    """See `EpisodeInitialiser`."""
    return {**self.sampler.state(), 'steps': np.array(self._steps)}

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """See `EpisodeInitialiser`."""
    self.sampler.restore(state)
    self._steps = int(state['steps'])


class ScheduledEpisodes:
  """Given schedules: one for all worlds, or world i runs row i."""

  def __init__(self, schedule: schedule_lib.ModeSchedule):
    """Runs `schedule`, of one world or of as many as the environment has."""
    self._schedule = schedule
    self.max_knots = schedule.modes.shape[1]

  def sample(
    self, ids: np.ndarray, random_state: np.random.RandomState
  ) -> Episodes:
    """See `EpisodeInitialiser`."""
    del random_state
    rows = ids if len(self._schedule) > 1 else np.zeros_like(ids)
    schedule = schedule_lib.ModeSchedule(
      self._schedule.modes[rows],
      self._schedule.starts[rows],
      self._schedule.clock_rate[rows],
    )
    last = np.isfinite(schedule.starts).sum(axis=1) - 1
    final = schedule.modes[np.arange(len(rows)), last]
    return Episodes(schedule, schedule.modes[:, 0], final)

  def update(
    self, initial: np.ndarray, final: np.ndarray, returns: np.ndarray
  ) -> None:
    """Learns nothing."""

  def advance(self, steps: int) -> None:
    """Has no schedule of its own."""

  def probabilities(self) -> dict[str, float]:
    """Samples nothing."""
    return {}

  def state(self) -> dict[str, np.ndarray]:
    """Has no state."""
    return {}

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """Has no state."""
