"""The shipped policies still do what their metrics say."""

import pathlib

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.agents.ppo import acting
from dmc_multimode.evaluation import episodes as evaluation_episodes
from dmc_multimode.modes import schedule
from dmc_multimode.pretrained import folder as folder_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes

_EPISODES = 4  # Of each mode.
_MARGIN = 0.05  # Of the mean return, for so few episodes.


def test_names() -> None:
  assert 'quickstart' in pretrained.names()
  assert 'library' not in pretrained.names()  # Latents alone.


@pytest.mark.parametrize('name', pretrained.names(installed=True))
def test_modes_are_as_good_as_reported(name: str) -> None:
  policy = pretrained.load(name)
  modes = np.repeat(np.arange(len(policy.mode_set)), _EPISODES)
  task = multimode_biped.make_task(
    policy.mode_set,
    episodes.ScheduledEpisodes(schedule.single(modes)),
    config=task_config.evaluated(policy.config),
  )
  worlds = batched_env.BatchedImitation(task, len(modes), 1, auto_reset=False)
  found = evaluation_episodes.run_episodes(worlds, policy.select_action)
  # Where some fall, so few episodes say less.
  slack = _MARGIN if policy.metrics['survival_modes'] > 0.99 else 2.5 * _MARGIN
  assert found.returns.mean() > policy.metrics['mra_modes']['mean'] - slack
  for i, motion in enumerate(policy.mode_set.motions):
    mine, reported = modes == i, policy.metrics['modes'][motion.name]
    # One fall in so few episodes costs more than the margin.
    if reported['survival'] < 1.0 or slack > _MARGIN:
      continue
    assert found.survived[mine].all(), motion.name
    assert found.returns[mine].mean() > reported['mra'] - _MARGIN, motion.name


def test_pi2_was_measured_to_pass_its_criteria() -> None:
  metrics = pretrained.load('pi2').metrics
  passed = {
    (mode, metric): row['passed']
    for mode, rows in metrics['acceptance'].items()
    for metric, row in rows.items()
  }
  assert len(passed) == 7
  assert set(passed.values()) == {True}
  assert metrics['mra_modes']['mean'] >= 0.91
  assert metrics['mra_transitions']['mean'] >= 0.80


@pytest.mark.parametrize('name', pretrained.names(installed=True))
def test_it_runs_in_composer_too(name: str) -> None:
  policy = pretrained.load(name)
  names = [motion.name for motion in policy.mode_set.motions]
  walks = 'walk_forward' in names  # Unimodal ones may not.
  mode = np.array([names.index('walk_forward') if walks else 0])
  config = task_config.evaluated(policy.config, time_limit=3.0)
  task = multimode_biped.make_task(
    policy.mode_set,
    episodes.ScheduledEpisodes(schedule.single(mode)),
    config=config,
  )
  environment = multimode_biped.make_environment(task, random=0)
  loop = acting.EnvironmentLoop(environment, policy.actor)
  assert loop.run_episode()['survived']
  if walks:
    walked = environment.physics.data.qpos[0]
    assert 0.5 * 2.5 <= walked <= 0.7 * 3.0


def test_a_damaged_policy_is_still_named(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  """And to load it says what is wrong; others know their robots."""
  texts = {
    'broken': '{',
    'other': '{"task": {"robot": {"declaration": '
    '{"name": "far", "model": "package:nowhere_at_all/far.xml"}}}}',
  }
  for name, text in texts.items():
    (tmp_path / name).mkdir()
    (tmp_path / name / folder_lib.DESCRIPTION_FILE).write_text(text)
  monkeypatch.setattr(folder_lib.resources, 'names', lambda kind: [*texts])
  monkeypatch.setattr(
    folder_lib.resources, 'path', lambda kind, name: tmp_path / name
  )
  assert folder_lib.names() == ('broken', 'other')
  assert folder_lib.names(installed=True) == ('broken',)
  assert folder_lib.names('far') == ('other',)
  assert folder_lib.names('far', installed=True) == ()
