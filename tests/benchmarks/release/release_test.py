"""Tests of benchmarks.release.release."""

import pathlib
import tarfile

import pytest

import dmc_multimode
from tests.benchmarks import modules

release = modules.load('release.release')


def test_versions_are_the_same_everywhere(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  assert release.check_versions() == dmc_multimode.__version__
  assert len(release.versions()) == 3
  monkeypatch.setattr(dmc_multimode, '__version__', '9.9.9')
  with pytest.raises(ValueError, match='The versions differ'):
    release.check_versions()


def test_a_changelog_without_a_version_is_refused(
  tmp_path: pathlib.Path,
) -> None:
  (tmp_path / 'CHANGELOG.md').write_text('# Changes\n')
  with pytest.raises(ValueError, match='no heading'):
    release.versions(tmp_path)


def test_the_wheel_is_tried_without_the_source(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  tree = tmp_path / 'name-1'
  for name in ('dmc_multimode', 'tests', 'docs', 'benchmarks'):
    (tree / name).mkdir(parents=True)
  sdist = tmp_path / 'name-1.tar.gz'
  with tarfile.open(sdist, 'w:gz') as archive:
    archive.add(tree, 'name-1')
  ran: list[tuple[str, ...]] = []
  monkeypatch.setattr(
    release, '_run', lambda *words, cwd=None: ran.append((str(cwd), *words))
  )
  release.try_wheel(tmp_path / 'name-1.whl', sdist)
  beside = tmp_path / 'beside' / 'name-1'
  assert {path.name for path in beside.iterdir()} == {'tests', 'docs'}
  folder, *words = ran[-1]
  assert folder == str(beside) and 'pytest' in words
  assert 'tests/docs_test.py' in words
