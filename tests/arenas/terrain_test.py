"""Tests of dmc_multimode.arenas.terrain."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from dmc_multimode.arenas import terrain


def _terrain(
  *segments: tuple[float, float, float], num_segments: int = 4
) -> terrain.Terrain:
  """One terrain of (start, end, top) triples."""
  result = terrain.empty(1, num_segments)
  for i, segment in enumerate(segments):
    for field, value in zip(result, segment, strict=True):
      field[0, i] = value
  return result


# Ground, a gap of 0.5 m, a plateau of 0.2 m that a block of 0.6 m touches.
_COURSE = _terrain((-20, 1, 0), (1.5, 2, 0.2), (2, 9, 0.6))


def _at(course: terrain.Terrain, *x: float) -> np.ndarray:
  """Support heights of one terrain under several points."""
  worlds = course.rows(np.zeros(len(x), dtype=np.int64))
  return terrain.support_height(worlds, np.array(x))


@st.composite
def _courses(draw: st.DrawFn) -> list[tuple[float, float, float]]:
  """Segments in order, with or without gaps between them."""
  size = st.floats(0.1, 3.0)
  x, segments = -5.0, []
  for _ in range(draw(st.integers(1, 4))):
    start = x + draw(st.one_of(st.just(0.0), size))
    x = start + draw(size)
    segments.append((start, x, draw(st.floats(-1.0, 1.0))))
  return segments


def test_overhang_by_hand() -> None:
  # On level ground; a toe over the gap; both ends over narrow ground; a heel
  # lower than the block; all of it in the gap.
  x = np.array([[0.5, 0.96, 1.75, 2.02, 1.25]])
  found = terrain.overhang(_COURSE, x, 0.06, 0.02)
  np.testing.assert_array_equal(found, [[0.0, 0.5, 0.0, 0.5, 0.0]])
  found = terrain.overhang(_COURSE, x, 0.3, 0.02)
  np.testing.assert_array_equal(found, [[0.0, 0.5, 1.0, 0.5, 1.0]])


_END = (np.inf, 0.0, 0.0)


@pytest.mark.parametrize(
  ('x', 'height', 'following'),
  [
    (-30.0, 0.0, (1.5, 0.2, 0.5)),  # Behind everything: the first segment.
    (1.0, 0.0, (1.5, 0.2, 0.5)),
    (1.25, 0.0, (1.5, 0.2, 0.5)),  # Over the gap: that before it.
    (1.4999, 0.0, (1.5, 0.2, 0.5)),
    (1.5, 0.2, (2.0, 0.4, 0.0)),  # An edge belongs to what starts there.
    (1.9999, 0.2, (2.0, 0.4, 0.0)),
    (2.0, 0.6, _END),
    (50.0, 0.6, _END),  # Past the end: the last one.
  ],
)
def test_support_height_and_next_segment_by_hand(
  x: float, height: float, following: tuple[float, float, float]
) -> None:
  assert _at(_COURSE, x)[0] == height
  np.testing.assert_allclose(_next(_COURSE, x), following, atol=1e-12)


@pytest.mark.parametrize(
  ('x', 'reach', 'expected'),
  [
    (0.0, 0.2, 0.0),
    (1.4, 0.2, 0.2),  # The plateau is within reach over the gap.
    (1.9, 0.2, 0.6),
    (1.7, 0.1, 0.2),
    (1.25, 0.1, 0.0),  # Nothing within reach: the support's own.
  ],
)
def test_clearance_height_by_hand(
  x: float, reach: float, expected: float
) -> None:
  height = terrain.clearance_height(_COURSE, np.array([x]), reach)
  assert height[0] == expected
  # It sees what lies behind.
  down = _terrain((-20, 1, 0.5), (1, 20, 0.0))
  assert terrain.clearance_height(down, np.array([1.05]), 0.1)[0] == 0.5


def test_profile_by_hand() -> None:
  two = _COURSE.rows(np.array([0, 0]))
  x = np.array([[0.0, 1.2, 1.5], [1.9, 2.5, 9.5]])
  heights = terrain.profile(two, x, nothing=-1.0)
  np.testing.assert_array_equal(heights, [[0.0, -1.0, 0.2], [0.2, 0.6, -1.0]])


def _next(course: terrain.Terrain, x: float) -> tuple[float, float, float]:
  """Returns `next_segment` of one point of one terrain."""
  start, rise, gap = terrain.next_segment(course, np.array([x]))
  return float(start[0]), float(rise[0]), float(gap[0])


def test_next_segment_of_each_world() -> None:
  """The last two are of a ledge down, and of a pool without a free row."""
  several = terrain.empty(5, 4)
  several.write(np.array([0, 2]), _COURSE.rows(np.array([0, 0])))
  several.write(np.array([1]), _terrain((-20, 20, 0.1)))
  several.write(np.array([3]), _terrain((-20, 1, 0.5), (1.25, 20, 0.125)))
  full = [(-20, 0, 0), (0, 1, 0.4), (1, 2, 0.4), (2, 9, 0.4)]
  several.write(np.array([4]), _terrain(*full))
  x = np.array([0.0, 0.0, 1.75, 0.0, 7.0])
  start, rise, gap = terrain.next_segment(several, x)
  np.testing.assert_array_equal(start, [1.5, np.inf, 2.0, 1.25, np.inf])
  np.testing.assert_allclose(rise, [0.2, 0.0, 0.4, -0.375, 0.0])
  np.testing.assert_allclose(gap, [0.5, 0.0, 0.0, 0.25, 0.0])


@hypothesis.settings(max_examples=100, deadline=None)
@hypothesis.given(segments=_courses(), x=st.floats(-10.0, 25.0))
def test_support_is_what_started_last_and_next_what_did_not(
  segments: list[tuple[float, float, float]], x: float
) -> None:
  course = _terrain(*segments)
  under = max(sum(start <= x for start, _, _ in segments) - 1, 0)
  assert _at(course, x)[0] == segments[under][2]
  expected = _END
  if under + 1 < len(segments):
    (_, end, here), (start, _, there) = segments[under : under + 2]
    expected = (start, there - here, start - end)
  assert _next(course, x) == expected


def test_with_ledge_by_hand() -> None:
  """Relative to the support; a gap ends at the ledge."""
  four = _COURSE.rows(np.zeros(4, dtype=np.int64))
  after = terrain.with_ledge(
    four,
    np.array([0.0, 0.0, 1.75, 2.5]),
    np.array([0.5, 0.75, 2.25, 3.0]),
    np.array([0.25, -0.1, -0.1, 0.0]),
    np.array([0.0, 0.25, 0.25, 0.375]),
  )
  none = np.inf
  np.testing.assert_array_equal(
    after.starts,
    [
      [-20, 0.5, none, none],
      [-20, 0.75, none, none],
      [-20, 1.5, 2.25, none],
      [-20, 1.5, 2, 3],
    ],
  )
  np.testing.assert_array_equal(
    after.ends,
    [
      [0.5, 9, none, none],
      [0.5, 9, none, none],
      [1, 2, 9, none],
      [1, 2, 2.625, 9],
    ],
  )
  np.testing.assert_allclose(
    after.tops,
    [[0, 0.25, 0, 0], [0, -0.1, 0, 0], [0, 0.2, 0.1, 0], [0, 0.2, 0.6, 0.6]],
  )
  np.testing.assert_array_equal(four.tops, _COURSE.tops.repeat(4, axis=0))


@hypothesis.settings(max_examples=100, deadline=None)
@hypothesis.given(
  segments=_courses(),
  x=st.floats(-5.0, 12.0),
  ahead=st.floats(0.5, 2.0),
  height=st.floats(-0.5, 0.5),
  gap=st.floats(0.0, 0.4),
)
def test_is_what_comes_next(
  segments: list[tuple[float, float, float]],
  x: float,
  ahead: float,
  height: float,
  gap: float,
) -> None:
  edge = x + ahead
  hypothesis.assume(edge > segments[0][0])
  before = _terrain(*segments, num_segments=5)
  after = terrain.with_ledge(
    before, np.array([x]), np.array([edge]), np.array([height]), np.array([gap])
  )
  np.testing.assert_allclose(_next(after, x), (edge, height, gap), atol=1e-9)
  # Nothing follows, and nothing has changed up to here.
  assert _next(after, edge) == _END
  for behind in np.linspace(-6.0, x, 9):
    assert _at(after, behind) == _at(before, behind)


def test_past_the_end_there_is_ground_still() -> None:
  stepped = terrain.with_ledge(_COURSE, np.array([8.9]), np.array([9.2]), 0.4)
  used = np.isfinite(stepped.ends)
  assert np.all(stepped.ends[used] > stepped.starts[used])
  assert stepped.ends[used].max() >= 10.0


def test_rejects_when_the_pool_is_used_up() -> None:
  full = _terrain((-20, 1, 0), (1, 9, 0.4), num_segments=2)
  with pytest.raises(ValueError, match='only 2 segments'):
    terrain.with_ledge(full, np.array([2.0]), np.array([2.3]), 0.4)


def test_the_first_segment_of_a_full_pool_is_given_up() -> None:
  full = _terrain((-20, 1, 0), (1, 2, 0.4), (2, 9, 0.8), num_segments=3)
  free = _terrain((-20, 1, 0), (1, 9, 0.4), num_segments=3)
  two = terrain.Terrain(*map(np.concatenate, zip(full, free, strict=True)))
  found = terrain.with_ledge(
    two, np.array([3.0, 3.0]), np.array([3.5, 3.5]), 0.4, np.array([0.1, 0.0])
  )
  for row, expected in enumerate(
    (
      _terrain((-20, 2, 0.4), (2, 3.4, 0.8), (3.5, 9, 1.2), num_segments=3),
      _terrain((-20, 1, 0), (1, 3.5, 0.4), (3.5, 9, 0.8), num_segments=3),
    )
  ):
    for mine, theirs in zip(found, expected, strict=True):
      np.testing.assert_allclose(mine[row], theirs[0])


def test_levelled_by_hand() -> None:
  """Also over the gap, which the ground before it then fills."""
  three = _COURSE.rows(np.zeros(3, dtype=np.int64))
  level = terrain.levelled(three, np.array([1.25, 1.5, 3.0]))
  none = np.inf
  np.testing.assert_array_equal(
    level.starts,
    [[-20] + 3 * [none], [-20, 1.5, none, none], [-20, 1.5, 2, none]],
  )
  np.testing.assert_array_equal(
    level.ends, [[9] + 3 * [none], [1, 9, none, none], [1, 2, 9, none]]
  )
  np.testing.assert_array_equal(
    level.tops, [[0, 0, 0, 0], [0, 0.2, 0, 0], [0, 0.2, 0.6, 0]]
  )
  np.testing.assert_array_equal(three.tops, _COURSE.tops.repeat(3, axis=0))
  nobody = _COURSE.rows(np.zeros(0, dtype=np.int64))
  assert terrain.levelled(nobody, np.zeros(0)).starts.shape == (0, 4)


def test_levelled_behind_by_hand() -> None:
  three = _COURSE.rows(np.zeros(3, dtype=np.int64))
  level = terrain.levelled_behind(three, np.array([0.0, 1.7, 3.0]))
  none = np.inf
  np.testing.assert_array_equal(
    level.starts,
    [[-20, 1.5, 2, none], [-20, 2, none, none], [-20] + 3 * [none]],
  )
  np.testing.assert_array_equal(
    level.ends, [[1, 2, 9, none], [2, 9, none, none], [9] + 3 * [none]]
  )
  np.testing.assert_array_equal(
    level.tops, [[0, 0.2, 0.6, 0], [0.2, 0.6, 0, 0], [0.6, 0, 0, 0]]
  )
  assert _at(_COURSE, 0.0)[0] == 0.0  # The old one is untouched.


@hypothesis.settings(max_examples=100, deadline=None)
@hypothesis.given(segments=_courses(), x=st.floats(-10.0, 25.0))
def test_levelled_on_one_side_and_as_before_on_the_other(
  segments: list[tuple[float, float, float]], x: float
) -> None:
  before, here = _terrain(*segments), np.array([x])
  behind, ahead = np.linspace(-11.0, x, 9), np.linspace(x, 30.0, 9)
  level = terrain.levelled(before, here)
  assert _next(level, x) == _END
  assert level.ends[np.isfinite(level.starts)][-1] == segments[-1][1]
  np.testing.assert_array_equal(_at(level, *behind), _at(before, *behind))
  np.testing.assert_array_equal(_at(level, *ahead), _at(before, x)[0])
  level = terrain.levelled_behind(before, here)
  np.testing.assert_array_equal(_at(level, *behind), _at(before, x)[0])
  np.testing.assert_array_equal(_at(level, *ahead), _at(before, *ahead))


def test_boxes_by_hand() -> None:
  centres, halves = terrain.boxes(_COURSE)
  np.testing.assert_allclose(
    centres[0, :3], [[-9.5, 0, -0.5], [1.75, 0, -0.3], [5.5, 0, 0.1]]
  )
  np.testing.assert_allclose(
    halves[0, :3], [[10.5, 4, 0.5], [0.25, 4, 0.5], [3.5, 4, 0.5]]
  )
  # The unused one is out of the way.
  assert centres[0, 3, 2] < -50.0
  assert np.isfinite(centres).all()
  assert np.all(halves > 0)
