"""Tests of dmc_multimode.suite.imitation.events."""

from typing import Any

import numpy as np
import pytest

from dmc_multimode.suite.imitation import events
from dmc_multimode.utils import schedule

_ASSISTED = np.array([False, True, False, True])


@pytest.mark.parametrize(
  ('values', 'message'),
  [
    ({'obstacles': -0.1}, 'obstacles must not be negative'),
    ({'obstacles': '0:1.1@8'}, 'obstacles is a share'),
    ({'push_speed': -0.1}, 'push_speed must not be negative'),
    ({'precision_bonus': -0.1}, 'precision_bonus must not be negative'),
    ({'contact_bonus': '0.1:-0.1@5'}, 'contact_bonus'),
  ],
)
def test_rejects(values: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    events.TrainingEvents(**values)


def test_at_end() -> None:
  begun = events.TrainingEvents(
    reference_starts=0.25,
    distance_slack=schedule.Schedule(0.15, 0.0, 0, 10),
    assistance_steps=100,
    contact_bonus=schedule.Schedule(0.5, 0.1, 10, 20),
    obstacles=schedule.Schedule(0.0, 0.4, 8, 8),
  )
  assert begun.at_end() == events.TrainingEvents(
    reference_starts=0.25,
    contact_bonus=schedule.constant(0.1),
    obstacles=schedule.constant(0.4),
  )
  assert events.NONE.at_end() == events.NONE


def _feed(
  assistance: events.TakeoffAssistance, mode: int, survived: bool, count: int
) -> None:
  assistance.update(np.full(count, mode), np.full(count, survived))


def test_assistance_fades_while_enough_survive() -> None:
  assistance = events.TakeoffAssistance(1000, _ASSISTED)
  # Nobody has survived anything; then 1 - 0.995^40 = 0.18, 0.39, 0.29.
  for mode, survived, count, share in (
    (1, True, 0, 1.0),
    (1, True, 40, 1.0),
    (3, True, 60, 0.5),
    (1, False, 60, 0.5),
  ):
    _feed(assistance, mode, survived, count)
    assistance.fade(500)
    assert assistance.share == share
  _feed(assistance, 1, True, 200)
  restored = events.TakeoffAssistance(1000, _ASSISTED)
  restored.restore(assistance.state())
  for each in (assistance, restored):
    each.fade(100)
    assert each.share == pytest.approx(0.4)
    each.fade(10_000)
    assert each.share == 0.0
  # Modes without assistance do not count, and there may be none with it.
  assistance = events.TakeoffAssistance(1000, _ASSISTED)
  _feed(assistance, 0, True, 1000)
  assistance.fade(1000)
  assert assistance.share == 1.0
  for steps, assisted in ((0, _ASSISTED), (1000, np.zeros(4, bool))):
    assert events.TakeoffAssistance(steps, assisted).share == 0.0


@pytest.mark.parametrize(
  ('share', 'velocity', 'expected'),
  [
    (1.0, (0.0, 0.5, 0.0), (3.0, 0.0, 4.0)),  # Across: all is missing.
    (1.0, (0.6, 0.0, 0.8), (2.4, 0.0, 3.2)),
    (1.0, (4.0, 0.0, 4.0), (0.0, 0.0, 0.0)),  # Beyond it already.
    (0.5, (0.6, 0.0, 0.8), (1.5, 0.0, 2.0)),
    (0.5, (2.4, 0.0, 3.2), (0.6, 0.0, 0.8)),
    (0.5, (-3.0, 0.0, -4.0), (1.5, 0.0, 2.0)),
  ],
)
def test_boost(
  share: float, velocity: tuple[float, ...], expected: tuple[float, ...]
) -> None:
  assistance = events.TakeoffAssistance(1000, _ASSISTED)
  assistance.share = share
  found = assistance.boost(np.array([velocity]), np.array([[3.0, 0.0, 4.0]]))
  np.testing.assert_allclose(found, [expected], atol=1e-12)


@pytest.mark.parametrize(
  ('contact', 'clearance', 'wanted', 'expected'),
  [
    # The middle of a left stance: both down, as wanted, lower, too high, both
    # up, the wrong foot up, a foot on its toe.
    ((1.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.0),
    ((1.0, 0.0), (0.0, 0.07), (1.0, 0.0), 1.0),
    ((1.0, 0.0), (0.0, 0.03), (1.0, 0.0), 0.5),
    ((1.0, 0.0), (0.0, 0.11), (1.0, 0.0), 0.5),
    ((0.0, 0.0), (0.02, 0.06), (1.0, 0.0), 0.0),
    ((0.0, 1.0), (0.07, 0.0), (1.0, 0.0), 0.0),
    ((1.0, 1.0), (0.0, 0.07), (1.0, 0.0), 0.3),
    # Flight: by the height of both, within bounds.
    ((0.0, 0.0), (0.01, 0.03), (0.0, 0.0), 0.12),
    ((0.0, 0.0), (9.0, 9.0), (0.0, 0.0), 1.0),
    ((0.0, 0.0), (-0.3, 0.05), (0.0, 0.0), 0.0),
    ((1.0, 0.0), (0.05, 0.05), (0.0, 0.0), 1.0),
    # Both down.
    ((1.0, 1.0), (0.0, 0.0), (1.0, 1.0), 1.0),
    ((1.0, 0.0), (0.0, 0.2), (1.0, 1.0), 0.0),
  ],
)
def test_contact_schedule_agreement_by_hand(
  contact: tuple[float, float],
  clearance: tuple[float, float],
  wanted: tuple[float, float],
  expected: float,
) -> None:
  for prescribed, value in ((True, expected), (False, 1.0)):
    found = events.contact_schedule_agreement(
      np.array([contact]),
      np.array([clearance]),
      np.array([wanted]),
      np.array([prescribed]),
      np.where(sum(wanted) == 1, [[np.nan, 0.5]], np.nan),
    )
    np.testing.assert_allclose(found, [value])


def test_four_feet_agree_as_their_pairs_do_on_average() -> None:
  """Of a trot: a shuffle, one pair that steps, half of a step, and all."""
  found = events.contact_schedule_agreement(
    np.array([[1, 1, 1, 1], [1, 0, 1, 1], [1, 0, 0, 1], [1, 0, 0, 1]], float),
    np.array(
      [[0, 0, 0, 0], [0, 0.06, 0, 0], [0, 0.03, 0.03, 0], [0, 0.07, 0.07, 0]]
    ),
    np.tile([1.0, 0.0, 0.0, 1.0], (4, 1)),
    np.ones(4, bool),
    np.tile([np.nan, 0.5, 0.5, np.nan], (4, 1)),
  )
  np.testing.assert_allclose(found, [0.0, 0.5, 0.5, 1.0])
