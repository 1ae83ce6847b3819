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


@pytest.mark.parametrize(
  ('x', 'expected'),
  [
    (-30.0, 0.0),  # Behind everything: the first segment.
    (0.0, 0.0),
    (1.0, 0.0),
    (1.25, 0.0),  # Over the gap: that before it.
    (1.4999, 0.0),
    (1.5, 0.2),  # An edge belongs to the segment that starts there.
    (1.9999, 0.2),
    (2.0, 0.6),
    (50.0, 0.6),  # Past the end: the last one.
  ],
)
def test_support_height_by_hand(x: float, expected: float) -> None:
  assert _at(_COURSE, x)[0] == expected


def test_batch() -> None:
  both = terrain.empty(2, 4)
  both.write(np.array([0]), _COURSE)
  both.write(np.array([1]), _terrain((-20, 20, 0.1)))
  heights = terrain.support_height(both, np.array([1.7, 1.7]))
  np.testing.assert_array_equal(heights, [0.2, 0.1])


@hypothesis.settings(max_examples=100, deadline=None)
@hypothesis.given(segments=_courses(), x=st.floats(-10.0, 25.0))
def test_is_the_last_segment_that_has_started(
  segments: list[tuple[float, float, float]], x: float
) -> None:
  started = [top for start, _, top in segments if start <= x]
  expected = started[-1] if started else segments[0][2]
  assert _at(_terrain(*segments), x)[0] == expected


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


def test_sees_what_lies_behind() -> None:
  down = _terrain((-20, 1, 0.5), (1, 20, 0.0))
  height = terrain.clearance_height(down, np.array([1.05]), 0.1)
  assert height[0] == 0.5


def _next(course: terrain.Terrain, x: float) -> tuple[float, float, float]:
  """What follows the segment under one point of one terrain."""
  start, rise, gap = terrain.next_segment(course, np.array([x]))
  return float(start[0]), float(rise[0]), float(gap[0])


@pytest.mark.parametrize(
  ('x', 'expected'),
  [
    (-30.0, (1.5, 0.2, 0.5)),  # Behind everything: after the first segment.
    (0.0, (1.5, 0.2, 0.5)),
    (1.25, (1.5, 0.2, 0.5)),  # Over the gap, of which all counts.
    (1.5, (2.0, 0.4, 0.0)),
    (1.9999, (2.0, 0.4, 0.0)),
    (2.0, (np.inf, 0.0, 0.0)),
    (50.0, (np.inf, 0.0, 0.0)),
  ],
)
def test_next_segment_by_hand(
  x: float, expected: tuple[float, float, float]
) -> None:
  np.testing.assert_allclose(_next(_COURSE, x), expected, atol=1e-12)


def test_step_down() -> None:
  down = _terrain((-20, 1, 0.5), (1.25, 20, 0.125))
  assert _next(down, 0.0) == (1.25, -0.375, 0.25)


@pytest.mark.parametrize('x', [0.0, 1.0, 7.0])
def test_none_where_the_pool_ends(x: float) -> None:
  full = _terrain((-20, 0, 0), (0, 9, 0.4), num_segments=2)
  assert _next(full, x) == (np.inf, 0.0, 0.0)


def test_next_segment_worlds_are_told_apart() -> None:
  both = terrain.empty(3, 4)
  both.write(np.array([0, 2]), _COURSE.rows(np.array([0, 0])))
  both.write(np.array([1]), _terrain((-20, 20, 0.1)))
  start, rise, gap = terrain.next_segment(both, np.array([0.0, 0.0, 1.75]))
  np.testing.assert_array_equal(start, [1.5, np.inf, 2.0])
  np.testing.assert_allclose(rise, [0.2, 0.0, 0.4])
  np.testing.assert_allclose(gap, [0.5, 0.0, 0.0])


@hypothesis.settings(max_examples=100, deadline=None)
@hypothesis.given(segments=_courses(), x=st.floats(-10.0, 25.0))
def test_is_the_first_segment_that_has_not_started(
  segments: list[tuple[float, float, float]], x: float
) -> None:
  under = max(sum(start <= x for start, _, _ in segments) - 1, 0)
  expected = (np.inf, 0.0, 0.0)
  if under + 1 < len(segments):
    (_, end, here), (start, _, there) = segments[under : under + 2]
    expected = (start, there - here, start - end)
  assert _next(_terrain(*segments), x) == expected


def test_with_ledge_by_hand() -> None:
  stepped = terrain.with_ledge(_COURSE, np.array([0.0]), np.array([0.3]), 0.4)
  np.testing.assert_array_equal(stepped.starts, [[-20, 0.3, np.inf, np.inf]])
  np.testing.assert_array_equal(stepped.ends, [[0.3, 9, np.inf, np.inf]])
  np.testing.assert_array_equal(stepped.tops, [[0, 0.4, 0, 0]])
  assert _at(_COURSE, 1.7)[0] == 0.2  # The old one is untouched.


def test_is_relative_to_the_support() -> None:
  stepped = terrain.with_ledge(_COURSE, np.array([1.7]), np.array([1.9]), -0.1)
  np.testing.assert_allclose(
    _at(stepped, 0.0, 1.25, 1.7, 1.95), [0.0, 0.0, 0.2, 0.1]
  )


def test_gap_ends_at_the_step() -> None:
  stepped = terrain.with_ledge(
    _COURSE, np.array([0.0]), np.array([0.75]), -0.1, 0.25
  )
  np.testing.assert_array_equal(stepped.starts, [[-20, 0.75, np.inf, np.inf]])
  np.testing.assert_array_equal(stepped.ends, [[0.5, 9, np.inf, np.inf]])
  np.testing.assert_array_equal(stepped.tops, [[0, -0.1, 0, 0]])


def test_heights_and_gaps_of_each_world() -> None:
  three = _COURSE.rows(np.zeros(3, dtype=np.int64))
  stepped = terrain.with_ledge(
    three,
    np.array([0.0, 1.75, 2.5]),
    np.array([0.5, 2.25, 3.0]),
    np.array([0.25, -0.1, 0.0]),
    np.array([0.0, 0.25, 0.375]),
  )
  none = np.inf
  np.testing.assert_array_equal(
    stepped.starts,
    [
      [-20, 0.5, none, none],
      [-20, 1.5, 2.25, none],
      [-20, 1.5, 2, 3],
    ],
  )
  np.testing.assert_array_equal(
    stepped.ends,
    [[0.5, 9, none, none], [1, 2, 9, none], [1, 2, 2.625, 9]],
  )
  np.testing.assert_allclose(
    stepped.tops,
    [[0, 0.25, 0, 0], [0, 0.2, 0.1, 0], [0, 0.2, 0.6, 0.6]],
  )


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
    before,
    np.array([x]),
    np.array([edge]),
    np.array([height]),
    np.array([gap]),
  )
  np.testing.assert_allclose(_next(after, x), (edge, height, gap), atol=1e-9)
  # Nothing follows, and nothing has changed up to here.
  assert _next(after, edge) == (np.inf, 0.0, 0.0)
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


@pytest.mark.parametrize('x', [0.0, 1.0, 1.25, 1.4999])
def test_levelled_by_hand(x: float) -> None:
  """Also over the gap, which the ground before it then fills."""
  level = terrain.levelled(_COURSE, np.array([x]))
  np.testing.assert_array_equal(level.starts, [[-20] + [np.inf] * 3])
  np.testing.assert_array_equal(level.ends, [[9] + [np.inf] * 3])
  np.testing.assert_array_equal(level.tops, [[0, 0, 0, 0]])
  assert _at(_COURSE, 1.7)[0] == 0.2  # The old one is untouched.


def test_what_is_behind_stays() -> None:
  level = terrain.levelled(_COURSE, np.array([1.5]))
  none = np.inf
  np.testing.assert_array_equal(level.starts, [[-20, 1.5, none, none]])
  np.testing.assert_array_equal(level.ends, [[1, 9, none, none]])
  np.testing.assert_array_equal(level.tops, [[0, 0.2, 0, 0]])


def test_level_ground_stays_as_it_is() -> None:
  ground = _terrain((-20, 20, 0.1))
  level = terrain.levelled(ground, np.array([3.0]))
  for mine, theirs in zip(level, ground, strict=True):
    np.testing.assert_array_equal(mine, theirs)


def test_levelled_worlds_are_told_apart() -> None:
  three = _COURSE.rows(np.zeros(3, dtype=np.int64))
  level = terrain.levelled(three, np.array([0.0, 1.7, 3.0]))
  np.testing.assert_array_equal(
    terrain.support_height(level, np.full(3, 5.0)), [0.0, 0.2, 0.6]
  )
  np.testing.assert_array_equal(
    np.isfinite(level.starts).sum(axis=1), [1, 2, 3]
  )


def test_no_world_at_all() -> None:
  nobody = _COURSE.rows(np.zeros(0, dtype=np.int64))
  level = terrain.levelled(nobody, np.zeros(0))
  assert level.starts.shape == (0, 4)


@hypothesis.settings(max_examples=100, deadline=None)
@hypothesis.given(segments=_courses(), x=st.floats(-10.0, 25.0))
def test_goes_on_as_it_is_to_the_end(
  segments: list[tuple[float, float, float]], x: float
) -> None:
  before = _terrain(*segments)
  level = terrain.levelled(before, np.array([x]))
  assert _next(level, x) == (np.inf, 0.0, 0.0)
  used = np.isfinite(level.starts)
  assert level.ends[used][-1] == segments[-1][1]
  for behind in np.linspace(-11.0, x, 9):
    assert _at(level, behind) == _at(before, behind)
  ahead = _at(level, *np.linspace(x, 30.0, 9))
  np.testing.assert_array_equal(ahead, _at(before, x)[0])


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
def test_is_level_behind_and_as_before_ahead(
  segments: list[tuple[float, float, float]], x: float
) -> None:
  before = _terrain(*segments)
  level = terrain.levelled_behind(before, np.array([x]))
  behind = _at(level, *np.linspace(-11.0, x, 9))
  np.testing.assert_array_equal(behind, _at(before, x)[0])
  for ahead in np.linspace(x, 30.0, 9):
    assert _at(level, ahead) == _at(before, ahead)


def test_boxes_by_hand() -> None:
  centres, halves = terrain.boxes(_COURSE)
  np.testing.assert_allclose(
    centres[0, :3],
    [[-9.5, 0, -0.5], [1.75, 0, -0.3], [5.5, 0, 0.1]],
  )
  np.testing.assert_allclose(
    halves[0, :3], [[10.5, 4, 0.5], [0.25, 4, 0.5], [3.5, 4, 0.5]]
  )


def test_unused_boxes_are_out_of_the_way() -> None:
  centres, halves = terrain.boxes(_COURSE)
  assert centres[0, 3, 2] < -50.0
  assert np.isfinite(centres).all()
  assert np.all(halves > 0)
