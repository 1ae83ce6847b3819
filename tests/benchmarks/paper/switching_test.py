"""Tests of benchmarks.paper.switching and of what it measures."""

import json
import pathlib

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.modes import library
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import events
from tests.benchmarks import modules
from tests.bin import processes
from tests.bin import untrained

switching = modules.load('paper.switching')

_CONFIG = task_config.ImitationConfig(time_limit=0.3, events=events.NONE)
_SETS = {'both': ('walk_forward', 'launch'), 'one': ('walk_forward',)}


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """Holds untrained policies: `both`, `one` and `two`, which is launch's."""
  result = tmp_path_factory.mktemp('policies')
  for name, modes in (*_SETS.items(), ('two', ('launch',))):
    untrained.save(result / name, modes, _CONFIG, {})
  return result


def test_each_policy_acts_in_the_worlds_of_its_mode(
  folder: pathlib.Path,
) -> None:
  policies = [pretrained.load(folder / name) for name in ('one', 'two')]
  both = switching.HardSwitch(policies)
  assert both.mode_set.names == ('walk_forward', 'launch')
  state = np.random.RandomState(0).standard_normal((4, 33)).astype(np.float32)
  command = both.mode_set.latents[[1, 0, 0, 1]]
  seen = np.concatenate([state[:, :2], command, state[:, 2:]], axis=1)
  actions = both.select_action(seen)
  for i, policy in enumerate(policies):
    mine = np.flatnonzero(command.argmax(axis=1) == i)
    latent = np.ones((len(mine), 1), dtype=np.float32)
    alone = [state[mine, :2], latent, state[mine, 2:]]
    expected = policy.select_action(np.concatenate(alone, axis=1))
    np.testing.assert_allclose(actions[mine], expected, atol=1e-6)


def test_needs_policies_of_one_mode(folder: pathlib.Path) -> None:
  policy = pretrained.load(folder / 'both')
  with pytest.raises(ValueError, match='not one of walk_forward, launch'):
    switching.HardSwitch([policy])


def test_switches_are_spread_over_a_cycle() -> None:
  modes = library.mode_set('walk_forward,launch')
  schedule = switching.make_schedule(modes, 'walk_forward', 'launch', 4)
  np.testing.assert_array_equal(schedule.modes, [[0, 1]] * 4)
  np.testing.assert_allclose(schedule.starts[:, 1], [1.2, 1.35, 1.5, 1.65])


def test_report(
  benchmark: processes.Binary, folder: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  out = tmp_path / 'switching.json'
  done = benchmark(
    f'--policy={folder / "both"}',
    f'--before={folder / "one"}',
    f'--after={folder / "two"}',
    '--phases=3',
    f'--out={out}',
    f'--figures={tmp_path}',
  )
  assert done.code == 0, done.stderr
  table = json.loads(out.read_text())['table']
  assert len(table) == 2
  for row in table.values():  # Who has learned nothing climbs no block.
    assert row['succeeded'] == 0 and row['of'] == 3
    assert row['kept'] == [False] * 3
    assert 0 <= row['fallen'] <= 3
  assert (tmp_path / 'switching.png').is_file()


def test_bad_input(benchmark: processes.Binary, folder: pathlib.Path) -> None:
  done = benchmark(
    f'--policy={folder / "both"}',
    f'--before={folder / "both"}',
    f'--after={folder / "two"}',
  )
  assert done.code == 2, done.stderr
  assert 'unimodal' in done.error
