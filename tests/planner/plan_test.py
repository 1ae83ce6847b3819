"""Tests of dmc_multimode.planner.plan."""

import json
import math
import pathlib
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes as pushes_lib

_PI2 = library.mode_set('pi2')
_PLAN = plan_lib.ModePlan(('idle', 'launch', 'launch', 'idle'), 0.3)


def test_schedule() -> None:
  schedule = _PLAN.schedule(_PI2)
  np.testing.assert_array_equal(schedule.modes, [[0, 3, 3, 0]])
  np.testing.assert_allclose(schedule.starts, [[0.0, 0.3, 0.6, 0.9]])
  assert _PLAN.duration == pytest.approx(1.2)


def test_segments() -> None:
  names, durations = _PLAN.segments()
  assert names == ['idle', 'launch', 'idle']
  assert durations == pytest.approx([0.3, 0.6, 0.3])


def test_from_indices() -> None:
  assert plan_lib.from_indices([0, 3, 3, 0], _PI2.names, 0.3) == _PLAN


def test_unknown_mode() -> None:
  plan = plan_lib.ModePlan(('idle', 'hop_forward'), 0.3)
  with pytest.raises(ValueError, match="'hop_forward'.*knows idle, walk"):
    plan.schedule(_PI2)


@given(
  st.lists(st.sampled_from(_PI2.names), min_size=1, max_size=40),
  st.floats(1e-3, 10.0),
)
def test_round_trip(modes: list[str], dt: float) -> None:
  plan = plan_lib.ModePlan(tuple(modes), dt)
  values = json.loads(json.dumps(plan_lib.to_dict(plan)))
  assert plan_lib.from_dict({**values, 'more': 1}) == plan


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'plan': []}, '1 to 10000 knots'),
    ({'plan': 'idle'}, 'no list'),
    ({'plan': ['idle', 3, 'idle', '']}, 'names of modes, got 3'),
    ({'knots': 3}, '4 modes for 3 knots'),
    ({'dt': 0.0}, 'longer than 0'),
    ({'dt': math.nan}, 'longer than 0|not a finite number'),
    ({'dt': '0.3'}, 'not seconds'),
    ({'dt': True}, 'not seconds'),
  ],
)
def test_rejects(
  changes: dict[str, Any], message: str, tmp_path: pathlib.Path
) -> None:
  values = {**plan_lib.to_dict(_PLAN), **changes}
  with pytest.raises(ValueError, match=message):
    plan_lib.from_dict(values)
  path = tmp_path / 'plan.json'
  path.write_text(json.dumps(values))
  with pytest.raises(ValueError, match=rf'plan\.json.*({message})'):
    plan_lib.read(path)


@pytest.mark.parametrize('key', ['plan', 'knots', 'dt'])
def test_lacks(key: str) -> None:
  values = plan_lib.to_dict(_PLAN)
  del values[key]
  with pytest.raises(ValueError, match=f"lacks '{key}'"):
    plan_lib.from_dict(values)


@pytest.mark.parametrize('text', ['', '[]', '3', '{', '[' * 100_000, '\0'])
def test_damaged_file(text: str, tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'plan.json'
  path.write_text(text)
  with pytest.raises(ValueError, match=r'plan\.json'):
    plan_lib.read(path)


def test_missing_file(tmp_path: pathlib.Path) -> None:
  with pytest.raises(FileNotFoundError, match=r'no plan .*none\.json'):
    plan_lib.read(tmp_path / 'none.json')


def test_course() -> None:
  values = {
    **plan_lib.to_dict(_PLAN),
    'arena': 'gap',
    'sizes': {'width': 0.3},
    'seed': 2,
  }
  assert plan_lib.course(values) == ('gap', {'width': 0.3}, 2, ())
  for changes in (
    {'arena': 3},
    {'sizes': {'width': 'wide'}},
    {'sizes': [0.3]},
    {'seed': -1},
    {'seed': None},
  ):
    with pytest.raises(ValueError, match='for which arena'):
      plan_lib.course({**values, **changes})


def test_course_with_pushes() -> None:
  values = {
    **plan_lib.to_dict(_PLAN),
    'arena': 'flat',
    'sizes': {},
    'seed': 0,
    'pushes': [{'time': 0.6, 'velocity': [0.5, 0, -0.1]}],
  }
  assert plan_lib.course(values).pushes == (
    pushes_lib.Push(0.6, (0.5, 0.0, -0.1)),
  )
  for time, message in ((0.7, 'not at a knot'), (1.2, 'outside of the plan')):
    values['pushes'] = [{'time': time, 'velocity': [0.5, 0.0, 0.0]}]
    with pytest.raises(ValueError, match=message):
      plan_lib.course(values)
  values['pushes'] = None
  with pytest.raises(ValueError, match='no pushes: None'):
    plan_lib.course(values)


def test_read(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'plan.json'
  path.write_text(json.dumps({**plan_lib.to_dict(_PLAN), 'seed': 4}))
  values = plan_lib.read(path)
  assert values['seed'] == 4
  assert plan_lib.from_dict(values) == _PLAN
