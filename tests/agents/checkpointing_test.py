"""Tests of dmc_multimode.agents.checkpointing."""

import os
import pathlib
from typing import Callable
from unittest import mock

import numpy as np
import pytest
from safetensors import torch as safetensors_torch
import torch

from dmc_multimode.agents import checkpointing

Checkpointer = checkpointing.Checkpointer


def _save(folder: pathlib.Path, value: float) -> None:
  Checkpointer(folder).save({'x': np.full(100, value)}, {'steps': int(value)})


def _value(folder: pathlib.Path) -> tuple[float, str]:
  tensors, metadata, note = Checkpointer(folder).load()
  assert metadata['steps'] == tensors['x'][0] == tensors['x'][-1]
  return float(tensors['x'][0]), note


def test_round_trip(tmp_path: pathlib.Path) -> None:
  tensors: dict[str, torch.Tensor | np.ndarray] = {
    'a': torch.arange(6.0).reshape(2, 3).T,  # Not contiguous.
    'b': np.array([np.pi, np.nan, np.inf]),
    'c': torch.zeros((), dtype=torch.float64),
    'd': torch.Generator().manual_seed(3).get_state(),
    'e': np.array([True, False]),
  }
  path = tmp_path / 'file'
  checkpointing.save_tensors(path, tensors, {'n': [1, 'x'], 'z': None})
  loaded, metadata = checkpointing.load_tensors(path)
  assert metadata == {'n': [1, 'x'], 'z': None}
  assert loaded.keys() == tensors.keys()
  for key, value in tensors.items():
    expected = torch.as_tensor(value)
    assert loaded[key].dtype == expected.dtype
    torch.testing.assert_close(
      loaded[key], expected, rtol=0, atol=0, equal_nan=True
    )


def test_keeps_the_newest_two(tmp_path: pathlib.Path) -> None:
  checkpointer = Checkpointer(tmp_path)
  assert not checkpointer.exists()
  for value in (1, 2, 3):
    _save(tmp_path, value)
    assert checkpointer.exists()
    assert _value(tmp_path) == (value, '')
  names = {path.name for path in tmp_path.iterdir()}
  assert names == {checkpointing.NAME, checkpointing.PREVIOUS}


@pytest.mark.parametrize('place', ['fsync', 'replace'])
def test_crash_while_writing(tmp_path: pathlib.Path, place: str) -> None:
  _save(tmp_path, 1)
  before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
  with (
    mock.patch.object(os, place, side_effect=OSError('full')),
    pytest.raises(OSError, match='full'),
  ):
    _save(tmp_path, 2)
  after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
  assert after == before
  _save(tmp_path, 3)
  assert _value(tmp_path) == (3, '')


def test_crash_at_every_rename(tmp_path: pathlib.Path) -> None:
  """Wherever a process dies, the newest or the one before it is there."""
  rename, notes = os.replace, []
  for allowed in range(3):
    folder = tmp_path / str(allowed)
    folder.mkdir()
    _save(folder, 1)
    calls = [rename] * allowed + [mock.Mock(side_effect=KeyboardInterrupt)]
    step = lambda *args, calls=calls: calls.pop(0)(*args)
    with (
      mock.patch.object(os, 'replace', step),
      pytest.raises(KeyboardInterrupt),
    ):
      _save(folder, 2)
    value, note = _value(folder)
    assert value == 1
    notes.append(note)
    _save(folder, 3)
    assert _value(folder) == (3, '')
  assert notes[0] == notes[1] == ''
  assert f'Resuming from {checkpointing.PREVIOUS}.' in notes[2]


def test_a_damaged_newest_never_replaces_the_good_one(
  tmp_path: pathlib.Path,
) -> None:
  _save(tmp_path, 1)
  _save(tmp_path, 2)
  (tmp_path / checkpointing.NAME).write_bytes(b'damaged')
  checkpointer = checkpointing.Checkpointer(tmp_path)
  checkpointer.load()
  replaced = mock.Mock(side_effect=os.replace)
  with mock.patch.object(os, 'replace', replaced):
    checkpointer.save({'x': torch.tensor(3)}, {'steps': 3})
  previous = tmp_path / checkpointing.PREVIOUS
  assert previous not in [call.args[1] for call in replaced.call_args_list]
  tensors, _ = checkpointing.load_tensors(previous)
  assert tensors['x'][0] == 1


_FOREIGN = safetensors_torch.save({'x': torch.zeros(3)})
_NO_OBJECT = safetensors_torch.save({'x': torch.zeros(3)}, {'json': '[]'})
_OTHER = safetensors_torch.save({'x': torch.zeros(3)}, {'format': 'other'})


@pytest.mark.parametrize(
  'spoil',
  [
    *(lambda good, kept=kept: good[:kept] for kept in (0, 7, 100, -1)),
    *(lambda _, c=c: c for c in (_FOREIGN, _NO_OBJECT, _OTHER, b'steps: 3\n')),
  ],
)
def test_truncated_or_foreign_newest(
  tmp_path: pathlib.Path, spoil: Callable[[bytes], bytes]
) -> None:
  _save(tmp_path, 1)
  _save(tmp_path, 2)
  newest = tmp_path / checkpointing.NAME
  newest.write_bytes(spoil(newest.read_bytes()))
  value, note = _value(tmp_path)
  assert value == 1
  assert str(newest) in note and '\n' not in note
  assert note.endswith(f'Resuming from {checkpointing.PREVIOUS}.')
  (tmp_path / checkpointing.PREVIOUS).write_bytes(b'x')
  with pytest.raises(ValueError, match=checkpointing.NAME):
    Checkpointer(tmp_path).load()
  _save(tmp_path, 3)
  assert _value(tmp_path) == (3, '')


def test_nothing_to_load(tmp_path: pathlib.Path) -> None:
  with pytest.raises(FileNotFoundError, match=checkpointing.NAME):
    Checkpointer(tmp_path).load()
  with pytest.raises(FileNotFoundError, match='nothing'):
    checkpointing.load_tensors(tmp_path / 'nothing')
