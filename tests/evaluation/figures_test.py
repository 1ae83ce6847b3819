"""Tests of dmc_multimode.evaluation.figures."""

import pathlib
from typing import Any

import numpy as np
import pytest

from dmc_multimode.evaluation import figures
from dmc_multimode.modes import library

_TIMESTEP = 0.03  # Seconds.


def _measured(steps: int, worlds: int) -> dict[str, np.ndarray]:
  rng = np.random.RandomState(0)
  return {
    'position': rng.rand(steps, worlds, 3),
    'reference': rng.rand(steps, worlds, 3),
    'support': rng.rand(steps, worlds),
  }


def test_contacts_are_drawn_where_feet_stand() -> None:
  contact = np.zeros((10, 1, 2))
  contact[2:5, 0, 0] = contact[8:, 0, 0] = 1
  measured = {'contact': contact, 'reference_contact': np.ones((10, 1, 2))}
  drawn = figures.contacts(('walk',), measured, np.array([9]), _TIMESTEP)
  bars: Any = drawn.axes[0].collections
  spans = [
    [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in paths]
    for paths in (bar.get_paths() for bar in bars)
  ]
  whole = [pytest.approx((0.0, 0.27))]
  # Left and right, the robot's above the reference's.
  assert spans == [
    [pytest.approx((0.06, 0.15)), pytest.approx((0.24, 0.27))],
    whole,
    [],
    whole,
  ]


def test_four_feet_have_names() -> None:
  contact = np.ones((10, 1, 4))
  measured = {'contact': contact, 'reference_contact': contact}
  drawn = figures.contacts(('trot',), measured, np.array([9]), _TIMESTEP)
  labels = [text.get_text() for text in drawn.axes[0].get_yticklabels()]
  assert len(labels) == 8
  assert labels[4:6] == ['hind left, robot', 'hind left, reference']


def test_heights_and_clock_rates() -> None:
  measured = _measured(20, 2)
  drawn = figures.heights(
    ('idle', 'walk'), measured, np.array([20, 12]), _TIMESTEP
  )
  axis = drawn.axes[1]
  assert axis.get_title() == 'walk'
  lines: Any = {line.get_label(): line.get_data() for line in axis.lines}
  times, heights = lines['robot']
  np.testing.assert_allclose(times[[0, -1]], [0.03, 0.36])
  np.testing.assert_array_equal(heights, measured['position'][:12, 1, 2])

  values = {
    str(rate): {'leap': {'reference': 2.0 * rate, 'velocity': 1.0 * rate}}
    for rate in (1, 2)
  }
  (axis,) = figures.clock_rates(values).axes
  lines = {line.get_label(): line.get_data() for line in axis.lines}
  np.testing.assert_array_equal(lines['robot'], [[1, 2], [1, 2]])
  np.testing.assert_allclose(lines['reference'][1], [2, 4])


@pytest.mark.parametrize(
  ('modes', 'names', 'seconds'),
  [
    ('pi2', ('walk_forward', 'launch', 'leap_forward', 'idle'), 8.3),
    ('leap_left,walk_left', ('leap_left', 'walk_left'), 4.8),
    ('launch', ('launch',), 1.1),
  ],
)
def test_sequence(modes: str, names: tuple[str, ...], seconds: float) -> None:
  mode_set = library.mode_set(modes)
  schedule, found = figures.sequence(mode_set)
  assert tuple(mode_set.names[i] for i in schedule.modes[0]) == names
  assert found == pytest.approx(seconds)
  assert schedule.starts[0, -1] < found


def test_transitions() -> None:
  mode_set = library.mode_set('pi2')
  schedule, _ = figures.sequence(mode_set)
  measured = _measured(100, 1)
  drawn = figures.transitions(mode_set, schedule, measured, 90, _TIMESTEP)
  axis = drawn.axes[0]
  lines = {line.get_label(): line.get_data() for line in axis.lines}
  np.testing.assert_array_equal(
    lines['robot'][1], measured['position'][:90, 0, 2]
  )
  np.testing.assert_array_equal(
    lines['reference'][1], measured['reference'][:90, 0, 2]
  )
  texts: list[Any] = list(axis.texts)
  labels = {text.get_text(): text.xy[0] for text in texts}
  assert labels == pytest.approx(
    {'walk_forward': 0.0, 'launch': 2.4, 'leap_forward': 3.5, 'idle': 5.9}
  )


def test_save_makes_the_folder(tmp_path: pathlib.Path) -> None:
  drawn, axes = figures.empty(2, 3, 1.0, 2.0)
  assert axes.shape == (2, 3)
  path = tmp_path / 'below' / 'figure.png'
  figures.save(path, drawn)
  assert path.read_bytes().startswith(b'\x89PNG')
  assert list(path.parent.iterdir()) == [path]
