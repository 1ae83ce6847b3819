"""Tests of dmc_multimode.evaluation.task_summary."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from dmc_multimode.evaluation import task_summary
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import motion_costs
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import schedule

_NAMES = ('idle', 'walk_backward', 'launch', 'turn_right')


def _describe(
  **changes: Any,
) -> dict[str, task_summary.Section]:
  modes = mode_set_lib.one_hot(library.resolve(_NAMES))
  trained = dataclasses.replace(
    task_config.ImitationConfig(physics_timestep=0.0075), **changes
  )
  evaluated = task_config.evaluated(trained)
  sections = task_summary.describe(modes, trained, evaluated)
  return {section.title: section for section in sections}


def test_modes() -> None:
  table = _describe()['Modes']
  rows = {
    row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows
  }
  assert tuple(rows) == _NAMES
  idle, walk, launch, turn = rows.values()
  assert (idle['reference'], idle['goes'], idle['flight (s)']) == (
    'one pose',
    '',
    '',
  )
  assert (walk['goes'], walk['speed (m/s)']) == ('0.24 m back', '0.40')
  assert launch['reference'] == 'runs once'
  assert launch['goes'] == '0.6 m ahead, 0.4 m up'
  assert launch['ledge'] == '+0.40 m after 0.27 m'
  assert launch['flight (s)'] == '0.44'  # Phases 0.42 to 0.82 of 1.1 s.
  assert turn['goes'].endswith(' degrees right') and not turn['speed (m/s)']


def test_reward() -> None:
  gains = task_config.ImitationConfig().gains.with_weights(contact=0.3)
  reward = _describe(gains=gains)['Reward']
  # exp(-5 x) is a half at ln 2 / 5; of sin^2(angle / 2), that is 43.7 degrees.
  assert reward.rows == (
    ('position', '0.5', '5', '0.14 m'),
    ('orientation', '0.5', '5', '44 degrees'),
    ('contact', '0.3', '2', '0.35'),
  )
  assert 'At most it is 1.3' in reward.sentences[0]
  assert _describe()['Reward'].rows[-1] == ('contact', '0', '2', '')


def test_limits() -> None:
  (text,) = _describe()['Early ends'].sentences
  assert text == (
    'An episode ends early when the trunk is more than 0.35 m from its '
    'reference, the trunk is turned by more than 57 degrees from it, the trunk '
    'is lower than 0.22 m over the ground, the reward of a step is below 0.3 '
    'or the state diverges.'
  )
  (text,) = _describe(limits=terminations.NO_LIMITS)['Early ends'].sentences
  assert text == 'An episode ends early when the state diverges.'


def test_observation() -> None:
  found = _describe(extra_observations=('clock_rate',))['Observation']
  sizes = {row[0]: int(row[1]) for row in found.rows}
  assert sizes['command'] == len(_NAMES) and sizes['clock rate'] == 1
  assert found.sentences[0].startswith(f'{sum(sizes.values())} numbers')
  assert {row[0]: row[2] for row in found.rows}['height'] == 'm'


def test_time() -> None:
  acts, lasts, *_ = _describe()['Time'].sentences
  assert acts == (
    'The policy acts every 30 ms. A physics step takes 5 ms, in the training '
    '7.5 ms.'
  )
  assert lasts == 'An episode lasts 4.5 s, 150 control steps.'
  (acts, lasts) = _describe(
    time_limit=np.inf,
    physics_timestep=0.005,
    commands_from_ground=False,
    feasible_references=False,
  )['Time'].sentences
  assert 'training' not in acts and lasts == 'An episode has no time limit.'


def test_no_events() -> None:
  nothing = ['Nothing: the robot is the nominal one.']
  assert list(task_summary.events(events.NONE)) == nothing
  assert list(_describe()['Events of the evaluation'].sentences) == nothing


def test_events() -> None:
  config = events.TrainingEvents(
    edge_noise=0.0,
    assistance_steps=2_000_000,
    push_speed=schedule.Schedule(0.0, 0.5, 3_000_000, 9_000_000),
    disturbances=disturbances.Disturbances(
      friction=(0.4, 1.2), payload=(2.0, 2.0)
    ),
    disturbance_fraction=0.5,
    costs=motion_costs.CostWeights(touch_down=0.15, straddle=0.1),
    cost_share=schedule.step(1.0, 4000),
  )
  assert list(task_summary.events(config)) == [
    'Share of the episodes that start mid-stride, on the reference at a random '
    'phase: 0.5.',
    'Help at take-offs fades over 2 million environment steps.',
    'Largest push, m/s: 0 until step 3 million, 0.5 from step 9 million on.',
    'Mean time between pushes: 1.5 s.',
    'Drawn for each episode: friction 0.4 to 1.2, payload 2 kg.',
    'Probability of each of these disturbances in an episode: 0.5.',
    'Costs, by weight: touch down 0.15, straddle 0.1.',
    'Factor of these costs: 0 until step 4,000, 1 from then on.',
  ]


@pytest.mark.parametrize(
  ('value', 'words'),
  [
    (0.25, '0.25'),
    (3_500_000, '3.5 million'),
    (schedule.constant(0.5), '0.5'),
    (
      schedule.Schedule(0.15, 0.0, 0, 3_000_000),
      '0.15 at first, 0 from step 3 million on',
    ),
  ],
)
def test_in_words(value: object, words: str) -> None:
  assert task_summary.in_words(value) == words


def test_an_event_without_words_has_its_name(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  monkeypatch.setattr(task_summary, '_EVENTS', {})
  config = dataclasses.replace(events.NONE, edge_noise=0.04)
  assert list(task_summary.events(config)) == ['Edge noise: 0.04.']
