"""Tests of dmc_multimode.modes.schedule."""

from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.modes import schedule

_NEVER = np.iinfo(np.int64).max


_PI2 = library.mode_set('pi2')


def test_start_steps() -> None:
  plan = schedule.ModeSchedule(
    np.zeros((2, 3), dtype=np.int64),
    np.array([[0.0, 0.3, 0.46], [0.0, 1.2, np.inf]]),
    np.ones(2),
  )
  assert len(plan) == 2
  np.testing.assert_array_equal(
    plan.start_steps(0.03), [[0, 10, 15], [0, 40, _NEVER]]
  )


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'modes': np.zeros(2)}, 'one shape'),
    ({'starts': np.zeros((1, 3))}, 'one shape'),
    ({'modes': np.zeros((1, 0)), 'starts': np.zeros((1, 0))}, 'one shape'),
    ({'clock_rate': np.ones(2)}, 'clock rate'),
    ({'starts': np.array([[0.1, 0.2]])}, 'time 0'),
    ({'starts': np.array([[0.0, 0.0]])}, 'rise'),
    ({'clock_rate': np.zeros(1)}, 'positive'),
  ],
)
def test_rejects(changes: dict[str, Any], message: str) -> None:
  fields: dict[str, Any] = {
    'modes': np.zeros((1, 2), dtype=np.int64),
    'starts': np.array([[0.0, 1.0]]),
    'clock_rate': np.ones(1),
  }
  with pytest.raises(ValueError, match=message):
    schedule.ModeSchedule(**{**fields, **changes})


def test_transitions_switch_after_clips_and_phase() -> None:
  walk, launch = _PI2.index('walk_forward'), _PI2.index('launch')
  plan = schedule.transitions(
    _PI2,
    initial=np.array([walk, walk, launch, launch, walk]),
    final=np.array([0, 2, 0, 1, 0]),
    clips=np.array([0, 1, 0, 1, 1]),
    phases=np.array([0.25, 0.5, 0.25, 0.25, 0.5]),
    clock_rate=np.array([1.0, 1.0, 1.0, 1.0, 2.0]),
  )
  np.testing.assert_array_equal(plan.modes[:, 1], [0, 2, 0, 1, 0])
  # Walk lasts 0.6 s; launch 1.1 s, and it is not left before it lands.
  expected = [0.15, 0.9, 0.82 * 1.1, 1.25 * 1.1, 0.45]
  np.testing.assert_allclose(plan.starts[:, 1], expected)
  np.testing.assert_array_equal(plan.last_modes(), plan.modes[:, 1])


def test_from_knots_and_single_modes() -> None:
  plan = schedule.from_knots(np.array([[1, 0, 2]]), 0.3, clock_rate=0.8)
  np.testing.assert_array_equal(plan.modes, [[1, 0, 2]])
  np.testing.assert_allclose(plan.starts, [[0, 0.3, 0.6]])
  np.testing.assert_allclose(plan.clock_rate, [0.8])
  with pytest.raises(ValueError, match='longer than 0'):
    schedule.from_knots(np.array([[1, 0]]), 0.0)
  plan = schedule.single(np.array([2, 0]), clock_rate=1.5)
  np.testing.assert_array_equal(plan.modes, [[2], [0]])
  np.testing.assert_array_equal(plan.starts, [[0], [0]])
  np.testing.assert_array_equal(plan.clock_rate, [1.5, 1.5])


def test_from_names() -> None:
  names, durations = schedule.parse('walk_forward:2, leap_forward:3,idle:1')
  plan = schedule.from_names(_PI2, names, durations)
  np.testing.assert_array_equal(plan.modes, [[1, 2, 0]])
  np.testing.assert_allclose(plan.starts, [[0, 2, 5]])


@pytest.mark.parametrize(
  ('names', 'durations', 'message'),
  [
    (['fly'], [1.0], "'fly'"),
    (['idle'], [-1.0], 'positive'),
    (['idle'], [float('inf')], 'positive'),
    (['idle'], [], 'as many'),
    ([], [], 'at least 1'),
  ],
)
def test_from_names_rejects(
  names: list[str], durations: list[float], message: str
) -> None:
  with pytest.raises(ValueError, match=message):
    schedule.from_names(_PI2, names, durations)


@hypothesis.given(
  st.lists(
    st.tuples(st.sampled_from(_PI2.names), st.floats(1e-3, 1e3)), min_size=1
  )
)
def test_parse_reads_what_is_written(items: list[tuple[str, float]]) -> None:
  text = ', '.join(f'{name}:{seconds!r}' for name, seconds in items)
  assert list(zip(*schedule.parse(text), strict=True)) == items


@hypothesis.given(st.text('idle:,. 0123e-+nan', max_size=12))
@hypothesis.example('')
@hypothesis.example(':2')
@hypothesis.example('idle:inf')
@hypothesis.example('idle:1:2')
def test_parse_answers_or_refuses_in_one_line(text: str) -> None:
  try:
    _, durations = schedule.parse(text)
  except ValueError as error:
    assert 'MODE:SECONDS' in str(error)
    assert '\n' not in str(error)
  else:
    assert 0 < min(durations) and max(durations) < np.inf
