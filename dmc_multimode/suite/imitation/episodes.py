"""Mode schedules of episodes, drawn or given, and their outcomes."""

from typing import Mapping, NamedTuple, Protocol

import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import mode_sampler

_MOST_COMMANDS = 5
_STRETCH = 2  # Time limits in an episode of several transitions.


class Episodes(NamedTuple):
  """N episodes.

  Attributes:
    schedule: mode schedules of N worlds.
    initial: index of the first mode, [N].
    final: index of the last mode, [N].
    stretch: their lengths in time limits of the task, [N], or one for all.
  """

  schedule: schedule_lib.ModeSchedule
  initial: np.ndarray
  final: np.ndarray
  stretch: np.ndarray | int = 1


class Outcomes(Protocol):
  """Outcomes of N finished episodes, of this process or of others."""

  @property
  def initial(self) -> np.ndarray:
    """Indices of the first modes, [N]."""

  @property
  def final(self) -> np.ndarray:
    """Indices of the last modes, [N]."""

  @property
  def returns(self) -> np.ndarray:
    """Normalised returns, [N]."""

  @property
  def causes(self) -> np.ndarray:
    """Indices into `terminations.CAUSES`, 0 for the time limit, [N]."""


class EpisodeBatch(NamedTuple):
  """N finished episodes.

  Attributes:
    worlds: indices of their worlds, [N].
    initial, final: indices of their first and last modes, [N].
    returns: normalised returns, sum of rewards over horizon x sum of w, [N].
    lengths: control steps, [N].
    causes: indices into `terminations.CAUSES`; 0 for the time limit, [N].
  """

  worlds: np.ndarray
  initial: np.ndarray
  final: np.ndarray
  returns: np.ndarray
  lengths: np.ndarray
  causes: np.ndarray


class EpisodeInitialiser(Protocol):
  """Draws episodes, and adapts the draw to their outcomes."""

  max_knots: int

  def sample(
    self, ids: np.ndarray, steps: int, random_state: np.random.RandomState
  ) -> Episodes:
    """Returns the next episodes of the worlds `ids`, [N].

    Args:
      ids: worlds, [N].
      steps: environment steps so far, summed over all worlds.
      random_state: source of the draws.
    """

  def update(self, outcomes: Outcomes) -> None:
    """Updates the draw with finished episodes, in order."""

  def probabilities(self) -> dict[str, float]:
    """Returns the sampling probabilities by name, for logs; may be empty."""

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of the state."""

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """Restores a `state`."""


class TransitionEpisodes:
  """Algorithm 1: an initial mode, a switch at a phase, a final mode.

  `SamplingConfig` can prefer some modes at first, and make some episodes
  strings of several transitions.
  """

  def __init__(
    self,
    mode_set: mode_set_lib.ModeSet,
    config: mode_sampler.SamplingConfig | None = None,
  ):
    """Samples the modes of `mode_set`; see `schedule.transitions`.

    Raises:
      ValueError: `config.focus` names a mode that is not in the set.
    """
    self._mode_set = mode_set
    self._config = config or mode_sampler.SamplingConfig()
    self.max_knots = _MOST_COMMANDS if self._config.has_strings else 2
    self._gaits = np.flatnonzero(mode_set.bank.gaits)
    self._focused = np.array(
      [mode_set.index(name) for name in self._config.focused], dtype=np.int64
    )
    self.sampler = mode_sampler.ModeSampler(len(mode_set), self._config)

  def sample(
    self, ids: np.ndarray, steps: int, random_state: np.random.RandomState
  ) -> Episodes:
    """See `EpisodeInitialiser`."""
    initial, final = self.sampler.sample(len(ids), random_state)
    for modes, share in self._preferences(steps):
      if len(modes) and share:
        shape = (2, len(ids))
        swap = random_state.uniform(size=shape) < share
        preferred = random_state.choice(modes, size=shape)
        initial, final = np.where(swap, preferred, (initial, final))
    clips, phases = _moments(len(ids), random_state)
    rates = self._clock_rates(initial, final, steps, random_state)
    schedule = schedule_lib.transitions(
      self._mode_set, initial, final, clips, phases, rates
    )
    stretch = np.ones(len(ids), dtype=np.int64)
    share = self._config.string_fraction.at(steps)
    if share:
      rows = np.flatnonzero(random_state.uniform(size=len(ids)) < share)
      schedule = self._strung(schedule, rows, random_state)
      final = final.copy()
      final[rows] = schedule.last_modes()[rows]
      stretch[rows] = _STRETCH
    return Episodes(schedule, initial, final, stretch)

  def _strung(
    self,
    schedule: schedule_lib.ModeSchedule,
    rows: np.ndarray,
    random_state: np.random.RandomState,
  ) -> schedule_lib.ModeSchedule:
    """Appends transitions to the `rows` of a schedule of single ones.

    Each further mode is drawn from p_f of the one before it.
    """
    bank = self._mode_set.bank
    extra = _MOST_COMMANDS - 2
    modes = np.pad(schedule.modes, ((0, 0), (0, extra)))
    starts = np.pad(
      schedule.starts, ((0, 0), (0, extra)), constant_values=np.inf
    )
    commands = random_state.randint(2, _MOST_COMMANDS + 1, size=len(rows))
    for knot in range(2, _MOST_COMMANDS):
      before = modes[rows, knot - 1]
      clips, phases = _moments(len(rows), random_state)
      after = starts[rows, knot - 1] + (
        np.maximum(clips + phases, bank.touchdowns[before])
        * bank.durations[before]
        / schedule.clock_rate[rows]
      )
      modes[rows, knot] = self.sampler.sample_final(before, random_state)
      # Modes that climb keep their clock rate, so that others end with them;
      # and so do those that cannot go as fast.
      fits, mode = commands > knot, modes[rows, knot]
      rate = schedule.clock_rate[rows]
      fits &= ~bank.transient[mode] | (rate == 1)
      fits &= rate <= np.maximum(bank.fastest_rates[mode], 1)
      commands = np.where(fits, commands, np.minimum(commands, knot))
      starts[rows, knot] = np.where(fits, after, np.inf)
    return schedule_lib.ModeSchedule(modes, starts, schedule.clock_rate)

  def _clock_rates(
    self,
    initial: np.ndarray,
    final: np.ndarray,
    steps: int,
    random_state: np.random.RandomState,
  ) -> np.ndarray:
    """Returns the clock rates of episodes, 1 for most, [N]."""
    rates, (low, high) = np.ones(len(initial)), self._config.clock_rates
    share = self._config.clock_rate_fraction.at(steps)
    if share and high > low:
      bank = self._mode_set.bank
      transient, fastest = bank.transient, bank.fastest_rates
      drawn = random_state.uniform(size=len(rates)) < share
      drawn &= ~(transient[initial] | transient[final])
      highest = np.minimum(fastest[initial], fastest[final]).clip(low, high)
      uniform = random_state.uniform(low, highest)
      rates = np.where(drawn, uniform, rates)
    return rates

  def _preferences(self, steps: int) -> tuple[tuple[np.ndarray, float], ...]:
    """Returns preferred modes, each with its probability of replacement."""
    config = self._config
    return (
      (self._gaits, config.gait_fraction.at(steps)),
      (self._focused, config.focus_at(steps)),
    )

  def update(self, outcomes: Outcomes) -> None:
    """See `EpisodeInitialiser`."""
    self.sampler.update(
      outcomes.initial, outcomes.final, outcomes.returns, outcomes.causes > 0
    )

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
    return self.sampler.state()

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """See `EpisodeInitialiser`."""
    self.sampler.restore(state)


def _moments(
  count: int, random_state: np.random.RandomState
) -> tuple[np.ndarray, np.ndarray]:
  """Returns clip_s and phi_s of Algorithm 1, [N] each."""
  clips = random_state.choice(schedule_lib.CLIPS, size=count)
  return clips, random_state.choice(schedule_lib.SWITCH_PHASES, size=count)


class ScheduledEpisodes:
  """Fixed schedules: one for all worlds, or row i for world i."""

  def __init__(self, schedule: schedule_lib.ModeSchedule):
    """Keeps `schedule`, of one world or of all worlds of the environment."""
    self._schedule = schedule
    self.max_knots = schedule.modes.shape[1]

  def sample(
    self, ids: np.ndarray, steps: int, random_state: np.random.RandomState
  ) -> Episodes:
    """See `EpisodeInitialiser`."""
    del steps, random_state
    rows = ids if len(self._schedule) > 1 else np.zeros_like(ids)
    schedule = schedule_lib.ModeSchedule(
      self._schedule.modes[rows],
      self._schedule.starts[rows],
      self._schedule.clock_rate[rows],
    )
    return Episodes(schedule, schedule.modes[:, 0], schedule.last_modes())

  def update(self, outcomes: Outcomes) -> None:
    """Does nothing: the schedules are fixed."""

  def probabilities(self) -> dict[str, float]:
    """Returns an empty dictionary: nothing is drawn."""
    return {}

  def state(self) -> dict[str, np.ndarray]:
    """Returns an empty dictionary: there is no state."""
    return {}

  def restore(self, state: Mapping[str, np.ndarray]) -> None:
    """Does nothing: there is no state."""
