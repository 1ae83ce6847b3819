"""Every example runs, in sizes that take seconds."""

import importlib.util
import pathlib
from typing import Any

import pytest

_EXAMPLES = pathlib.Path(__file__).resolve().parent.parent / 'examples'
_MOST_LINES = 60
# deploy_mujoco has tests of its own.
_SMALL: dict[str, dict[str, Any]] = {
  'evaluate_on_ice': {'policy': 'unimodal_walk', 'episodes': 1},
  'mode_of_your_own': {'policy': 'quickstart', 'steps': 1024},
  'network_of_your_own': {'steps': 1024, 'num_worlds': 16, 'out': 'network.pt'},
  'other_learners': {'steps': 384, 'num_worlds': 16},
  'reward_of_your_own': {'steps': 1024, 'num_worlds': 16},
  'track_of_your_own': {'width': 0.1},
  'train_from_python': {'steps': 1024},
}
_DRAW = ('mode_of_your_own', 'track_of_your_own', 'train_from_python')


def _parameters() -> list[Any]:
  return [
    pytest.param(
      name,
      marks=[pytest.mark.slow] + [pytest.mark.gl] * (name in _DRAW),
    )
    for name in _SMALL
  ]


def test_all_are_tested_and_short() -> None:
  names = {path.stem for path in _EXAMPLES.glob('*.py')}
  assert names == {*_SMALL, 'deploy_mujoco'}
  for name in names:
    text = (_EXAMPLES / f'{name}.py').read_text(encoding='utf-8')
    assert len(text.splitlines()) <= _MOST_LINES, name


@pytest.mark.parametrize('name', _parameters())
def test_runs(
  name: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  if name == 'other_learners':
    pytest.importorskip('stable_baselines3')
    pytest.importorskip('rsl_rl')
  monkeypatch.chdir(tmp_path)
  path = _EXAMPLES / f'{name}.py'
  spec = importlib.util.spec_from_file_location(name, path)
  assert spec and spec.loader
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  module.main(**_SMALL[name])
