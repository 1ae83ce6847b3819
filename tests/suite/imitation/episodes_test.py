"""Tests of dmc_multimode.suite.episodes."""

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np

from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import mode_sampler
from dmc_multimode.utils import schedule as schedules

_PI2 = library.mode_set('pi2')


class TransitionEpisodesTest(parameterized.TestCase):
  def test_switch_times(self) -> None:
    drawn = episodes.TransitionEpisodes(_PI2).sample(
      np.arange(500), np.random.RandomState(0)
    )
    modes, starts = drawn.schedule.modes, drawn.schedule.starts
    np.testing.assert_array_equal(modes[:, 0], drawn.initial)
    np.testing.assert_array_equal(modes[:, 1], drawn.final)
    cycles = starts[:, 1] / _PI2.bank.durations[drawn.initial]
    launch, leap = _PI2.index('launch'), _PI2.index('leap_forward')
    waits = drawn.initial == leap
    level = (drawn.initial != launch) & ~waits
    self.assertEqual(
      set(np.round(cycles[level], 6)), {0.25, 0.5, 0.75, 1.25, 1.5, 1.75}
    )
    # A leap, which flies from 0.42 to 0.70, is left on land.
    self.assertEqual(
      set(np.round(cycles[waits], 6)), {0.25, 0.7, 0.75, 1.25, 1.7, 1.75}
    )
    # Launch is not left before its end.
    self.assertEqual(
      set(np.round(cycles[~level & ~waits], 6)), {1.0, 1.25, 1.5, 1.75}
    )
    pairs = set(zip(drawn.initial, drawn.final, strict=True))
    self.assertLen(pairs, len(_PI2) ** 2)

  def test_gaits_come_first(self) -> None:
    """A walk in place of 7 of 10 modes, for as long as was asked for."""
    walk = _PI2.index('walk_forward')
    configs = [
      mode_sampler.SamplingConfig(gait_fraction=fraction)
      for fraction in (
        schedules.constant(0.0),
        schedules.Schedule(0.7, 0.0, 1000, 1000),
      )
    ]
    plain, first = (
      episodes.TransitionEpisodes(_PI2, config) for config in configs
    )
    draw = lambda initialiser: initialiser.sample(
      np.arange(4000), np.random.RandomState(0)
    )
    for _ in range(2):  # The second time, just before the end.
      drawn = draw(first)
      for modes in (drawn.initial, drawn.final):
        self.assertAlmostEqual(
          float(np.mean(modes == walk)), 0.7 + 0.3 / 4, delta=0.03
        )
      np.testing.assert_array_equal(drawn.schedule.modes[:, 0], drawn.initial)
      np.testing.assert_array_equal(drawn.schedule.modes[:, 1], drawn.final)
      first.advance(500 if first.state()['steps'] == 0 else 499)
    # What is drawn by then does not depend on the share.
    resumed = episodes.TransitionEpisodes(_PI2, configs[1])
    resumed.restore(first.state())
    resumed.advance(1)
    first.advance(1)
    for initialiser in (first, resumed):
      np.testing.assert_array_equal(draw(initialiser).final, draw(plain).final)

  def test_no_gait_to_come_first(self) -> None:
    modes = library.mode_set('idle,hop_forward,launch')
    config = mode_sampler.SamplingConfig(gait_fraction=schedules.constant(0.7))
    drawn = episodes.TransitionEpisodes(modes, config).sample(
      np.arange(300), np.random.RandomState(0)
    )
    self.assertLen(np.unique(drawn.initial), 3)

  def test_modes_in_focus(self) -> None:
    """Two modes in place of 4 of 10, when it was asked for."""
    config = mode_sampler.SamplingConfig(
      focus='launch, idle',
      focus_fraction=schedules.step(0.4, 1000),
      focus_end=2000,
    )
    initialiser = episodes.TransitionEpisodes(_PI2, config)
    for expected in (1 / 4, 0.2 + 0.6 / 4, 1 / 4):
      drawn = initialiser.sample(np.arange(4000), np.random.RandomState(0))
      for modes in (drawn.initial, drawn.final):
        for name in ('launch', 'idle'):
          share = float(np.mean(modes == _PI2.index(name)))
          self.assertAlmostEqual(share, expected, delta=0.03)
      initialiser.advance(1000)

  def test_focus_on_what_is_not_there(self) -> None:
    config = mode_sampler.SamplingConfig(focus='fly')
    with self.assertRaisesRegex(ValueError, "Unknown mode 'fly'"):
      episodes.TransitionEpisodes(_PI2, config)

  def test_one_seed_one_draw(self) -> None:
    initialiser = episodes.TransitionEpisodes(_PI2)
    first, second = (
      initialiser.sample(np.arange(20), np.random.RandomState(3)).schedule
      for _ in range(2)
    )
    np.testing.assert_array_equal(first.modes, second.modes)
    np.testing.assert_array_equal(first.starts, second.starts)

  def test_learns_and_restores(self) -> None:
    taught, other = (episodes.TransitionEpisodes(_PI2) for _ in range(2))
    uniform = other.probabilities()
    self.assertAlmostEqual(uniform['p/idle'], 0.25)
    self.assertAlmostEqual(uniform['p/idle->launch'], 0.25)
    self.assertLen(uniform, 4 + 16)
    taught.update(np.array([0]), np.array([3]), np.array([0.9]))
    self.assertLess(taught.probabilities()['p/idle'], 0.25)
    self.assertLess(taught.probabilities()['p/idle->launch'], 0.25)
    other.restore(taught.state())
    self.assertEqual(other.probabilities(), taught.probabilities())


class ScheduledEpisodesTest(parameterized.TestCase):
  def test_one_schedule_for_all(self) -> None:
    plan = schedule.from_knots(np.array([[2, 1, 3]]), 0.5, clock_rate=1.2)
    initialiser = episodes.ScheduledEpisodes(plan)
    self.assertEqual(initialiser.max_knots, 3)
    drawn = initialiser.sample(np.array([4, 9]), np.random.RandomState(0))
    np.testing.assert_array_equal(drawn.schedule.modes, [[2, 1, 3]] * 2)
    np.testing.assert_array_equal(drawn.schedule.clock_rate, [1.2, 1.2])
    np.testing.assert_array_equal(drawn.initial, [2, 2])
    np.testing.assert_array_equal(drawn.final, [3, 3])

  def test_a_schedule_a_world(self) -> None:
    plan = schedule.ModeSchedule(
      np.array([[0, 1], [1, 2], [2, 0]]),
      np.array([[0.0, 1.0], [0.0, np.inf], [0.0, 2.0]]),
      np.array([1.0, 1.1, 1.2]),
    )
    initialiser = episodes.ScheduledEpisodes(plan)
    drawn = initialiser.sample(np.array([2, 1]), np.random.RandomState(0))
    np.testing.assert_array_equal(drawn.schedule.modes, [[2, 0], [1, 2]])
    np.testing.assert_array_equal(drawn.schedule.clock_rate, [1.2, 1.1])
    np.testing.assert_array_equal(drawn.initial, [2, 1])
    np.testing.assert_array_equal(drawn.final, [0, 1])  # Unused columns: no.

  def test_draws_nothing_and_learns_nothing(self) -> None:
    initialiser = episodes.ScheduledEpisodes(schedule.single(np.array([0])))
    random_state = np.random.RandomState(0)
    initialiser.sample(np.arange(3), random_state)
    self.assertEqual(
      random_state.randint(1 << 30),
      np.random.RandomState(0).randint(1 << 30),
    )
    initialiser.update(np.zeros(1), np.zeros(1), np.ones(1))
    self.assertEqual(initialiser.probabilities(), {})
    initialiser.restore(initialiser.state())


if __name__ == '__main__':
  absltest.main()
