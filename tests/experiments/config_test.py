"""Tests of dmc_multimode.experiments.config."""

import pytest

from dmc_multimode.experiments import config as run_config


@pytest.mark.parametrize(
  ('name', 'nearest'),
  [
    ('ppo_lr', 'ppo_learning_rate'),
    ('num_wolds', 'num_worlds'),
    ('discount', 'ppo_discount'),
    ('task_time_limits', 'task_time_limit'),
  ],
)
def test_an_unknown_setting_is_met_with_the_nearest(
  name: str, nearest: str
) -> None:
  with pytest.raises(ValueError) as caught:
    run_config.overridden(run_config.RunConfig(), {name: 1})
  unknown, hint = str(caught.value).split('; do you mean ')
  assert unknown == f'{name} is no setting of a run'
  assert nearest in hint.rstrip('?').split(' or ')


def test_a_setting_near_to_none() -> None:
  with pytest.raises(ValueError, match='^xyzzy is no setting of a run$'):
    run_config.overridden(run_config.RunConfig(), {'xyzzy': 1})
