"""Tests of dmc_multimode.evaluation.plan_figures."""

from typing import Any

import numpy as np

from dmc_multimode.evaluation import plan_figures
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes


def _legend(axis: Any) -> list[str]:
  return [text.get_text() for text in axis.get_legend().get_texts()]


def test_figure() -> None:
  path = np.stack([np.linspace(0, 1, 6), np.zeros(6), np.full(6, 0.5)], axis=1)
  push = pushes.Push(0.2, (1.0, 0.0, 0.0))
  found = plan_lib.PlanResult(
    plan_lib.ModePlan(('walk', 'walk', 'leap'), 0.1),
    plan_lib.Course('gap', pushes=(push,)),
    *((2.0, 0.0, 0.5), True, 1.0, path, 0.6, 0.02, 0.1, 1, 1),
  )
  modes, side, height = plan_figures.draw(found).axes
  np.testing.assert_allclose(
    np.array(modes.lines[0].get_data()),
    np.array([[0, 0.1, 0.2, 0.3], [0, 0, 1, 1]]),
  )
  np.testing.assert_array_equal(modes.lines[-1].get_xdata(), 0.2)  # The push.
  labels = [label.get_text() for label in modes.get_yticklabels()]
  assert labels == ['walk', 'leap']
  times, heights = np.array(height.lines[0].get_data())
  np.testing.assert_allclose(times, 0.1 * np.arange(1, 7))
  np.testing.assert_array_equal(heights, path[:, 2])
  np.testing.assert_array_equal(side.lines[0].get_data(), path[:, [0, 2]].T)
  assert len(side.collections) == 2  # Both sides of the gap.
  assert [text.get_text() for text in side.texts] == ['gap\n0.45 m']
  legend = _legend(side)
  assert legend == ['ground', 'path of the trunk', 'start', 'end'] + [
    'goal of the trunk'
  ]
  legend = _legend(modes)
  assert legend == ['commanded mode', 'push'] + ['ground under the trunk'] + [
    'trunk'
  ]
