"""Tests of dmc_multimode.arenas.layouts and pieces."""

import hashlib
from typing import Any, Mapping

from dm_control.composer.variation import distributions
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.suite.reaching import problem as reaching

# Every size of every layout at its least and its most that tests go to.
_EXTREMES: Mapping[str, Mapping[str, tuple[float, float]]] = {
  'flat': {},
  'gap': {'distance': (0.1, 3.0), 'width': (0.0, 0.7)},
  'plateau': {
    'distance': (0.1, 3.0),
    'length': (0.1, 1.5),
    'height': (-0.4, 0.5),
  },
  'block': {'distance': (0.1, 3.0), 'height': (0.0, 0.6)},
  'block_down': {'distance': (0.1, 3.0), 'height': (0.0, 0.6)},
  'gap_block': {
    'distance': (0.1, 1.0),
    'width': (0.0, 0.5),
    'landing': (0.1, 1.0),
    'height': (0.0, 0.6),
  },
  'stairs': {
    'distance': (0.1, 3.0),
    'height': (0.02, 1.0),
    'rise': (0.02, 0.3),
    'tread': (0.1, 1.0),
    'landing': (0.1, 2.0),
  },
  'stepping_stones': {
    'distance': (0.1, 3.0),
    'length': (1.0, 6.0),
    'stone': (0.1, 0.5),
    'width': (0.0, 0.5),
  },
  'slope': {
    'distance': (0.1, 3.0),
    'height': (0.01, 1.0),
    'length': (0.3, 5.0),
    'landing': (0.0, 2.0),
  },
  'rough': {
    'distance': (0.1, 3.0),
    'length': (0.5, 5.0),
    'height': (0.0, 0.1),
    'tread': (0.1, 0.5),
  },
  'parkour': {},
  'obstacle_course': {'difficulty': (0.0, 1.0), 'length': (2.0, 40.0)},
  'gaps_and_blocks': {'length': (2.0, 40.0)},
}


@st.composite
def _cases(draw: st.DrawFn) -> tuple[str, dict[str, float], int]:
  """Name of a layout, its sizes, often at their extremes, and a seed."""
  name = draw(st.sampled_from(layouts.NAMES))
  sizes = {
    size: draw(st.one_of(st.sampled_from(bounds), st.floats(*bounds)))
    for size, bounds in _EXTREMES[name].items()
    if draw(st.booleans())
  }
  return name, sizes, draw(st.integers(0, 2**32 - 1))


@hypothesis.settings(max_examples=150, deadline=None)
@hypothesis.given(case=_cases())
def test_terrains_are_valid(case: tuple[str, dict[str, float], int]) -> None:
  name, sizes, seed = case
  most = layouts.most_pieces(name, sizes)
  arena = track.Track(layouts.make(name, sizes), most)
  drawn = arena.generate(np.random.RandomState(seed))
  used = np.isfinite(drawn.starts[0])
  starts, ends, tops = (field[0, used] for field in drawn)
  assert np.isfinite([starts, ends, tops]).all()
  assert np.all(ends > starts)
  assert np.all(starts[1:] >= ends[:-1])
  assert used[: len(starts)].all()
  assert starts[0] < -5.0 and tops[0] == 0.0
  assert ends[-1] > starts[-1] + 10.0
  assert arena.is_random == (len(starts) > 1 and name in _RANDOM)
  goal = reaching.problem(name, drawn, seed).goal
  reaching.check_goal(goal, drawn)
  assert name == 'flat' or goal[0] > starts[-1]


_RANDOM = ('rough', 'parkour', 'obstacle_course', 'gaps_and_blocks')


def test_every_size_has_extremes() -> None:
  assert {name: [*sizes] for name, sizes in _EXTREMES.items()} == {
    name: [*layouts.default_sizes(name)] for name in layouts.NAMES
  }


# --- What plan files refer to.


@pytest.mark.parametrize(
  ('name', 'expected'),
  [
    (
      'parkour',
      'ef309826fe0cf809d395f2cb927d509c7de9b9d5557384d7d0e32bd529ddf284',
    ),
    (
      'rough',
      '4ffe6afed9d57c02b0bff65eac45d97c0575000a487912d6121a29f2f322fa26',
    ),
    (
      'obstacle_course',
      'a9c4369bd5963799ee6550968d77419737f1d7a03938c1a3188b66d69296a16c',
    ),
    (
      'gaps_and_blocks',
      'af87b479dec965647bec1760d51c2657adcb47be8fed0a4a408f45c51ec81d12',
    ),
  ],
)
def test_seeds_draw_what_they_always_did(name: str, expected: str) -> None:
  """Bit for bit: a plan's file stores no more of its ground than the seed."""
  arena, digest = track.make(name), hashlib.sha256()
  for seed in range(100):
    for field in arena.generate(np.random.RandomState(seed)):
      digest.update(field.tobytes())
  assert digest.hexdigest() == expected


def test_old_tracks_are_as_large_as_ever() -> None:
  drawn = track.make('parkour').generate(np.random.RandomState(1))
  x = 0.7668088018810296, 1.4877418309337656
  assert tuple(drawn.starts[0, 1:3]) == x
  assert drawn.tops[0, 1] == 0.050017156222601736
  for name in ('flat', 'gap', 'plateau', 'block', 'gap_block', 'parkour'):
    assert track.make(name).num_segments == 6


# --- Courses.


def _draws(
  name: str, sizes: Mapping[str, float], count: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Returns starts, rises and gaps of all pieces but the first, metres."""
  arena, found = track.make(name, sizes=sizes), []
  for seed in range(count):
    drawn = arena.generate(np.random.RandomState(seed))
    used = np.isfinite(drawn.starts[0])
    starts, ends, tops = (field[0, used] for field in drawn)
    found.append((starts[1:], np.diff(tops), starts[1:] - ends[:-1]))
  return found


def test_courses_grow_with_difficulty() -> None:
  bounds = []
  for difficulty in (0.0, 0.5, 1.0):
    courses = _draws(
      'obstacle_course', {'difficulty': difficulty, 'length': 9.0}, 60
    )
    assert all(6.0 < starts[-1] <= 9.0 for starts, _, _ in courses)
    rises = np.concatenate([rises for _, rises, _ in courses])
    gaps = np.concatenate([gaps for _, _, gaps in courses])
    bounds.append([rises.max(), rises.min(), gaps.max()])
  np.testing.assert_allclose(bounds[0], [0.1, -0.1, 0.1])
  np.testing.assert_allclose(bounds[1], [0.26, -0.24, 0.3], atol=0.02)
  np.testing.assert_allclose(bounds[2], [0.44, -0.39, 0.49], atol=0.02)


def test_long_courses_have_every_obstacle() -> None:
  """Down a block, over the widest gap, up a slope."""
  ((_, rises, gaps),) = _draws(
    'obstacle_course', {'difficulty': 1.0, 'length': 20.0}, 1
  )
  assert rises.min() < -0.28
  assert np.any((gaps > 0.38) & (np.abs(rises) < 1e-9))
  assert np.sum((rises > 0.03) & (rises < 0.041)) >= 5


def test_gaps_and_blocks_of_the_benchmark() -> None:
  orders = set()
  for starts, rises, gaps in _draws('gaps_and_blocks', {}, 20):
    assert 7.0 < starts[-1] <= 9.0
    up, down, across = rises > 1e-9, rises < -1e-9, gaps > 1e-9
    assert np.all(across ^ up ^ down)
    assert np.all((0.2 <= gaps[across]) & (gaps[across] <= 0.35))
    assert np.all((0.2 <= rises[up]) & (rises[up] <= 0.35))
    blocks = starts[down] - starts[up]
    assert np.all((0.3 <= blocks) & (blocks <= 0.5))
    orders.add(tuple(across))
  assert len(orders) > 10


# --- Sizes.


@pytest.mark.parametrize(
  ('name', 'sizes', 'message'),
  [
    ('flat', {'length': 1.0}, "'flat' has no size 'length'; it has none"),
    ('parkour', {'difficulty': 0.5}, "no size 'difficulty'; it has none"),
    (
      'obstacle_course',
      {'depth': 1.0},
      "no size 'depth'; it has difficulty, length",
    ),
    ('obstacle_course', {'random_state': 1.0}, 'no size'),
    (
      'obstacle_course',
      {'difficulty': 1.1},
      'difficulty must be 0 to 1, got 1.1',
    ),
    (
      'obstacle_course',
      {'difficulty': np.nan},
      'difficulty must be 0 to 1, got nan',
    ),
    ('obstacle_course', {'length': 1.0}, 'length must be 2 to 40, got 1.0'),
    ('gaps_and_blocks', {'length': np.inf}, 'length must be 2 to 40, got inf'),
    ('rough', {'height': -0.1}, 'height must be 0 to 1, got -0.1'),
    ('rough', {'tread': 2.0}, '1.6 m in parts of 2.0 m must make 1 to 100'),
    ('stairs', {'rise': 0.001}, '0.3 m in parts of 0.001 m must make 1 to 100'),
    ('stairs', {'rise': 0.0}, '0.3 m in parts of 0.0 m must make 1 to 100'),
    ('stairs', {'height': np.inf}, 'inf m in parts of'),
    ('stairs', {'rise': distributions.Uniform(0.1, 0.2)}, 'must make 1 to'),
    ('stepping_stones', {'width': 1.3}, 'must make 1 to 100 parts'),
    ('stepping_stones', {'width': -0.1}, 'Piece 1 needs .* gap >= 0'),
    ('slope', {'length': 0.0}, 'Piece 1 needs length > 0'),
    ('block_down', {'height': np.nan}, 'Piece 1 needs .* all finite'),
    ('gap', {'width': np.nan}, 'Piece 1 needs .* gap >= 0'),
  ],
)
def test_bad_sizes(name: str, sizes: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message) as error:
    track.make(name, sizes=sizes)
  assert '\n' not in str(error.value)


def test_either_of_several_layouts() -> None:
  """Each with the sizes that it has, in a pool of boxes for the largest."""
  sizes = {'length': 4.0, 'width': 0.3}
  arena = track.make('gap+gaps_and_blocks', sizes=sizes)
  assert arena.is_random
  most = layouts.most_pieces('gaps_and_blocks', {'length': 4.0})
  assert arena.num_segments == most
  drawn = [arena.generate(np.random.RandomState(seed)) for seed in range(20)]
  counts = [int(np.isfinite(terrain.starts).sum()) for terrain in drawn]
  gaps = [t for t, count in zip(drawn, counts, strict=True) if count == 2]
  assert 4 <= len(gaps) <= 16
  for terrain in gaps:
    assert terrain.starts[0, 1] - terrain.ends[0, 0] == pytest.approx(0.3)
  ends = [
    t.starts[0, count - 1] for t, count in zip(drawn, counts, strict=True)
  ]
  assert max(ends) <= 4.0
  with pytest.raises(ValueError, match="'gap\\+flat' has no size 'length'"):
    track.make('gap+flat', sizes={'length': 4.0})
  with pytest.raises(ValueError, match="Unknown arena 'moat'; arenas are flat"):
    track.make('gap+moat')


def test_sizes_may_vary() -> None:
  """From draw to draw, where a layout does not count with them."""
  arena = track.make(
    'block_down', sizes={'height': distributions.Uniform(0.1, 0.3)}
  )
  random_state = np.random.RandomState(0)
  tops = [arena.generate(random_state).tops[0, 1] for _ in range(3)]
  assert arena.is_random and len(set(tops)) == 3
  assert all(-0.3 <= top <= -0.1 for top in tops)


def test_slope_is_a_slope() -> None:
  """It passes through the middles of the treads."""
  sizes = {'distance': 1.0, 'height': 0.3, 'length': 2.0, 'landing': 0.5}
  drawn = track.make('slope', sizes=sizes).generate(np.random.RandomState(0))
  x = np.arange(8) * 0.25 + 1.0
  for places, expected in (
    (x, 0.15 * (x - 1.0)),
    (6.5 - x, 0.15 * (x - 1.0)),
    (np.array([3.0, 3.5]), 0.3),
  ):
    terrains = drawn.rows(np.zeros(len(places), dtype=np.int64))
    heights = terrain_lib.support_height(terrains, places)
    np.testing.assert_allclose(heights, expected, atol=1e-9)
