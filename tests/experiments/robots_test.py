"""Tests of trainings, policies and evaluations of declared robots."""

import json
import math
import pathlib
from typing import Any

import numpy as np
import pytest

import dmc_multimode as dmm
from dmc_multimode.experiments import config as run_config
from dmc_multimode.modes import files as mode_files
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import observations
from dmc_multimode.walkers import robot as robot_lib

_FOLDER = pathlib.Path(__file__).parents[1] / 'robots'
_FILE = _FOLDER / 'four_legs.yaml'
_MODES = mode_files.load(_FOLDER / 'four_legs_modes.yaml')
_WORLDS, _ROLLOUT = 16, 8
_ITERATION = _WORLDS * _ROLLOUT
_SETTINGS: dict[str, Any] = {
  'num_worlds': _WORLDS,
  'ppo_rollout_length': _ROLLOUT,
  'ppo_hidden_sizes': (16,),
  'threads': 1,
}


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """A short training, with an encoder and mirror images."""
  folder = tmp_path_factory.mktemp('robots') / 'run'
  dmm.train(
    folder, modes=_MODES, steps=3 * _ITERATION, robot=_FILE, **_SETTINGS
  )
  return folder


def test_policy_has_its_robot(
  run: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  robot = robot_lib.load(_FILE)
  policy = dmm.load_policy(run, robot=_FILE)
  assert policy.config.robot == robot
  assert policy.config.control_timestep == 0.02
  size = observations.size(
    4, extra=policy.config.extra_observations, robot=robot
  )
  actions = policy.select_action(np.zeros((3, size), dtype=np.float32))
  assert actions.shape == (3, 12)
  # It begins about the standing action, which it is held by.
  off = np.abs(actions - robot.derived.standing_action).max()
  assert off < 1.0
  policy.save(tmp_path / 'again')
  assert dmm.load_policy(tmp_path / 'again').config == policy.config
  description = json.loads((run / 'policy' / 'policy.json').read_text())
  assert description['task']['robot']['digest'] == robot.digest
  assert 'robot' not in description['provenance']['run']['task']


def test_another_robot_is_refused(run: pathlib.Path) -> None:
  mini = robot_lib.mini_biped()
  with pytest.raises(ValueError, match='was trained for the robot four_legs'):
    dmm.load_policy(run, robot=mini)
  with pytest.raises(
    ValueError, match='quickstart was trained for the robot m'
  ):
    dmm.load_policy('quickstart', robot=_FILE)
  assert dmm.load_policy('quickstart', robot=mini).config.robot == mini
  with pytest.raises(ValueError, match='The policy is of the robot four_legs'):
    dmm.make_worlds(dmm.load_policy(run), 2, robot=mini)
  with pytest.raises(ValueError, match='has task_robot=four_legs'):
    dmm.train(run, resume=True, robot=mini)
  with pytest.raises(ValueError, match='quickstart was trained for'):
    dmm.train(run.parent / 'other', init_from='quickstart', robot=_FILE)


def test_a_tampered_policy_is_refused(
  run: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  policy = dmm.load_policy(run)
  policy.save(tmp_path)
  path = tmp_path / policy_lib.DESCRIPTION_FILE
  description = json.loads(path.read_text())
  description['task']['robot']['declaration']['armature'] = 0.5
  path.write_text(json.dumps(description))
  with pytest.raises(ValueError, match='not that of its hash'):
    dmm.load_policy(tmp_path)


def test_evaluation(run: pathlib.Path) -> None:
  report = dmm.evaluate(run, episodes=1, quiet=True)
  assert set(report['modes']) == {'stand', 'trot'}
  assert report['task']['robot']['name'] == 'four_legs'
  moves = report['motion']['trot']
  assert moves['torque_peak'] <= 12 and moves['hip_yaw_at_limit'] is None


def test_worlds_of_a_policy(run: pathlib.Path) -> None:
  worlds = dmm.make_worlds(dmm.load_policy(run), 4, robot=_FILE)
  step = worlds.step(dmm.load_policy(run).select_action(worlds.reset()))
  assert np.isfinite(step.reward).all()


def test_tracks_are_the_mini_bipeds(run: pathlib.Path) -> None:
  with pytest.raises(ValueError, match='crossed by the mini biped alone'):
    dmm.plan(run, arena='gap')


def test_resumed(run: pathlib.Path) -> None:
  policy = dmm.train(run, resume=True, steps=4 * _ITERATION, robot=_FILE)
  assert policy.provenance['steps'] == 4 * _ITERATION


def test_modes_of_two_feet_are_refused(tmp_path: pathlib.Path) -> None:
  with pytest.raises(ValueError, match='idle has contacts of 2 feet'):
    dmm.train(tmp_path / 'run', modes='pi2', robot=_FILE, **_SETTINGS)
  assert not (tmp_path / 'run').exists()


def test_horizons_are_as_long_in_natural_times() -> None:
  """1 s at 0.5 m, and in proportion to the square root of the height."""
  default = run_config.RunConfig()
  assert run_config.for_robot(default, robot_lib.mini_biped()) == default
  robot = robot_lib.load(_FILE)
  config = run_config.for_robot(default, robot)
  seconds = config.task.control_timestep / (1 - config.ppo.discount)
  assert seconds == pytest.approx(math.sqrt(robot.size), rel=0.01)
