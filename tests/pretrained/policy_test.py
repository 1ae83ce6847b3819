"""Tests of dmc_multimode.pretrained.policy."""

import dataclasses
import json
import pathlib
from typing import Any, Callable

import numpy as np
import pytest
from safetensors import torch as safetensors_torch
import torch
from torch import nn

from dmc_multimode import pretrained
from dmc_multimode.agents import checkpointing
from dmc_multimode.agents.ppo import networks
from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import observations
from dmc_multimode.walkers import mini_biped

_MODES = ('idle', 'walk_forward')
_SIZE = observations.size(3)
_ABSENT = object()


def _policy(
  privileged_size: int = 0, activation: str = 'elu'
) -> pretrained.Policy:
  torch.manual_seed(0)
  network = networks.ActorCritic(
    _SIZE,
    len(mini_biped.JOINTS),
    (16, 8),
    privileged_size=privileged_size,
    activation=activation,
  )
  network.normaliser.update(torch.randn(50, _SIZE + privileged_size))
  latents = np.array([[0.1, -1.0, 2.0], [1 / 3, 0.5, 0.0]], np.float32)
  return pretrained.Policy(
    network,
    (16, 8),
    mode_set.ModeSet(
      library.resolve(_MODES), codebook.Codebook(_MODES, latents)
    ),
    task_config.ImitationConfig(time_limit=3.0),
    {'steps': 12, 'run': {'seed': 3}},
  )


@pytest.fixture
def folder(tmp_path: pathlib.Path) -> pathlib.Path:
  """A saved policy."""
  _policy().save(tmp_path / 'deep' / 'policy')
  return tmp_path / 'deep' / 'policy'


def _weights(folder: pathlib.Path) -> pathlib.Path:
  return folder / policy_lib.WEIGHTS_FILE


def _description(folder: pathlib.Path) -> pathlib.Path:
  return folder / policy_lib.DESCRIPTION_FILE


def _edit(folder: pathlib.Path, **changes: Any) -> None:
  """Changes fields of the description."""
  path = _description(folder)
  content = {**json.loads(path.read_text()), **changes}
  content = {k: v for k, v in content.items() if v is not _ABSENT}
  path.write_text(json.dumps(content))


def _refused(folder: pathlib.Path) -> str:
  """The one line that loading a policy is refused with."""
  with pytest.raises(ValueError) as caught:
    pretrained.load(folder)
  message = str(caught.value)
  assert message and '\n' not in message
  assert str(folder) in message
  return message


def test_round_trip(folder: pathlib.Path) -> None:
  policy = _policy()
  names = {path.name for path in folder.iterdir()}
  assert names == {policy_lib.WEIGHTS_FILE, policy_lib.DESCRIPTION_FILE}
  loaded = pretrained.load(str(folder.parent))  # The folder of a run, too.
  assert loaded.hidden_sizes == (16, 8)
  assert loaded.config == policy.config
  assert loaded.mode_set.names == _MODES
  np.testing.assert_array_equal(
    loaded.mode_set.latents, policy.mode_set.latents
  )
  for one, other in zip(
    loaded.mode_set.motions, policy.mode_set.motions, strict=True
  ):
    np.testing.assert_array_equal(one.positions, other.positions)
  assert loaded.provenance['run'] == {'seed': 3}
  assert {'steps', 'mujoco', 'torch'} <= loaded.provenance.keys()
  assert loaded.metrics == {}
  seen = np.random.RandomState(0).randn(5, _SIZE).astype(np.float32)
  expected = policy.select_action(seen)
  assert expected.shape == (5, len(mini_biped.JOINTS))
  np.testing.assert_array_equal(loaded.select_action(seen), expected)
  parts, start = {}, 0
  for name, size in observations.layout(3):
    parts[name] = seen[0, start : start + size].astype(np.float64)
    start += size
  action = loaded.actor.select_action(parts)
  assert action.dtype == np.float64
  np.testing.assert_allclose(action, expected[0], atol=1e-6)


def test_privileged_critic(folder: pathlib.Path) -> None:
  policy = _policy(privileged_size=9)
  policy.save(folder)  # Over what is there.
  assert len(list(folder.iterdir())) == 2
  loaded = pretrained.load(folder)
  assert loaded.network.privileged_size == 9
  expected = policy.network.state_dict()
  for key, value in loaded.network.state_dict().items():
    assert torch.equal(value, expected[key]), key
  # To act, nobody needs what only the value sees.
  seen = np.random.RandomState(0).randn(5, _SIZE + 9).astype(np.float32)
  action = loaded.select_action(seen[:, :_SIZE])
  np.testing.assert_array_equal(action, policy.select_action(seen))
  _edit(folder, privileged_size=2)
  assert 'another network' in _refused(folder)
  _edit(folder, privileged_size=_ABSENT)
  assert 'another network' in _refused(folder)


@pytest.mark.parametrize('activation', ['elu', 'silu'])
def test_activation(folder: pathlib.Path, activation: str) -> None:
  policy = _policy(activation=activation)
  policy.save(folder)
  loaded = pretrained.load(folder)
  assert loaded.network.activation == activation
  seen = np.random.RandomState(0).randn(5, _SIZE).astype(np.float32)
  expected = policy.select_action(seen)
  np.testing.assert_array_equal(loaded.select_action(seen), expected)
  # The weights alone do not tell which it was.
  _edit(folder, activation='tanh')
  found = pretrained.load(folder).select_action(seen)
  assert not np.allclose(found, expected)


class _Own(nn.Module):
  """Something of somebody's own."""

  def __init__(self, size: int, actions: int):
    super().__init__()
    self.gain = nn.Parameter(torch.linspace(0.0, 1.0, actions))
    self.size = size

  def forward(self, seen: torch.Tensor) -> torch.Tensor:
    return self.gain * seen[..., : len(self.gain)]


class _OwnCritic(networks.ActorCritic):
  def act(self, observation: torch.Tensor) -> torch.Tensor:
    return 2 * super().act(observation)


def _make(size: int, actions: int, privileged: int) -> networks.ActorCritic:
  assert (size, actions, privileged) == (_SIZE, len(mini_biped.JOINTS), 0)
  return networks.ActorCritic(
    size, actions, (16, 8), policy=_Own(size, actions)
  )


@pytest.mark.parametrize(
  ('own', 'make'),
  [
    ({'policy': '_Own'}, _make),
    (
      {'network': '_OwnCritic'},
      lambda size, actions, _: _OwnCritic(size, actions, (16, 8)),
    ),
  ],
)
def test_modules_of_ones_own(folder: pathlib.Path, own: Any, make: Any) -> None:
  """They act and are saved, and loaded by what makes them."""
  policy = _policy()
  if 'policy' in own:
    policy.network.policy = _Own(_SIZE, 10)  # As users do.
  else:
    network = _OwnCritic(_SIZE, 10, (16, 8))
    policy = dataclasses.replace(policy, network=network)
  policy = dataclasses.replace(policy)
  seen = np.random.RandomState(0).randn(5, _SIZE)
  expected = policy.select_action(seen)
  policy.save(folder)
  assert f'{own}' in _refused(folder)
  loaded = pretrained.load(folder, network=make)
  assert not loaded.network.training
  np.testing.assert_array_equal(loaded.select_action(seen), expected)
  with pytest.raises(ValueError, match='of another network'):
    pretrained.load(
      folder, network=lambda *n: networks.ActorCritic(n[0], n[1], (8,))
    )
  with pytest.raises(ValueError, match='return an ActorCritic'):
    pretrained.load(folder, network=lambda *n: nn.Identity())  # type: ignore
  with pytest.raises(ValueError, match='policy must be a torch module'):
    policy.network.policy = nn.Linear(_SIZE, 9)
    dataclasses.replace(policy)


def test_infinite_limits_are_in_no_file(folder: pathlib.Path) -> None:
  task = task_config.ImitationConfig(time_limit=np.inf)
  with pytest.raises(ValueError, match='task.time_limit: must be finite'):
    dataclasses.replace(_policy(), config=task).save(folder)


def test_description_of_an_earlier_version(folder: pathlib.Path) -> None:
  """Missing fields have their values of before there was a choice."""
  assert {'activation', 'privileged_size'} <= json.loads(
    _description(folder).read_text()
  ).keys()
  _edit(folder, privileged_size=_ABSENT, activation=_ABSENT)
  network = pretrained.load(folder).network
  assert (network.privileged_size, network.activation) == (0, 'elu')


def test_metrics(folder: pathlib.Path) -> None:
  (folder / policy_lib.METRICS_FILE).write_text('{"mra": 0.9}')
  assert pretrained.load(folder).metrics == {'mra': 0.9}
  (folder / policy_lib.METRICS_FILE).write_text('[0.9]')
  assert policy_lib.METRICS_FILE in _refused(folder)


@pytest.mark.parametrize('name', ['fly', '../policy', 'library', ''])
def test_unknown_name(name: str) -> None:
  with pytest.raises(FileNotFoundError) as caught:
    pretrained.load(name)
  assert '\n' not in str(caught.value)
  # Of policies alone: the library's encoder is none.
  _, listed = str(caught.value).split('there are: ')
  assert tuple(listed.split(', ')) == pretrained.names()


def test_observations_of_another_task() -> None:
  """Those of the mode set `pi2` are not those of the policy of that name."""
  policy = _policy(privileged_size=3)
  for length in (_SIZE - 1, _SIZE + 1):
    with pytest.raises(ValueError, match=r'make_worlds\(policy, ') as caught:
      policy.select_action(np.zeros((2, length)))
    assert '\n' not in str(caught.value)


def test_it_is_one_line_in_a_terminal() -> None:
  expected = f'Policy({", ".join(_MODES)}; robot mini_biped, 12 steps)'
  assert repr(_policy()) == expected
  bare = dataclasses.replace(_policy(), provenance={})
  assert repr(bare) == f'Policy({", ".join(_MODES)}; robot mini_biped)'


def test_missing_folder_or_files(
  folder: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  with pytest.raises(FileNotFoundError, match='absent'):
    pretrained.load(tmp_path / 'absent')
  _weights(folder).unlink()
  with pytest.raises(FileNotFoundError, match=policy_lib.WEIGHTS_FILE):
    pretrained.load(folder)
  _description(folder).unlink()
  with pytest.raises(FileNotFoundError, match=policy_lib.DESCRIPTION_FILE):
    pretrained.load(folder)


# Weights.


@pytest.mark.parametrize('kept', [0, -1])
def test_truncated_weights(folder: pathlib.Path, kept: int) -> None:
  path = _weights(folder)
  path.write_bytes(path.read_bytes()[:kept])
  assert 'truncated' in _refused(folder)


def test_foreign_weights(folder: pathlib.Path) -> None:
  weights = safetensors_torch.load(_weights(folder).read_bytes())
  for metadata in (None, {'format': 'pt'}, {'json': '{}'}, {'json': '3'}):
    _weights(folder).write_bytes(safetensors_torch.save(weights, metadata))
    assert policy_lib.WEIGHTS_FILE in _refused(folder)


def test_checkpoint_in_place_of_the_weights(folder: pathlib.Path) -> None:
  checkpointing.Checkpointer(folder).save({'x': torch.zeros(3)}, {})
  (folder / checkpointing.NAME).rename(_weights(folder))
  assert 'does not hold the weights of a policy' in _refused(folder)


@pytest.mark.parametrize('key', ['policy.0.bias', 'normaliser.mean'])
def test_weights_that_are_not_finite(folder: pathlib.Path, key: str) -> None:
  weights, metadata = checkpointing.load_tensors(_weights(folder))
  weights[key][1] = np.nan
  checkpointing.save_tensors(_weights(folder), weights, metadata)
  assert 'not finite' in _refused(folder)


@pytest.mark.parametrize('change', ['missing', 'further', 'shape'])
def test_weights_of_another_network(folder: pathlib.Path, change: str) -> None:
  weights, metadata = checkpointing.load_tensors(_weights(folder))
  key = 'policy.0.bias'
  if change == 'missing':
    del weights[key]
  elif change == 'further':
    weights[key := 'policy.9.bias'] = torch.zeros(1)
  else:
    weights[key] = torch.zeros(17)
  checkpointing.save_tensors(_weights(folder), weights, metadata)
  assert key in _refused(folder)


# The description.


def test_wrong_latent_size(folder: pathlib.Path) -> None:
  _edit(folder, latents=[[0.1, -1.0], [0.3, 0.5]])
  message = _refused(folder)
  assert 'policy.0.weight' in message or 'normaliser' in message
  assert 'other latents' in message


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'latents': [[0.1, -1.0, 2.0]]}, '2 modes'),
    ({'latents': [[0.1, -1.0, 2.0], [0.3, 0.5, float('nan')]]}, 'finite'),
    ({'latents': 'abc'}, 'damaged'),
    ({'modes': _ABSENT}, "'modes'"),
    ({'modes': []}, 'at least one mode'),
    ({'modes': ['idle', 'walk_forward']}, 'damaged'),
    ({'task': {}}, 'task configuration'),
    ({'hidden_sizes': []}, 'out of bounds'),
    ({'hidden_sizes': [16, 0]}, 'out of bounds'),
    ({'hidden_sizes': [10**300, 8]}, 'out of bounds'),
    ({'hidden_sizes': [4] * 9}, 'out of bounds'),
    ({'hidden_sizes': [4096, 4096]}, 'another network'),
    ({'hidden_sizes': [float('inf')]}, 'damaged'),
    ({'activation': 'relu'}, 'unknown'),
    ({'activation': ['elu']}, 'damaged'),
    ({'privileged_size': -1}, 'out of bounds'),
    ({'privileged_size': 4097}, 'out of bounds'),
    ({'privileged_size': float('inf')}, 'damaged'),
    ({'provenance': [1]}, 'damaged'),
    ({'format': _ABSENT}, 'not a policy of this version'),
    ({'format': 'dmc_multimode.policy.99'}, 'not a policy of this version'),
  ],
)
def test_damaged_field(
  folder: pathlib.Path, changes: dict[str, Any], message: str
) -> None:
  _edit(folder, **changes)
  assert message in _refused(folder)


@pytest.mark.parametrize('text', ['', '{"format"', '[]', '[' * 100_000])
def test_damaged_json(folder: pathlib.Path, text: str) -> None:
  _description(folder).write_text(text)
  assert policy_lib.DESCRIPTION_FILE in _refused(folder)


@pytest.mark.parametrize('find', [_weights, _description])
def test_oversized_file(
  folder: pathlib.Path, find: Callable[[pathlib.Path], pathlib.Path]
) -> None:
  with open(find(folder), 'r+b') as file:
    file.truncate(65 << 20)  # Sparse: it takes no room.
  assert 'too large' in _refused(folder)
