"""Every configuration refuses what is no number, in one line with the field."""

import dataclasses
import math
from typing import Any

import numpy as np
import pydantic
import pytest

from dmc_multimode.agents import runner
from dmc_multimode.experiments import config as run_config
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import q_learning
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import schedule
from dmc_multimode.viewer import recording
from dmc_multimode.viewer import rollout

_RUN = run_config.RunConfig()
_CONFIGS = (
  *(_RUN, _RUN.ppo, _RUN.sampling, _RUN.task, _RUN.task.events),
  *(_RUN.task.limits, rewards.Gain(1.0, 1.0), schedule.Schedule(1.0, 2.0)),
  *(runner.TrainingConfig(), mode_encoder.EncoderConfig()),
  *(beam_search.BeamConfig(), q_learning.QLearningConfig()),
  *(reaching.ReachingConfig(), recording.RecordingConfig()),
  rollout.RolloutConfig(('idle',), (1.0,)),
)
# Infinite values of these stand for none.
_UNBOUNDED = {*vars(terminations.NO_LIMITS), 'minutes', 'time_limit'}
_KINDS = (int, float, schedule.Schedule)


def _refused(values: Any, name: str, value: Any) -> None:
  with pytest.raises(ValueError) as error:
    dataclasses.replace(values, **{name: value})
  message = str(error.value)
  assert name in message and '\n' not in message


@pytest.mark.parametrize('values', _CONFIGS, ids=lambda v: type(v).__name__)
def test_numbers(values: Any) -> None:
  pydantic.TypeAdapter(type(values))  # Builds its validator.
  for field in dataclasses.fields(values):
    now, name = getattr(values, field.name), field.name
    if type(now) is tuple and now and isinstance(now[-1], float):
      for number in (math.nan, math.inf):
        _refused(values, name, (*now[:-1], number))
    if type(now) not in _KINDS:
      continue
    _refused(values, name, math.nan)
    if name not in _UNBOUNDED:
      _refused(values, name, -math.inf)
      _refused(values, name, math.inf)
    if type(now) in (int, float):
      same = dataclasses.replace(values, **{name: np.array(now)[()]})
      assert same == values and type(getattr(same, name)) is type(now)


def test_sequences_are_tuples() -> None:
  goal = (1.0, 0.0, 0.5)
  for given in (np.array(goal), list(goal)):
    config = reaching.ReachingConfig(given)  # type: ignore[arg-type]
    assert config.goal == goal
  with pytest.raises(ValueError, match=r'^goal\.2: Field required$'):
    reaching.ReachingConfig((1.0, 0.0))  # type: ignore[arg-type]


@pytest.mark.parametrize('limit', ['time_limit', 'limits_distance'])
def test_trainings_are_bounded(limit: str) -> None:
  """No file could hold an infinite value."""
  name = limit.replace('_distance', '.distance')
  with pytest.raises(ValueError, match=f'task.{name}: must be finite'):
    run_config.overridden(_RUN, {f'task_{limit}': math.inf})


def test_round_trip() -> None:
  values = task_config.ImitationConfig(time_limit=math.inf)
  assert config_lib.build(type(values), config_lib.to_dict(values)) == values
