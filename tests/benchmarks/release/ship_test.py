"""Tests of benchmarks.release.ship."""

import json
import pathlib
import shutil
import types
from typing import Any

import pytest
import torch

from dmc_multimode.experiments import config as run_config
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.pretrained import folder as folder_lib
from tests.benchmarks import modules

ship = modules.load('release.ship')

_CSV = 'steps,mra\n10,0.123456\n20,0.2\n30,0.3\n40,0.4\n45,0.45\n'


def test_curves_are_thinned() -> None:
  assert ship.thinned(_CSV, 20, 45) == (
    'steps,mra\n10,0.1235\n30,0.3\n45,0.45\n'
  )
  assert ship.thinned(_CSV, 1, 99) == _CSV.replace('123456', '1235')
  # What came after the policy does not belong to it.
  assert ship.thinned(_CSV, 20, 44).splitlines()[-1][:3] == '40,'


@pytest.mark.parametrize('text', ['', 'steps,mra\n', 'mra\n1\n'])
def test_what_is_no_curve_is_refused(text: str) -> None:
  with pytest.raises(ValueError, match='not the metrics of a run'):
    ship.thinned(text, 20, 99)


def _make_run(folder: pathlib.Path, seed: int) -> pathlib.Path:
  for part in ('policy', 'encoder', 'policies/10'):
    (folder / part).mkdir(parents=True)
  run, other = (
    run_config.to_dict(run_config.RunConfig(seed=seed)) for seed in (0, seed)
  )
  (folder / 'config.json').write_text(json.dumps({'run': run}))
  (folder / 'metrics.csv').write_text(_CSV)
  (folder / 'encoder' / 'encoder.json').write_text('{}')
  for part, made in (('policy', run), ('policies/10', other)):
    text = json.dumps({'provenance': {'run': made, 'steps': 10}})
    (folder / part / 'policy.json').write_text(text)
    (folder / part / 'policy.safetensors').write_bytes(part.encode())
  return folder


def test_all_files_are_gathered_and_old_ones_go(tmp_path: pathlib.Path) -> None:
  run = _make_run(tmp_path / 'run', seed=0)
  shipped = tmp_path / 'shipped'
  shipped.mkdir()
  (shipped / 'metrics.json').write_text('of the policy before')
  (shipped / 'selector').mkdir()
  ship.write(ship.gather(run, run / 'policies/10', 20), shipped)
  assert sorted(path.name for path in shipped.iterdir()) == [
    'encoder.json',
    'policy.json',
    'policy.safetensors',
    'training.csv',
  ]
  assert (shipped / 'policy.safetensors').read_bytes() == b'policies/10'
  curve = (shipped / 'training.csv').read_text()
  assert curve == 'steps,mra\n10,0.1235\n'


def test_a_policy_of_another_run_is_refused(tmp_path: pathlib.Path) -> None:
  run = _make_run(tmp_path / 'run', seed=1)
  with pytest.raises(ValueError, match='not a policy of the run'):
    ship.gather(run, run / 'policies/10', 20)
  with pytest.raises(FileNotFoundError, match='holds no policy'):
    ship.gather(run, run / 'policies/11', 20)


def test_all_that_is_shipped(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  """A run that ended with the shipped pi2 ships the same again."""
  shipped, run = folder_lib.find('pi2'), tmp_path / 'run'
  shutil.copytree(shipped, run / 'policy')
  provenance = json.loads((shipped / 'policy.json').read_text())['provenance']
  (run / 'config.json').write_text(json.dumps({'run': provenance['run']}))
  (run / 'metrics.csv').write_text(_CSV)
  values = {'RUN_DIR': run, 'NAME': 'pi2', 'STEPS': None}
  values |= {'CURVE_EVERY': 20, 'EPISODES': 4, 'SELECTOR': False}
  for name, value in values.items():
    flag = types.SimpleNamespace(value=value)
    monkeypatch.setattr(ship, f'_{name}', flag)
  out = tmp_path / 'out'
  monkeypatch.setattr(ship, 'shipped_folder', lambda name: out)

  def evaluate(command: list[str], **kwargs: Any) -> None:
    (report,) = [a for a in command if a.startswith('--out=')]
    shutil.copy(shipped / 'metrics.json', report.removeprefix('--out='))

  monkeypatch.setattr(ship.subprocess, 'run', evaluate)
  ship.main(['ship'])
  names = {path.name for path in out.iterdir()}
  assert names == {path.name for path in shipped.iterdir() if path.is_file()}
  # A policy that is shipped anew has no selector yet, and its card none.
  for name in names - {'training.csv', 'README.md'}:
    assert (out / name).read_bytes() == (shipped / name).read_bytes(), name


def test_a_selector_is_shipped_beside_its_policy(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  """The shipped one ships the same again; pi1 is not its policy."""
  beside = folder_lib.find('pi2') / 'selector'
  run = tmp_path / 'run'
  shutil.copytree(beside, run / 'selector')
  shutil.move(run / 'selector' / 'training.csv', run / 'metrics.csv')
  monkeypatch.setattr(ship, 'shipped_folder', lambda name: tmp_path / name)
  place = ship.ship_selector(run, 'pi2')
  assert place == tmp_path / 'pi2' / 'selector'
  for name in ('selector.json', 'training.csv'):
    assert (place / name).read_bytes() == (beside / name).read_bytes(), name
  copied, shipped = (
    selector_lib.load(folder).network.state_dict() for folder in (place, beside)
  )
  assert copied.keys() == shipped.keys()
  assert all(torch.equal(copied[name], shipped[name]) for name in shipped)
  with pytest.raises(ValueError, match='was trained with pi2, not pi1'):
    ship.ship_selector(run, 'pi1')
