"""Tests of dmc_multimode.experiments.sweeping, and of its command."""

import csv
import pathlib
import re
import subprocess
import sys
from typing import Any

import pytest

from dmc_multimode.experiments import run_folder
from dmc_multimode.experiments import sweeping
from dmc_multimode.experiments import training

_SMALL: dict[str, Any] = {
  'modes': 'idle',
  'steps': 32,
  'one_hot': True,
  'num_worlds': 4,
  'threads': 1,
  'ppo_rollout_length': 4,
  'ppo_minibatches': 1,
  'ppo_hidden_sizes': (8,),
}
_SEARCH = ['ppo_learning_rate:1e-4..1e-2', 'ppo_activation:elu|silu']


@pytest.mark.parametrize(
  ('text', 'values', 'is_log'),
  [
    ('ppo_learning_rate:1e-4..1e-3', (1e-4, 1e-3), True),
    ('ppo_discount:0.9..0.99', (0.9, 0.99), False),
    ('num_worlds:64..128', (64, 128), False),
    ('task_time_limit:1..2.5', (1.0, 2.5), False),
    ('ppo_activation:elu|silu', ('elu', 'silu'), False),
  ],
)
def test_ranges(text: str, values: tuple[Any, ...], is_log: bool) -> None:
  found = sweeping.parse(text)
  assert found.values == values and found.is_log == is_log
  assert [type(x) for x in found.values] == [type(x) for x in values]
  assert sweeping.parse(str(found)) == found


@pytest.mark.parametrize(
  ('search', 'message'),
  [
    ([], 'Say what to search'),
    (['ppo_discount'], 'write NAME:LOW..HIGH'),
    (['ppo_discount:0.9'], 'two values at least'),
    (['ppo_discount:0.99..0.9'], 'LOW must be less'),
    (['ppo_discount:a..b'], 'two numbers'),
    (['ppo_discount:0.9..1.5'], 'ppo_discount: '),
    (['ppo_activation:elu|cubic'], 'ppo_activation: '),
    (['ppo_nothing:0..1'], 'ppo_nothing is no setting'),
    (['ppo_discount:0.9..0.95'] * 2, 'searched twice'),
    (['one_hot:0|1'], 'one_hot is searched, and set'),
    (['task_gains_position_weight:0.1..1'], 'changes what scores mean'),
    (['steps:100..200'], 'the same in all trials'),
  ],
)
def test_bad_ranges_are_one_line_before_anything(
  search: list[str], message: str, tmp_path: pathlib.Path
) -> None:
  folder = tmp_path / 'sweep'
  with pytest.raises(ValueError, match=message) as caught:
    sweeping.sweep(folder, search, 2, **_SMALL)
  assert '\n' not in str(caught.value)
  assert not folder.exists()


@pytest.mark.slow
def test_a_sweep_goes_on_where_it_stopped(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  pytest.importorskip('optuna', reason='sweeps take the extra `sweep`')
  train = training.train

  def stopped(folder: Any, **settings: Any) -> Any:
    """As by a signal after half of the steps."""
    policy = train(folder, **{**settings, 'steps': 16})
    run = run_folder.RunFolder(folder)
    config, mode_set = run.load()
    run.save(training.dataclasses.replace(config, steps=32), mode_set)
    return policy

  monkeypatch.setattr(training, 'train', stopped)
  with pytest.raises(KeyboardInterrupt):
    sweeping.sweep(tmp_path, _SEARCH, 2, **_SMALL)
  monkeypatch.setattr(training, 'train', train)
  (first, second) = sweeping.sweep(tmp_path, _SEARCH, 2, **_SMALL)
  assert {first.number, second.number} == {0, 1}
  assert first.value is not None and second.value is not None
  assert first.value >= second.value > 0
  for trial in (first, second):
    config, _ = run_folder.RunFolder(
      tmp_path / 'trials' / str(trial.number)
    ).load()
    assert config.steps == 32
    assert config.ppo.learning_rate == trial.params['ppo_learning_rate']
    assert config.ppo.activation == trial.params['ppo_activation']
  with open(tmp_path / 'sweep.csv', encoding='utf-8') as file:
    rows = list(csv.DictReader(file))
  assert [int(row['trial']) for row in rows] == [first.number, second.number]
  assert float(rows[0]['mra_transitions']) == first.value
  assert (tmp_path / 'sweep.png').read_bytes().startswith(b'\x89PNG')
  assert len((tmp_path / 'sweep.txt').read_text().splitlines()) == 3
  with pytest.raises(ValueError, match='has search='):
    sweeping.sweep(tmp_path, _SEARCH[:1], 2, **_SMALL)
  assert sweeping.sweep(tmp_path, _SEARCH, 2, **_SMALL) == [first, second]


@pytest.mark.slow
def test_two_workers_share_the_trials(tmp_path: pathlib.Path) -> None:
  pytest.importorskip('optuna', reason='sweeps take the extra `sweep`')
  command = [sys.executable, '-m', 'dmc_multimode.bin.sweep', '--trials=4']
  command += [f'--run_dir={tmp_path}', *(f'--search={x}' for x in _SEARCH)]
  small = {**_SMALL, 'ppo_hidden_sizes': 8}
  command += [f'--{name}={value}' for name, value in small.items()]
  workers = [
    subprocess.Popen(
      command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    for _ in range(2)
  ]
  texts = [worker.communicate()[0] for worker in workers]
  assert [worker.returncode for worker in workers] == [0, 0]
  begun = re.findall(r'^trial (\d+): ppo_', '\n'.join(texts), re.M)
  assert sorted(begun) == ['0', '1', '2', '3']  # Each by one of them.


def test_the_command_says_what_is_wrong_in_one_line(
  tmp_path: pathlib.Path,
) -> None:
  command = [sys.executable, '-m', 'dmc_multimode.bin.sweep']
  command += [f'--run_dir={tmp_path / "new"}', '--search=ppo_discount:2..1']
  done = subprocess.run(command, capture_output=True, text=True)
  assert done.returncode == 2
  (line,) = done.stderr.splitlines()
  assert line.startswith("error: search 'ppo_discount:2..1': LOW must be less")
