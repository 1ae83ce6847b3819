"""Tests for atomic."""

import os
import pathlib
import stat
from unittest import mock

import pytest

from dmc_multimode.utils import files


def test_replaces(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'file'
  files.write(path, b'one')
  files.write(path, b'two')
  assert path.read_bytes() == b'two'
  assert os.listdir(tmp_path) == ['file']
  umask = os.umask(0)
  os.umask(umask)
  assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


def test_leaves_nothing_behind(tmp_path: pathlib.Path) -> None:
  target = tmp_path / 'folder'
  (target / 'inside').mkdir(parents=True)
  with pytest.raises(OSError):
    files.write(target, b'one')
  assert os.listdir(tmp_path) == ['folder']


def test_a_full_disk_leaves_the_old_file(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'file'
  files.write(path, b'one')
  with mock.patch.object(os, 'fsync', side_effect=OSError('full')):
    with pytest.raises(OSError, match='full'):
      files.write(path, b'two')
  assert path.read_bytes() == b'one'
  assert os.listdir(tmp_path) == ['file']
