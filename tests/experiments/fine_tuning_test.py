"""Tests of dmc_multimode.experiments.fine_tuning."""

import dataclasses
import pathlib
import shutil
from typing import Any

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import fine_tuning
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import resources
from dmc_multimode.utils import schedule
from tests.bin import untrained

_SQUAT = pathlib.Path(__file__).parents[2] / 'docs' / 'squat.yaml'


@pytest.fixture(scope='module')
def squat() -> fine_tuning.Motions:
  return mode_files.load(_SQUAT)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """A policy of two modes with its encoder beside it."""
  path = tmp_path_factory.mktemp('policy')
  untrained.save_with_encoder(path, ['idle', 'walk_forward'], {'steps': 7})
  return path


@pytest.fixture(scope='module')
def start(folder: pathlib.Path) -> fine_tuning.Start:
  return fine_tuning.load(str(folder))


# A policy of one-hot commands has no room for more: see below.
@pytest.mark.parametrize(
  'name',
  [name for name in pretrained.names('mini_biped') if name != 'pi2_one_hot'],
)
def test_defaults_fit_every_shipped_policy(
  name: str, squat: fine_tuning.Motions
) -> None:
  start = fine_tuning.load(name)
  motions = start.modes(None, squat)
  config = start.config(motions, 1000)
  start.check(config)
  assert config.init_from == name
  assert config.modes.split(',') == [*start.policy.mode_set.names, 'squat']
  assert config.init_modes.split(',') == list(start.policy.mode_set.names)
  assert config.sampling.focused == ('squat',)
  assert config.sampling.gait_fraction == schedule.constant(0.0)
  events = config.task.events
  assert events == events.at_end()
  none = schedule.constant(0.0)
  assert events.push_speed == events.disturbance_share == none
  assert events.sensor_noise == none
  least = [config.ppo.std_bounds(steps)[0] for steps in (0, 1000)]
  assert least[1] < 0.5 * least[0]
  # And what a run keeps of it can be read back.
  assert run_config.from_dict(run_config.to_dict(config)) == config


def test_its_own_training_is_gone_on_with() -> None:
  start = fine_tuning.load('pi2')
  run = start.policy.provenance['run']
  config = start.config(start.policy.mode_set.motions, 1000)
  assert config.ppo.symmetry == run['ppo']['symmetry'] == 'alternate'
  assert config.ppo.discount == run['ppo']['discount']
  assert config.task.gains == task_config.from_dict(run['task']).gains
  assert config.sampling.clock_rate_fraction == schedule.constant(0.4)
  assert config.sampling.string_fraction == schedule.constant(0.4)
  # The value function goes on to observe them.
  assert config.task.events.disturbances.active
  assert config.sampling.focused == ()


def test_modes_of_the_policy_are_its_own(
  start: fine_tuning.Start, squat: fine_tuning.Motions
) -> None:
  """Those of the library by the same name may have changed since."""
  slow = dataclasses.replace(library.modes()['idle'], duration=0.9)
  mine = start.policy.mode_set
  changed = dataclasses.replace(mine, motions=(slow, mine.motions[1]))
  policy = dataclasses.replace(start.policy, mode_set=changed)
  other = dataclasses.replace(start, policy=policy)
  found = other.modes('leap_forward,squat,idle', squat)
  assert [m.name for m in found] == ['leap_forward', 'squat', 'idle']
  assert found[2].duration == 0.9
  assert [m.name for m in other.new(found)] == ['leap_forward', 'squat']
  names = [m.name for m in other.modes(None, squat)]
  assert names == ['idle', 'walk_forward', 'squat']
  assert other.modes('pi2')[0].duration == 0.9
  with pytest.raises(ValueError, match="Unknown mode 'fly'"):
    other.modes('idle,fly', squat)
  # The file may repeat what the policy knows, and not contradict it.
  assert len(other.modes(None, (slow,))) == 2
  with pytest.raises(ValueError, match="another motion by the name of 'idle'"):
    other.modes(None, library.resolve('idle'))


def test_latents(start: fine_tuning.Start, squat: fine_tuning.Motions) -> None:
  motions = start.modes('squat,walk_forward,idle', squat)
  encoder, codebook = start.encode(motions)
  assert codebook.names == ('squat', 'walk_forward', 'idle')
  np.testing.assert_array_equal(
    codebook.latents[[2, 1]], start.policy.mode_set.latents
  )
  np.testing.assert_array_equal(codebook.latents[:1], encoder.encode(squat))


@pytest.mark.parametrize(
  ('part', 'changes', 'message'),
  [
    ('ppo', {'hidden_sizes': (8,)}, r'--ppo_hidden_sizes: .* has \(16,\)'),
    ('ppo', {'activation': 'elu'}, '--ppo_activation: .* has silu'),
    ('ppo', {'privileged_critic': False}, '--ppo_privileged_critic: .* True'),
    (None, {'one_hot': True}, '--one_hot'),
  ],
)
def test_contradictions(
  start: fine_tuning.Start,
  part: str | None,
  changes: dict[str, Any],
  message: str,
) -> None:
  config = start.config(start.policy.mode_set.motions, 1000)
  start.check(config)
  if part:
    changes = {part: dataclasses.replace(getattr(config, part), **changes)}
  with pytest.raises(ValueError, match=message):
    start.check(dataclasses.replace(config, **changes))


def test_value_function_of_another_version(start: fine_tuning.Start) -> None:
  network = type(start.policy.network)(37, 10, (16,), privileged_size=9)
  policy = dataclasses.replace(start.policy, network=network)
  other = dataclasses.replace(start, policy=policy)
  with pytest.raises(ValueError, match='sees 9 privileged numbers.*13'):
    other.check(other.config(start.policy.mode_set.motions, 1000))


@pytest.mark.parametrize(
  'where',
  ['', 'policy', 'policies/96'],
  ids=['run', 'its policy', 'a kept one'],
)
def test_encoder_of_a_run(
  folder: pathlib.Path, tmp_path: pathlib.Path, where: str
) -> None:
  (tmp_path / 'encoder').mkdir()
  for name in ('policy', 'policies/96'):
    (tmp_path / name).mkdir(parents=True)
    for path in folder.glob('policy.*'):
      shutil.copy(path, tmp_path / name)
  for path in folder.glob('encoder.*'):
    shutil.copy(path, tmp_path / 'encoder')
  found = fine_tuning.load(str(tmp_path / where))
  assert found.policy.mode_set.names == ('idle', 'walk_forward')
  assert [m.name for m in found.encoder.motions] == ['idle', 'walk_forward']


def test_what_cannot_be_begun_with(
  folder: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  with pytest.raises(FileNotFoundError, match='pi7'):
    fine_tuning.load('pi7')
  with pytest.raises(ValueError, match='absent'):
    fine_tuning.load(str(folder), str(tmp_path / 'absent'))
  for path in folder.glob('policy.*'):
    shutil.copy(path, tmp_path)
  with pytest.raises(ValueError, match='no mode encoder beside it.*--encoder'):
    fine_tuning.load(str(tmp_path))
  assert fine_tuning.load(str(tmp_path), str(folder)).encoder.motions
  task = task_config.ImitationConfig()
  untrained.save(tmp_path / 'one_hot', ['idle', 'launch'], task, {})
  with pytest.raises(ValueError, match='one-hot commands.*has latents'):
    fine_tuning.load(str(tmp_path / 'one_hot'), str(folder))


def test_encoder_of_another_policy(folder: pathlib.Path) -> None:
  other = fine_tuning.load(
    str(folder), str(resources.path('pretrained', 'pi2'))
  )
  with pytest.raises(ValueError, match='not the one that the latents'):
    other.encode(other.policy.mode_set.motions)
