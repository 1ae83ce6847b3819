"""Files of earlier versions are read and continued: see tests/specimens."""

import pathlib
import shutil

import numpy as np
import pytest
import torch

from dmc_multimode import pretrained
from dmc_multimode.experiments import fine_tuning
from dmc_multimode.experiments import run_folder
from dmc_multimode.experiments import training
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.planner import plan
from dmc_multimode.utils import schedule

_FOLDER = pathlib.Path(__file__).parent / 'specimens'
_RUN = _FOLDER / 'run'
_MODES = ('idle', 'walk_forward')


def test_schedules_of_a_run() -> None:
  config, mode_set = run_folder.RunFolder(_RUN).load()
  assert mode_set.names == _MODES
  events, ppo, sampling = config.task.events, config.ppo, config.sampling
  assert events.push_speed == schedule.step(0.5, 100)
  assert events.obstacles == schedule.step(0.4, 10)
  assert events.contact_bonus == schedule.Schedule(0.5, 0.1, 10, 20)
  assert events.distance_slack.at(0) == pytest.approx(0.15)
  assert events.distance_slack.at(3_000_000) == 0
  assert events.assistance_steps == 2_000_000
  assert ppo.deterministic_fraction == schedule.step(0.3, 16)
  assert ppo.std_floor == schedule.Schedule(
    0.17, 0.05, 6_000_000, 9_000_000, 'geometric'
  )
  assert sampling.gait_fraction == schedule.Schedule(0.7, 0.0, 64, 64)
  found = [sampling.focus_at(steps) for steps in (7, 8, 89, 90)]
  assert found == [0.0, 0.5, 0.5, 0.0]


def test_a_run_goes_on(tmp_path: pathlib.Path) -> None:
  shutil.copytree(_RUN, tmp_path / 'run')
  threads = torch.get_num_threads()
  try:
    policy = training.train(tmp_path / 'run', steps=64, resume=True)
  finally:
    torch.set_num_threads(threads)
  assert policy.provenance['steps'] == 64
  assert pretrained.load(tmp_path / 'run').provenance['steps'] == 64


def test_a_policy_acts() -> None:
  policy = pretrained.load(_RUN)
  assert policy.mode_set.names == _MODES
  assert policy.provenance['steps'] == 32
  size = policy.network.observation_size
  actions = policy.select_action(np.zeros((3, size), np.float32))
  assert actions.shape == (3, 10) and np.isfinite(actions).all()


def test_a_policy_and_its_encoder_are_begun_with() -> None:
  assert mode_encoder.load(_RUN / 'encoder').codebook().names == _MODES
  start = fine_tuning.load(str(_RUN))
  motions = start.modes(None, mode_files.load(_FOLDER / 'mode.yaml'))
  config = start.config(motions, 1000)
  start.check(config)
  assert config.ppo.hidden_sizes == (8,)
  assert config.sampling.focused == ('squat',)


def test_a_plan() -> None:
  found = plan.PlanFile.read(_FOLDER / 'plan.json').plan
  assert len(found.modes) == 11
  assert found.knot_duration == 0.3
