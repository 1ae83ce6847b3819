"""Tests of dmc_multimode.experiments.setup: how the parts fit together."""

import dataclasses
import pathlib
from typing import Any

import numpy as np
import pytest
import torch

from dmc_multimode import pretrained
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import networks
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import run_folder
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.utils import schedule

_MODES = 'idle,walk_forward'
_POLICY_SEES = 2 + 2 + 31 + 13  # With one-hot commands.
_VALUE_SEES = _POLICY_SEES + 6 + 2 + 3
_TINY = ppo_config.PPOConfig(
  hidden_sizes=(8,), rollout_length=4, epochs=2, minibatches=2
)


def _build(**changes: Any) -> setup.Run:
  motions = library.resolve(_MODES)
  threads = torch.get_num_threads()
  try:
    return setup.build(
      run_config.RunConfig(
        modes=_MODES,
        num_worlds=4,
        threads=1,
        one_hot=True,
        ppo=dataclasses.replace(_TINY, **changes),
      ),
      mode_set.one_hot(motions),
    )
  finally:
    torch.set_num_threads(threads)


@pytest.mark.parametrize('privileged', [False, True])
def test_critic_is_privileged_or_not(
  privileged: bool, tmp_path: pathlib.Path
) -> None:
  run = _build(privileged_critic=privileged)
  seen = _VALUE_SEES if privileged else _POLICY_SEES
  assert run.environment.observation_spec().shape == (seen,)
  assert run.network.observation_size == _POLICY_SEES
  assert run.network.privileged_size == seen - _POLICY_SEES
  # Whoever loads the policy shows it what the policy sees, and no more.
  run.policy().save(tmp_path)
  observation = run.environment.reset()
  np.testing.assert_array_equal(
    pretrained.load(tmp_path).select_action(observation[:, :_POLICY_SEES]),
    run.policy().select_action(observation),
  )


@pytest.mark.parametrize('symmetry', ppo_config.SYMMETRIES)
@pytest.mark.parametrize('advantages', ppo_config.ADVANTAGES)
def test_every_kind_of_learner_learns(symmetry: str, advantages: str) -> None:
  run = _build(symmetry=symmetry, advantages=advantages)
  weight = networks.linears_of(run.network.policy)[0].weight
  before = weight.detach().clone()
  run.loop._collect()
  metrics = run.loop._learner.step(run.loop._buffers, 0)
  assert all(np.isfinite(value) for value in metrics.values())
  assert not torch.equal(weight, before)


@pytest.mark.parametrize('obstacles', [0.0, 1.0])
def test_strings_of_launches_have_ground(obstacles: float) -> None:
  config = run_config.RunConfig(
    modes='idle,launch', num_worlds=8, threads=1, one_hot=True, ppo=_TINY
  )
  sampling = dataclasses.replace(
    config.sampling, string_fraction=schedule.constant(1.0)
  )
  events = dataclasses.replace(
    config.task.events, obstacles=schedule.constant(obstacles)
  )
  task = dataclasses.replace(config.task, events=events)
  config = dataclasses.replace(config, sampling=sampling, task=task)
  worlds = setup.build(
    config, mode_set.one_hot(library.resolve(config.modes))
  ).environment
  worlds.reset()
  for _ in range(4):
    # Each time from another place, as robots that climb would.
    worlds.qpos[:, 0] += 1.0
    worlds.command(np.full(8, 1))
    worlds.core.tracker.state.phase[:] = 1.0
    worlds.command(np.full(8, 0))
  starts = worlds.core.terrain.starts
  assert np.isfinite(starts).all() and (np.diff(starts) > 0).all()


@pytest.mark.parametrize(
  ('text', 'message'),
  [
    ('{}', "lacks 'modes'"),
    ('[' * 100_000, 'recursion'),
    ('{"modes": 3}', 'int'),
    ('[1]', 'list'),
  ],
)
def test_damaged_configuration(
  text: str, message: str, tmp_path: pathlib.Path
) -> None:
  (tmp_path / run_folder.CONFIG_FILE).write_text(text)
  with pytest.raises(ValueError, match=f'config.json is damaged: .*{message}'):
    run_folder.RunFolder(tmp_path).load()


def test_configuration_is_of_a_sane_size(tmp_path: pathlib.Path) -> None:
  with open(tmp_path / run_folder.CONFIG_FILE, 'wb') as file:
    file.truncate(65 << 20)
  with pytest.raises(ValueError, match='too large'):
    run_folder.RunFolder(tmp_path).load()
  with pytest.raises(ValueError, match='num_worlds'):
    run_config.RunConfig(num_worlds=10**9)


def test_configuration_round_trip() -> None:
  config = run_config.RunConfig(
    ppo=ppo_config.PPOConfig(
      symmetry='alternate',
      advantages='mode',
      privileged_critic=False,
      activation='elu',
    )
  )
  values = run_config.to_dict(config)
  assert run_config.from_dict(values) == config
  values['ppo']['compile'] = True  # A field that was.
  assert run_config.from_dict(values) == config
