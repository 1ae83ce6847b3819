"""Tests of dmc_multimode.suite.imitation.episodes."""

import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import mode_sampler
from dmc_multimode.utils import schedule as schedules

_PI2 = library.mode_set('pi2')


def _finished(initial: int, final: int, value: float) -> episodes.EpisodeBatch:
  """One episode."""
  zero = np.zeros(1, dtype=int)
  return episodes.EpisodeBatch(
    zero, np.array([initial]), np.array([final]), np.array([value]), zero, zero
  )


def _draw(config: mode_sampler.SamplingConfig, steps: int) -> episodes.Episodes:
  return episodes.TransitionEpisodes(_PI2, config).sample(
    np.arange(4000), steps, np.random.RandomState(0)
  )


def test_switch_times() -> None:
  drawn = episodes.TransitionEpisodes(_PI2).sample(
    np.arange(500), 0, np.random.RandomState(0)
  )
  modes, starts = drawn.schedule.modes, drawn.schedule.starts
  np.testing.assert_array_equal(modes[:, 0], drawn.initial)
  np.testing.assert_array_equal(modes[:, 1], drawn.final)
  cycles = starts[:, 1] / _PI2.bank.durations[drawn.initial]
  launches = drawn.initial == _PI2.index('launch')
  seen = lambda rows: set(np.round(cycles[rows], 6))
  assert seen(~launches) == {0.25, 0.5, 0.75, 1.25, 1.5, 1.75}
  # Launch is not left before its touch-down.
  assert seen(launches) == {0.82, 1.25, 1.5, 1.75}
  pairs = set(zip(drawn.initial, drawn.final, strict=True))
  assert len(pairs) == len(_PI2) ** 2


def test_strings_of_transitions_and_clock_rates() -> None:
  config = mode_sampler.SamplingConfig(
    string_fraction=schedules.constant(0.5), clock_rates=(0.5, 3.0)
  )
  drawn = _draw(config, 0)
  modes, starts = drawn.schedule.modes, drawn.schedule.starts
  commands = np.isfinite(starts).sum(axis=1)
  strings = np.equal(drawn.stretch, 2)
  assert strings.mean() == pytest.approx(0.5, abs=0.03)
  assert set(commands[~strings]) == {2} and set(commands) == {2, 3, 4, 5}
  np.testing.assert_array_equal(
    drawn.final, modes[np.arange(len(modes)), commands - 1]
  )
  rates = drawn.schedule.clock_rate
  used = np.isfinite(starts)
  climbs = (used & (modes == _PI2.index('launch'))).any(axis=1)
  assert (rates[climbs] == 1).all()
  short = ~climbs & ~strings
  assert (rates[short] != 1).mean() == pytest.approx(0.5, abs=0.05)
  assert 0.5 <= rates.min() < 0.6 and 2.9 < rates.max() <= 3.0
  # Faster, a walk would be a run.
  walks = (used & (modes == _PI2.index('walk_forward'))).any(axis=1)
  assert 2.4 < rates[walks].max() <= _PI2.bank.fastest_rates.min()


def test_gaits_come_first() -> None:
  """A walk in place of 7 of 10 modes, for as long as was asked for."""
  walk = _PI2.index('walk_forward')
  plain = mode_sampler.SamplingConfig(gait_fraction=schedules.constant(0.0))
  first = mode_sampler.SamplingConfig(
    gait_fraction=schedules.Schedule(0.7, 0.0, 1000, 1000)
  )
  for steps in (0, 999):
    drawn = _draw(first, steps)
    for modes in (drawn.initial, drawn.final):
      share = float(np.mean(modes == walk))
      assert share == pytest.approx(0.7 + 0.3 / 4, abs=0.03)
    np.testing.assert_array_equal(drawn.schedule.modes[:, 0], drawn.initial)
    np.testing.assert_array_equal(drawn.schedule.modes[:, 1], drawn.final)
  # What is drawn from then on does not depend on the share.
  np.testing.assert_array_equal(
    _draw(first, 1000).final, _draw(plain, 1000).final
  )
  # There may be none among the modes.
  without = library.mode_set('idle,hop_forward,launch')
  drawn = episodes.TransitionEpisodes(without, first).sample(
    np.arange(300), 0, np.random.RandomState(0)
  )
  assert len(np.unique(drawn.initial)) == 3


@pytest.mark.parametrize(
  ('steps', 'expected'), [(0, 1 / 4), (1000, 0.2 + 0.6 / 4), (2000, 1 / 4)]
)
def test_modes_in_focus(steps: int, expected: float) -> None:
  """Two modes in place of 4 of 10, when it was asked for."""
  config = mode_sampler.SamplingConfig(
    focus='launch, idle',
    focus_fraction=schedules.step(0.4, 1000),
    focus_end=2000,
  )
  drawn = _draw(config, steps)
  for modes in (drawn.initial, drawn.final):
    for name in ('launch', 'idle'):
      share = float(np.mean(modes == _PI2.index(name)))
      assert share == pytest.approx(expected, abs=0.03)
  config = mode_sampler.SamplingConfig(focus='fly')
  with pytest.raises(ValueError, match="Unknown mode 'fly'"):
    episodes.TransitionEpisodes(_PI2, config)


def test_learns_and_restores() -> None:
  taught, other = (episodes.TransitionEpisodes(_PI2) for _ in range(2))
  uniform = other.probabilities()
  assert uniform['p/idle'] == pytest.approx(0.25)
  assert uniform['p/idle->launch'] == pytest.approx(0.25)
  assert len(uniform) == 4 + 16
  taught.update(_finished(0, 3, 0.9))
  assert taught.probabilities()['p/idle'] < 0.25
  assert taught.probabilities()['p/idle->launch'] < 0.25
  other.restore(taught.state())
  assert other.probabilities() == taught.probabilities()


@pytest.mark.parametrize(
  ('ids', 'rows'), [([2, 1], [2, 1]), ([4, 9], [0, 0])], ids=['each', 'one']
)
def test_given_schedules(ids: list[int], rows: list[int]) -> None:
  """One a world or one for all; they draw nothing and learn nothing."""
  plan = schedule.ModeSchedule(
    np.array([[0, 1], [1, 2], [2, 0]]),
    np.array([[0.0, 1.0], [0.0, np.inf], [0.0, 2.0]]),
    np.array([1.0, 1.1, 1.2]),
  )
  if rows == [0, 0]:
    plan = schedule.ModeSchedule(*(field[:1] for field in vars(plan).values()))
  initialiser = episodes.ScheduledEpisodes(plan)
  assert initialiser.max_knots == 2
  random_state = np.random.RandomState(0)
  drawn = initialiser.sample(np.array(ids), 0, random_state)
  np.testing.assert_array_equal(drawn.schedule.modes, plan.modes[rows])
  np.testing.assert_array_equal(
    drawn.schedule.clock_rate, plan.clock_rate[rows]
  )
  np.testing.assert_array_equal(drawn.initial, plan.modes[rows, 0])
  # The final mode is the last that is commanded at all.
  np.testing.assert_array_equal(drawn.final, np.array([1, 1, 0])[rows])
  assert random_state.uniform() == np.random.RandomState(0).uniform()
  initialiser.update(_finished(0, 0, 1.0))
  assert initialiser.probabilities() == {}
  initialiser.restore(initialiser.state())
