"""Tests of dmc_multimode.suite.imitation.obstacles."""

import dataclasses

import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.suite.imitation import obstacles

_MOTIONS = tuple(library.modes().values())
_COUNT = 4000
_HAIR = 1e-9  # Metres: of rounding.
_FLIGHT = np.array([[1, 1], [0, 0], [0, 0], [1, 1], [1, 1]])


def _draw(
  name: str,
  ahead: float | np.ndarray = 0.0,
  motions: tuple[motion_lib.ReferenceMotion, ...] = _MOTIONS,
  seed: int = 0,
) -> obstacles.Obstacles:
  """Many obstacles for one mode."""
  known = mode_set.one_hot(motions)
  return obstacles.ObstacleSource(known).draw(
    np.full(_COUNT, known.index(name)),
    np.broadcast_to(np.asarray(ahead, dtype=np.float64), (_COUNT,)),
    np.random.RandomState(seed),
  )


def _user_mode(
  kind: str, length: float, contacts: np.ndarray | None = None
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """A mode of four equal parts that goes straight on for a second."""
  phases = np.linspace(0.0, 1.0, 5)
  x = phases * length
  return (
    motion_lib.ReferenceMotion(
      name='mine',
      kind=kind,
      duration=1.0,
      phases=phases,
      positions=np.column_stack([x, 0 * x, 0 * x + 0.5]),
      orientations=np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
      contacts=contacts,
    ),
  )


def _assert_spread(values: np.ndarray, lowest: float, highest: float) -> None:
  """They are between the bounds, and come near them both."""
  margin = 0.02 * (highest - lowest)
  assert lowest - _HAIR <= values.min() <= lowest + margin
  assert highest - margin <= values.max() <= highest + _HAIR


@pytest.mark.parametrize('ahead', (0.0, 0.3))  # Where it is does not matter.
def test_block_of_a_launch(ahead: float) -> None:
  drawn = _draw('launch', ahead)
  _assert_spread(drawn.edge, 0.2, 0.42)
  _assert_spread(drawn.height, 0.0, 0.4)
  assert drawn.gap.min() == 0.0
  # The gap ends at the edge; where it begins there is room for the feet.
  begin = drawn.edge - drawn.gap
  assert 0.15 - _HAIR <= begin.min() < 0.15 + _HAIR
  assert np.mean(drawn.gap == 0) == pytest.approx(0.2 / 0.5, abs=0.03)


def test_height_is_a_share_of_the_mode_s_own() -> None:
  ledge = motion_lib.Ledge(edge=0.27, height=0.1)
  low = dataclasses.replace(library.modes()['launch'], ledge=ledge)
  _assert_spread(_draw('launch', motions=(low,)).height, 0.0, 0.1)


# Gaps are under what leap and hop fly over: from 0.138 to 0.462 m and from 0.24
# to 0.36 m, at 0.3 m half of it, and again after cycles of 0.6 and 0.36 m. The
# mode of a user flies from 0.25 to 0.75 m.
def _middles(drawn: obstacles.Obstacles, widest: float = 0.65) -> np.ndarray:
  _assert_spread(drawn.gap, 0.1, widest)
  level = drawn.height == 0
  assert np.mean(level) == pytest.approx(0.5, abs=0.03)
  _assert_spread(drawn.height[~level], -0.15, 0.1)
  return drawn.edge - drawn.gap / 2


@pytest.mark.parametrize(
  ('name', 'cycle', 'widest'),
  [('leap_forward', 0.6, 1.4 * 0.324), ('hop_forward', 0.36, 1.4 * 0.12)],
)
def test_gap_under_the_first_flight_or_the_second(
  name: str, cycle: float, widest: float
) -> None:
  middle = _middles(_draw(name), widest)
  second = middle > 0.3 + cycle / 2
  assert np.mean(second) == pytest.approx(0.5, abs=0.03)
  _assert_spread(middle[~second], 0.24, 0.36)
  _assert_spread(middle[second], 0.24 + cycle, 0.36 + cycle)
  # Under the second where the first has begun.
  for ahead in (1e-6, 0.2):
    middle = _middles(_draw(name, ahead), widest)
    _assert_spread(middle, 0.24 + cycle, 0.36 + cycle)


def test_gap_of_a_user_s_mode() -> None:
  mode = _user_mode(motion_lib.PERIODIC, 1.0, _FLIGHT)
  _assert_spread(_middles(_draw('mine', 0.1, mode)), 1.44, 1.56)


def test_ledges_are_ahead_of_each_walking_robot() -> None:
  ahead = np.random.RandomState(1).uniform(0, 0.36, _COUNT)
  drawn = _draw('walk_forward', ahead)
  _assert_spread(drawn.edge - ahead, 0.15, 1.2)
  _assert_spread(drawn.height, -0.2, 0.04)
  np.testing.assert_array_equal(drawn.gap, 0.0)
  np.testing.assert_allclose(
    drawn.edge - ahead, _draw('walk_forward').edge, atol=_HAIR
  )
  # A mode without contacts walks.
  drawn = _draw('mine', motions=_user_mode(motion_lib.PERIODIC, 0.3))
  _assert_spread(drawn.edge, 0.15, 1.2)
  np.testing.assert_array_equal(drawn.gap, 0.0)


@pytest.mark.parametrize(
  'motions',
  [
    _user_mode(motion_lib.PERIODIC, 0.09),  # Slow.
    _user_mode(motion_lib.TRANSIENT, 0.5, _FLIGHT),  # Once, on level ground.
  ],
)
def test_nothing_for_others(
  motions: tuple[motion_lib.ReferenceMotion, ...],
) -> None:
  edge, height, gap = _draw('mine', motions=motions)
  np.testing.assert_array_equal(edge, np.inf)
  np.testing.assert_array_equal([height, gap], 0.0)


def test_each_robot_meets_what_suits_its_mode() -> None:
  count = len(_MOTIONS)
  modes = np.random.RandomState(2).permutation(np.tile(np.arange(count), 50))
  known = mode_set.one_hot(_MOTIONS)
  drawn = obstacles.ObstacleSource(known).draw(
    modes, np.zeros(len(modes)), np.random.RandomState(0)
  )
  of = lambda *names: np.isin(modes, [known.index(name) for name in names])
  flying = of('leap_forward', 'leap_far', 'hop_forward')
  jumping = of('launch', 'step_down')
  meeting = of('walk_forward') | flying | jumping
  np.testing.assert_array_equal(np.isfinite(drawn.edge), meeting)
  np.testing.assert_array_equal(drawn.height[~meeting], 0.0)
  np.testing.assert_array_equal((drawn.gap >= 0.1) & ~jumping, flying)
  assert drawn.height[~of('launch')].max() <= 0.1 + _HAIR
  assert drawn.height[of('launch')].max() > 0.3
  assert drawn.height[of('walk_forward')].min() < -0.15 - _HAIR
  none = np.zeros(0, dtype=np.int64)
  drawn = obstacles.ObstacleSource(known).draw(
    none, np.zeros(0), np.random.RandomState(0)
  )
  assert [field.shape for field in drawn] == [(0,)] * 3
