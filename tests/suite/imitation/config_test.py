"""Tests of dmc_multimode.suite.imitation.config."""

import json
import math
from typing import Any

import pytest

from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import schedule

# A task as the first published version wrote it.
_OLD: dict[str, Any] = {
  'gains': {
    'position_weight': 0.35,
    'orientation_weight': 0.35,
    'contact_weight': 0.3,
    'position_sensitivity': 5.0,
    'orientation_sensitivity': 5.0,
    'contact_sensitivity': 2.0,
  },
  'limits': {'distance': 0.35, 'reward': 0.3, 'height': 0.22},
  'early_distance': 0.5,
  'tighten_steps': 3_000_000,
  'assist_steps': 2_000_000,
  'contact_bonus': 0.5,
  'late_contact_bonus': 0.1,
  'contact_bonus_start': 10,
  'contact_bonus_end': 30,
  'obstacles': 0.4,
  'push_speed': 0.5,
  'push_start': 8,
  'push_interval': 1.5,
  'reference_starts': 0.25,
  'time_limit': 3.0,
}


def test_steps() -> None:
  config = task_config.ImitationConfig()
  assert (config.substeps, config.horizon) == (6, 150)
  assert task_config.ImitationConfig(physics_timestep=0.001).substeps == 30
  for timestep in (0.004, 0.06):
    with pytest.raises(ValueError, match='divide'):
      task_config.ImitationConfig(physics_timestep=timestep)


def test_json_round_trip() -> None:
  config = task_config.ImitationConfig(
    gains=rewards.RewardGains().with_weights(contact=0.3),
    limits=terminations.NO_LIMITS,
    time_limit=3.0,
    events=events.TrainingEvents(
      obstacles=schedule.Schedule(0.0, 0.4, 7, 7), push_interval=2.0
    ),
  )
  text = json.dumps(task_config.to_dict(config))
  assert task_config.from_dict(json.loads(text)) == config


def test_reads_what_earlier_versions_wrote() -> None:
  assert task_config.from_dict(_OLD) == task_config.ImitationConfig(
    gains=rewards.RewardGains().with_weights(
      position=0.35, orientation=0.35, contact=0.3
    ),
    limits=terminations.TerminationLimits(angle=math.pi),
    events=events.TrainingEvents(
      reference_starts=0.25,
      distance_slack=schedule.Schedule(0.5 - 0.35, 0.0, 0, 3_000_000),
      assistance_steps=2_000_000,
      contact_bonus=schedule.Schedule(0.5, 0.1, 10, 30),
      obstacles=schedule.constant(0.4),
      push_speed=schedule.Schedule(0.0, 0.5, 8, 8),
    ),
    time_limit=3.0,
    extra_observations=(),
    feasible_references=False,
    commands_from_ground=False,
  )


@pytest.mark.parametrize('old', [False, True])
@pytest.mark.parametrize(
  'changes',
  [
    {'remove': 'gains'},
    {'unknown': 1.0},
    {'gains': {'position': {'weight': 1.0, 'sensitivity': -1.0}}},
    {'limits': {'height': 'low'}},
    {'time_limit': 'long'},
    {'time_limit': -1.0},
    {'push_start': 1.5},
    {'events': {'obstacles': 1.5}},
  ],
)
def test_from_dict_rejects(old: bool, changes: dict[str, Any]) -> None:
  now = task_config.to_dict(task_config.ImitationConfig())
  values = {**(_OLD if old else now), **changes}
  values.pop(values.pop('remove', ''), None)
  with pytest.raises(ValueError, match='Not a task configuration: ') as error:
    task_config.from_dict(values)
  assert '\n' not in str(error.value)
