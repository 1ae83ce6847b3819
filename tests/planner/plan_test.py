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
_PUSH = {'time': 0.6, 'velocity': [0.5, 0, -0.1]}
# As releases before this one wrote them.
_VALUES: dict[str, Any] = {
  'success': True,
  'plan': ['idle', 'launch', 'launch', 'idle'],
  'knots': 4,
  'dt': 0.3,
  'arena': 'gap',
  'sizes': {'width': 0.3},
  'seed': 2,
  'pushes': [_PUSH],
  'policy': 'pi2',
}


def test_schedule() -> None:
  schedule = _PLAN.schedule(_PI2)
  np.testing.assert_array_equal(schedule.modes, [[0, 3, 3, 0]])
  np.testing.assert_allclose(schedule.starts, [[0.0, 0.3, 0.6, 0.9]])
  assert _PLAN.duration == pytest.approx(1.2)
  assert plan_lib.from_indices([0, 3, 3, 0], _PI2.names, 0.3) == _PLAN
  names, durations = _PLAN.segments()
  assert names == ['idle', 'launch', 'idle']
  assert durations == [0.3, 0.6, 0.3]
  # 0.15 + 0.15 + 0.15 is 0.44999999999999996.
  assert plan_lib.ModePlan(('idle',) * 3, 0.15).segments()[1] == [0.45]
  with pytest.raises(ValueError, match="'hop_forward'.*knows idle, walk"):
    plan_lib.ModePlan(('idle', 'hop_forward'), 0.3).schedule(_PI2)


def test_read() -> None:
  file = plan_lib.PlanFile.from_dict(_VALUES)
  assert file.plan == _PLAN
  pushes = (pushes_lib.Push(0.6, (0.5, 0.0, -0.1)),)
  assert file.course == ('gap', {'width': 0.3}, 2, pushes)
  assert file.details == {'success': True, 'policy': 'pi2'}
  unpushed = {key: _VALUES[key] for key in _VALUES if key != 'pushes'}
  assert plan_lib.PlanFile.from_dict(unpushed).course.pushes == ()


@given(
  st.lists(st.sampled_from(_PI2.names), min_size=1, max_size=40),
  st.floats(1e-3, 10.0),
)
def test_round_trip(modes: list[str], dt: float) -> None:
  plan = plan_lib.ModePlan(tuple(modes), dt)
  push = pushes_lib.Push(0.0, (1.0, 0.5, 0.0))
  file = plan_lib.PlanFile(
    plan, plan_lib.Course('gap', {'width': 0.2}, 3, (push,)), {'return': 1.5}
  )
  values = json.loads(json.dumps(file.to_dict()))
  assert plan_lib.PlanFile.from_dict(values) == file


def test_a_result_is_kept(tmp_path: pathlib.Path) -> None:
  path = np.array([[0.0, 0.0, 0.5], [0.1, 0.2, 0.3]])
  result = plan_lib.PlanResult(
    *(_PLAN, plan_lib.Course('flat'), (2.0, 0.0, 0.5), False, 1.5, path),
    *(2.7, 0.01, 0.1, 24, 960, {'planner': 'beam'}),
  )
  line = 'PlanResult(flat, goal not reached; idle:0.3,launch:0.6,idle:0.3)'
  assert repr(result) == line
  out = tmp_path / 'new' / 'plan.json'
  result.save(out)
  values = json.loads(out.read_text())
  assert values['final_position'] == [0.1, 0.2, 0.3]
  assert (values['reached'], values['return']) == (False, 1.5)
  assert (values['seconds'], values['final_speed']) == (2.7, 0.01)
  assert (values['knots'], values['dt'], values['seed']) == (4, 0.3, 0)
  assert plan_lib.PlanFile.read(str(out)) == result.file()


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'plan': []}, '1 to 10000 knots'),
    ({'plan': 'idle'}, 'no list'),
    ({'plan': ['idle', 3, 'idle', '']}, 'names of modes, got 3'),
    ({'knots': 3}, '4 modes for 3 knots'),
    ({'dt': 0.0}, 'longer than 0'),
    ({'dt': math.nan}, 'not a finite number'),
    ({'dt': '0.3'}, 'not seconds'),
    ({'arena': 3}, 'for which arena'),
    ({'sizes': {'width': 'wide'}}, 'for which arena'),
    ({'seed': -1}, 'for which arena'),
    ({'pushes': [{**_PUSH, 'time': 0.7}]}, 'not at a knot'),
    ({'pushes': None}, 'no pushes: None'),
    *(({key: ...}, f"lacks '{key}'") for key in ('plan', 'knots', 'dt')),
  ],
)
def test_rejects(
  changes: dict[str, Any], message: str, tmp_path: pathlib.Path
) -> None:
  path = tmp_path / 'plan.json'
  values = {**_VALUES, **changes}
  kept = {key: value for key, value in values.items() if value is not ...}
  path.write_text(json.dumps(kept))
  with pytest.raises(ValueError, match=rf'plan\.json.*{message}'):
    plan_lib.PlanFile.read(path)


def test_no_plan(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'plan.json'
  with pytest.raises(FileNotFoundError, match=r'no plan .*plan\.json'):
    plan_lib.PlanFile.read(path)
  for text in ('', '[]', '{', '[' * 100_000, '\0'):
    path.write_text(text)
    with pytest.raises(ValueError, match=r'plan\.json'):
      plan_lib.PlanFile.read(path)
