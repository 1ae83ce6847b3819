"""Tests for resources."""

import pathlib
from typing import Any

import pytest

from dmc_multimode.utils import resources


@pytest.mark.parametrize('kind', ['xml', 'flags', 'pretrained'])
def test_whatever_is_listed_is_found(kind: resources.Kind) -> None:
  names = resources.names(kind)
  assert names == sorted(names)
  for name in names:
    found = resources.path(kind, name)
    assert found.is_absolute()
    assert found.name == name
    assert found.is_dir() if kind == 'pretrained' else found.is_file()


def test_the_robot_is_there() -> None:
  assert '<mujoco' in resources.path('xml', 'mini_biped.xml').read_text()


@pytest.mark.parametrize(
  ('name', 'flag', 'steps'),
  [
    ('pi1_uniform', '--sampling_kind=uniform', '--steps=21000000'),
    ('pi2_uniform', '--sampling_kind=uniform', '--steps=55000000'),
    ('pi2_one_hot', '--one_hot', '--steps=18000000'),
  ],
)
def test_a_baseline_differs_in_one_thing(
  name: str, flag: str, steps: str
) -> None:
  """And in its length: pi1_21m, pi2_paper and pi2_18m have as many steps."""
  compared = f'{name[:3]}_paper'
  ours, baseline = (
    {
      line
      for line in resources.path('flags', f'{n}.flags').read_text().splitlines()
      if line.startswith('--')
    }
    for n in (compared, name)
  )
  ours = {line for line in ours if not line.startswith('--steps=')}
  assert baseline == ours | {flag, steps}


@pytest.mark.parametrize(
  'name', ['no_such.xml', '', '../setup.cfg', '/etc/passwd']
)
def test_missing_names_what_exists(name: str) -> None:
  with pytest.raises(FileNotFoundError, match='there is:.*mini_biped.xml'):
    resources.path('xml', name)


def test_unknown_kind() -> None:
  kind: Any = 'pictures'
  with pytest.raises(ValueError, match="'pictures'"):
    resources.path(kind, 'mini_biped.xml')


def test_a_damaged_installation(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(resources, '_PACKAGE', tmp_path)
  with pytest.raises(FileNotFoundError, match='damaged'):
    resources.path('flags', 'pi2.flags')
