"""Tests of dmc_multimode.bin.evaluate."""

import itertools
import json
import pathlib
from typing import Iterator

import numpy as np
import pytest

from dmc_multimode.suite.imitation import config as task_config
from tests.bin import processes
from tests.bin import untrained

_MODES = ('idle', 'walk_forward')
# The first model costs seconds.
_WARM_UP = """
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.modes import library
mujoco_worlds.compile_model(multimode_biped.make_task(library.mode_set('idle')))
"""


@pytest.fixture(scope='module')
def evaluate(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  folder = tmp_path_factory.mktemp('output')
  binary = processes.Binary('evaluate', folder, _WARM_UP)
  yield binary
  binary.close()


@pytest.fixture(scope='module')
def policy(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The folder of an untrained policy, for episodes of 0.6 seconds."""
  folder = tmp_path_factory.mktemp('policy')
  task = task_config.ImitationConfig(time_limit=0.6)
  untrained.save(folder, _MODES, task, {'steps': 12})
  return folder


def test_report_of_one_rank_and_of_two(
  evaluate: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  one, two = tmp_path / 'new' / 'one.json', tmp_path / 'two.json'
  flags = f'--policy={policy}', '--episodes=1'
  done = evaluate(*flags, f'--out={one}')
  assert done.code == 0, done.stderr
  assert done.stdout.splitlines()[-1] == f'The report is in {one}'
  shared = evaluate(*flags, f'--out={two}', ranks=2)
  assert shared.code == 0, shared.stderr
  assert one.read_bytes() == two.read_bytes()
  assert shared.stdout.splitlines()[:-1] == done.stdout.splitlines()[:-1]

  report = json.loads(one.read_text())
  assert tuple(report['modes']) == _MODES
  pairs = [f'{a}->{b}' for a, b in itertools.product(_MODES, _MODES)]
  assert list(report['transitions']) == pairs
  for row in report['modes'].values():
    assert {'mra', 'survival', 'velocity', 'rise'} <= row.keys()
    assert all(np.isfinite(value) for value in row.values())
  for kind in ('modes', 'transitions'):
    values = [row['mra'] for row in report[kind].values()]
    summary = report[f'mra_{kind}']
    assert summary.keys() == {'mean', 'std'}
    assert summary['mean'] == pytest.approx(np.mean(values))
    assert summary['std'] == pytest.approx(np.std(values))
    assert 0 < min(values) <= max(values) < 1
  assert report['provenance']['steps'] == 12
  # One-hot commands have no encoder.
  assert report['provenance']['encoder_seed'] is None
  events = report['task']['events']
  assert events['reference_starts'] == events['edge_noise'] == 0
  for name in (*_MODES, *pairs):
    assert name in done.stdout
  # An untrained policy passes nothing but to stay where it is, if that.
  assert set(report['acceptance']) == set(_MODES)
  speed = report['acceptance']['walk_forward']['speed']
  assert (speed['least'], speed['most']) == pytest.approx((0.5, 0.7))
  assert not speed['passed']  # It tumbles.
  assert 'walk_forward: speed' in done.stdout
  assert report['motion']['walk_forward']['torque_peak'] > 1
  assert 'torque_peak Nm' in done.stdout


def test_page_where_nothing_draws(
  evaluate: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  page = tmp_path / 'new' / 'report.html'
  evaluate.start(
    f'--policy={policy}',
    '--episodes=1',
    '--nomotion',
    f'--html={page}',
    # As if the warm-up had not imported what reads the variable.
    before="os.environ['MUJOCO_GL'] = 'nothing'; "
    "sys.modules.pop('dm_control._render', None)",
  )
  done = evaluate.wait()
  assert done.code == 0, done.stderr
  *_, skipped, wrote = done.stdout.splitlines()
  assert skipped.startswith('No videos: MUJOCO_GL=nothing cannot draw here')
  assert wrote == f'The page is {page}'
  assert list(page.parent.iterdir()) == [page]
  text = page.read_text()
  assert text.count('<img ') == 3 and '<video' not in text


def test_two_policies_side_by_side(
  evaluate: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  other, page = tmp_path / 'other', tmp_path / 'page.html'
  task = task_config.ImitationConfig(time_limit=0.9)
  untrained.save(other, ('idle', 'launch'), task, {'steps': 24})
  done = evaluate(
    f'--policy={policy}',
    f'--compare={other}',
    '--episodes=1',
    '--nomotion',
    f'--html={page}',
    f'--figures={tmp_path / "figures"}',
    before="os.environ['MUJOCO_GL'] = 'nothing'; "
    "sys.modules.pop('dm_control._render', None)",
  )
  assert done.code == 0, done.stderr
  assert done.stdout.splitlines()[-1] == f'The page is {page}'
  assert 'acceptance criteria passed' in done.stdout
  text = page.read_text()
  assert text.count('<img ') == 6
  assert f'{other} alone has launch.' in text
  assert 'task: time_limit' in text
  assert len(list((tmp_path / 'figures').iterdir())) == 3


def test_clock_rates_and_figures(
  evaluate: processes.Binary, policy: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  out, folder = tmp_path / 'report.json', tmp_path / 'figures'
  done = evaluate(
    f'--policy={policy}',
    '--episodes=1',
    '--clock_rates=1,2.5',
    '--switching',
    '--switching_episodes=2',
    '--nomotion',
    '--action_delay=0.02',
    '--friction=0.4',
    '--push_speed=1',
    f'--out={out}',
    f'--figures={folder}',
  )
  assert done.code == 0, done.stderr
  report = json.loads(out.read_text())
  assert report['switching']['episodes'] == 2 and 'motion' not in report
  assert 'switches, from_ground: survival' in done.stdout
  events = report['task']['events']
  assert events['disturbances']['friction'] == [0.4, 0.4]
  assert events['disturbances']['action_delay'] == [0.02, 0.02]
  assert events['push_speed']['last'] == 1
  rates = report['clock_rates']
  assert list(rates) == ['1', '2.5']
  for rate, row in rates.items():
    assert list(row) == ['walk_forward']  # Idling goes nowhere.
    found = row['walk_forward']
    assert found['reference'] == pytest.approx(0.6 * float(rate))
    assert np.isfinite(found['velocity']) and 0 <= found['survival'] <= 1
    assert 0 < found['mra'] < 1
    assert f'clock rate {rate}: walk_forward {found["velocity"]:.2f}' in (
      done.stdout
    )
  names = {path.stem for path in folder.iterdir()}
  assert names == {'clock_rates', 'contacts', 'heights', 'sequence'}


@pytest.mark.parametrize(
  ('flags', 'message'),
  [
    (['--policy=fly'], "'fly'"),
    (['--policy={tmp}/damaged'], 'damaged'),
    (['--physics_timestep=0.007'], 'physics_timestep'),
    (['--clock_rates=1,0'], 'clock_rates must be positive'),
    (['--clock_rates=fast'], "'fast'"),
    (['--friction=-1'], 'friction is at least 0'),
    (['--html={tmp}/new/report.html', '--episodes=0'], 'episodes'),
    (['--figures={tmp}/file'], 'file'),
    (['--compare=pi2'], 'add --html=FILE'),
    (['--html={tmp}/new/page.html', '--compare=fly'], "'fly'"),
  ],
  ids=lambda value: value if isinstance(value, str) else ' '.join(value),
)
def test_bad_input(
  evaluate: processes.Binary,
  policy: pathlib.Path,
  tmp_path: pathlib.Path,
  flags: list[str],
  message: str,
) -> None:
  (tmp_path / 'file').touch()
  (tmp_path / 'damaged').mkdir()
  (tmp_path / 'damaged' / 'policy.json').write_text('{"format"')
  before = sorted(tmp_path.rglob('*'))
  done = evaluate(
    f'--policy={policy}',
    f'--out={tmp_path / "new" / "report.json"}',
    *(flag.format(tmp=tmp_path) for flag in flags),
  )
  assert done.code == 2, done.stderr
  assert message in done.error
  assert not done.stdout
  assert sorted(tmp_path.rglob('*')) == before
