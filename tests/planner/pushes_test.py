"""Tests of dmc_multimode.planner.pushes."""

import json
import math
from typing import Any

import numpy as np
import pytest

from dmc_multimode.planner import pushes

_SOME = (
  pushes.Push(0.6, (0.5, 0.0, 0.0)),
  pushes.Push(0.0, (-0.3, 0.2, 0.1)),
  pushes.Push(0.6, (0.0, -1.0, 0.0)),
)


def test_draw() -> None:
  # 3.3 s: at 0.9, 1.8 and 2.7, of knots of 0.3 s those closest to a second.
  drawn = pushes.draw(0.5, 11, 0.3, seed=1)
  assert [push.time for push in drawn] == pytest.approx([0.9, 1.8, 2.7])
  for push in drawn:
    assert math.hypot(*push.velocity) == pytest.approx(0.5)
    assert push.velocity[2] == 0
  assert len({push.velocity for push in drawn}) == 3
  assert drawn == pushes.draw(0.5, 11, 0.3, seed=1)
  assert drawn != pushes.draw(0.5, 11, 0.3, seed=2)
  assert pushes.draw(0.0, 11, 0.3, seed=1) == ()
  pushes.by_knot(drawn, 11, 0.3)


def test_parse() -> None:
  assert pushes.parse('0.6:-0.5') == pushes.Push(0.6, (-0.5, 0.0, 0.0))
  assert pushes.parse('1:0.5:2') == pushes.Push(1.0, (0.5, 2.0, 0.0))
  for text in ('', '1', '1:', 'x:1', '1:2:3:4', '1:nan', 'inf:1', '1:1e300'):
    with pytest.raises(ValueError, match=f"'{text}' is no push"):
      pushes.parse(text)
  values = json.loads(json.dumps(pushes.to_list(_SOME)))
  assert pushes.from_list(values) == _SOME
  assert pushes.from_list([]) == ()


@pytest.mark.parametrize(
  'value',
  [
    3,
    [{'time': 0.3}],
    [{'time': 0.3, 'velocity': [1.0, 0.0]}],
    [{'time': '0.3', 'velocity': [1.0, 0.0, 0.0]}],
    [{'time': 0.3, 'velocity': [1.0, 0.0, math.nan]}],
    [{'time': 0.3, 'velocity': [1.0, 0.0, 10**400]}],
    [{'time': 0.3, 'velocity': ['x', 'y', 'z']}],
  ],
)
def test_from_list_rejects(value: Any) -> None:
  with pytest.raises(ValueError, match=r'push'):
    pushes.from_list(value)


def test_by_knot() -> None:
  found = pushes.by_knot(_SOME, 5, 0.3)
  assert found.keys() == {0, 2}
  np.testing.assert_allclose(found[0], [-0.3, 0.2, 0.1])
  np.testing.assert_allclose(found[2], [0.5, -1.0, 0.0])
  for time, message in (
    (0.31, 'at 0.31 s is not at a knot: there is one every 0.3 s'),
    (-0.3, 'outside of the plan'),
    (1.5, 'whose last knot is at 1.2 s'),
  ):
    with pytest.raises(ValueError, match=message):
      pushes.by_knot([pushes.Push(time, (1.0, 0.0, 0.0))], 5, 0.3)
