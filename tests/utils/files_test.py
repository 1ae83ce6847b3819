"""Tests for files."""

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


def test_json_comes_back(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'file'
  files.write_json(path, {'sizes': [1, 2.5]})
  assert files.read_json(path) == {'sizes': [1, 2.5]}


@pytest.mark.parametrize(
  'text', ['', '{"a"', '[NaN]', '[' * 100_000, '\xff', '[-Infinity]']
)
def test_json_that_is_none(tmp_path: pathlib.Path, text: str) -> None:
  path = tmp_path / 'file'
  path.write_text(text, encoding='latin-1')
  with pytest.raises(ValueError, match=f'{path} is damaged: '):
    files.read_json(path)


def test_a_file_of_another_size(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'file'
  path.write_bytes(bytes(9))
  files.check_size(path, 9)
  assert files.read_bounded(path, 9) == bytes(9)
  for read in (files.check_size, files.read_bounded):
    with pytest.raises(ValueError, match='too large'):
      read(path, 8)


def test_outputs(tmp_path: pathlib.Path) -> None:
  file = tmp_path / 'file'
  file.touch()
  assert files.output_file('out', None) is None
  assert files.output_folder('out', '') is None
  assert files.output_file('out', file) == file
  new = tmp_path / 'new' / 'folder'
  assert files.output_folder('out', new) == new
  with pytest.raises(IsADirectoryError, match=f'--out={tmp_path} is a folder'):
    files.output_file('out', tmp_path)
  with pytest.raises(NotADirectoryError, match=f'--out={file} is a file'):
    files.output_folder('out', file)
  with pytest.raises(NotADirectoryError, match='cannot write into'):
    files.output_file('out', file / 'below')
  with pytest.raises(OSError, match='--out=/proc/new: cannot write into /proc'):
    files.output_folder('out', '/proc/new')  # Where root may not write either.


def test_home(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setenv('HOME', str(tmp_path))
  assert files.expand('~/a/~b') == f'{tmp_path}/a/~b'
  assert files.output_file('out', pathlib.Path('~/x')) == tmp_path / 'x'
  for path in ('a/~', './~b', '/~', 'pi2'):
    assert files.expand(path) == path
  with pytest.raises(ValueError, match='~nobody_here is no home folder'):
    files.expand('~nobody_here/x')
