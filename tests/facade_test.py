"""The front door: names, what they load, and that commands do the same."""

import dataclasses
import importlib
import inspect
import json
import pathlib
import pkgutil
import re
import subprocess
import sys
from typing import Any, get_args

import numpy as np
import pytest

import dmc_multimode as dmm
from dmc_multimode import suite
from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import track
from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import gait_metrics
from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.modes import library
from dmc_multimode.planner import solver
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite import reaching
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes as episodes_lib
from dmc_multimode.utils import constants
from dmc_multimode.viewer import camera
from tests.bin import untrained

_PACKAGES = [
  'dmc_multimode',
  *(
    module.name
    for module in pkgutil.walk_packages(dmm.__path__, 'dmc_multimode.')
    if module.ispkg
  ),
]
_HEAVY = {'av', 'imageio', 'jinja2', 'matplotlib', 'torch', 'viser'}


@pytest.mark.parametrize('package', _PACKAGES)
def test_every_public_name_is_there(package: str) -> None:
  module = importlib.import_module(package)
  assert len(module.__all__) == len(set(module.__all__))
  for name in module.__all__:
    if not hasattr(module, name):  # A module of the package.
      try:
        importlib.import_module(f'{package}.{name}')
      except ModuleNotFoundError as error:
        assert 'pip install' in str(error)  # An extra that is not here.
  assert not hasattr(module, 'no_such_name')


def _loaded_by(statement: str) -> set[str]:
  """Modules that a new process has after a statement."""
  code = f'{statement}\nimport sys\nprint(*sys.modules)'
  done = subprocess.run(
    [sys.executable, '-c', code], capture_output=True, text=True, check=True
  )
  return set(done.stdout.split())


def test_importing_the_package_loads_nothing_but_itself() -> None:
  third_party = {'dm_control', 'numpy', 'mujoco', 'pydantic', 'scipy'}
  assert not _loaded_by('import dmc_multimode') & (_HEAVY | third_party)


def test_importing_the_suite_loads_little_beyond_dm_controls() -> None:
  loaded = _loaded_by('from dmc_multimode import suite')
  assert 'dm_control.suite' in loaded
  late = {'dm_control.composer', 'scipy.spatial', 'dmc_multimode.pretrained'}
  assert not loaded & (_HEAVY | late)


def test_load_is_the_suites() -> None:
  config = task_config.ImitationConfig(time_limit=0.3)
  for task in ('walk_forward', 'pi2'):
    env = dmm.load(task, random=1, config=config, arena='plateau')
    twin = suite.load(
      'multimode_biped',
      task,
      {'random': 1, 'config': config, 'arena': 'plateau'},
    )
    ours, theirs = env.reset().observation, twin.reset().observation
    assert list(ours) == list(theirs)
    for name, value in ours.items():
      np.testing.assert_array_equal(value, theirs[name])
    assert env.task.config is config
    assert (
      env.task.root_entity.num_segments == track.make('plateau').num_segments
    )
  with pytest.raises(ValueError, match='walk_forward'):
    dmm.load('fly')


def test_checkers_know_every_reaching_task() -> None:
  tasks = {f'reach_{name}' for name in reaching.TRACKS}
  assert set(get_args(dmm._Reaching)) == tasks


def test_worlds_of_names_are_the_tasks_worlds() -> None:
  worlds = dmm.make_worlds('walk_forward', num_worlds=2, seed=3, num_threads=1)
  env = dmm.load('walk_forward', random=3)
  seen = np.concatenate(list(env.reset().observation.values()))
  assert worlds.reset().shape == (2, seen.size)
  np.testing.assert_allclose(worlds.reset_alike()[0, 2:6], seen[2:6])
  assert worlds.mode_set.names == ('walk_forward',)
  assert isinstance(worlds.episodes, episodes_lib.ScheduledEpisodes)
  several = dmm.make_worlds(['idle', 'launch'], 1, np.random.RandomState(0))
  assert isinstance(several.episodes, episodes_lib.TransitionEpisodes)
  paid = dmm.make_worlds('pi3', 1).config.gains
  assert paid == multimode_biped.REWARD_GAINS['pi3']


def test_worlds_of_a_policy_are_those_it_is_evaluated_in(
  tmp_path: pathlib.Path,
) -> None:
  policy = dmm.load_policy('quickstart')
  folder = tmp_path / 'mine'
  policy.save(str(folder))
  for given in (policy, folder):
    worlds = dmm.make_worlds(given, 2, arena='gap', privileged=True)
    assert worlds.mode_set.names == policy.mode_set.names
    np.testing.assert_array_equal(
      worlds.mode_set.latents, policy.mode_set.latents
    )
    assert worlds.config == task_config.evaluated(policy.config)
    assert worlds.privileged_size
  mine = dmm.make_worlds(library.mode_set('idle'), 1)
  assert mine.mode_set.names == ('idle',)
  thing: Any = 3
  with pytest.raises(TypeError, match='policy'):
    dmm.make_worlds(thing, 1)


@pytest.mark.parametrize('path', [str, pathlib.Path])
def test_a_policy_is_saved_and_loaded(
  path: Any, tmp_path: pathlib.Path
) -> None:
  policy = dmm.load_policy('quickstart')
  policy.save(path(tmp_path / 'mine'))
  again = dmm.load_policy(path(tmp_path / 'mine'))
  seen = np.ones((2, policy.network.observation_size), dtype=np.float32)
  np.testing.assert_array_equal(
    policy.select_action(seen), again.select_action(seen)
  )


_TASK = task_config.ImitationConfig(time_limit=0.3)


def _command(name: str, *flags: str) -> None:
  command = [sys.executable, '-m', f'dmc_multimode.bin.{name}', *flags]
  done = subprocess.run(command, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_evaluate_returns_what_the_command_writes(
  tmp_path: pathlib.Path,
) -> None:
  untrained.save(tmp_path / 'policy', ['idle'], _TASK, {'steps': 0})
  out = tmp_path / 'report.json'
  policy, seed = f'--policy={tmp_path / "policy"}', '--seed=3'
  _command('evaluate', policy, seed, '--episodes=1', f'--out={out}')
  found = dmm.evaluate(tmp_path / 'policy', seed=3, episodes=1, quiet=True)
  written = json.loads(out.read_text())
  written['provenance'].pop('encoder_seed')  # Of the folder, not the policy.
  assert json.loads(json.dumps(found)) == written


@pytest.mark.slow
def test_train_makes_what_the_command_makes(tmp_path: pathlib.Path) -> None:
  small: dict[str, Any] = {
    'seed': 3,
    'num_worlds': 4,
    'threads': 1,
    'one_hot': True,
    'ppo_rollout_length': 2,
    'ppo_minibatches': 1,
    'ppo_hidden_sizes': (8,),
  }
  policy = dmm.train(
    tmp_path / 'ours', modes=['idle', 'launch'], steps=16, **small
  )
  small['ppo_hidden_sizes'] = 8
  given = [f'--{name}={value}' for name, value in small.items()]
  run_dir = tmp_path / 'theirs'
  _command(
    *('train', f'--run_dir={run_dir}', '--modes=idle,launch', '--steps=16'),
    *given,
  )
  weights = policy.network.state_dict()
  for folder in (tmp_path / 'ours', run_dir):
    saved = dmm.load_policy(folder)
    for name, weight in saved.network.state_dict().items():
      np.testing.assert_array_equal(weight, weights[name])
    assert saved.provenance['steps'] == policy.provenance['steps'] == 16


def test_train_takes_motions_of_ones_own(tmp_path: pathlib.Path) -> None:
  walk = library.modes()['walk_forward']
  slow = dataclasses.replace(
    walk, name='slow_walk', mirror='', duration=2 * walk.duration
  )
  policy = dmm.train(
    tmp_path, modes=['idle', slow], steps=8, one_hot=True, num_worlds=2
  )
  assert policy.mode_set.names == ('idle', 'slow_walk')
  assert policy.mode_set.motions[1].duration == 2 * walk.duration
  with pytest.raises(ValueError, match='already holds a run.* resume=True'):
    dmm.train(tmp_path, modes=policy.mode_set, steps=8)


def test_what_lies_before_a_policy() -> None:
  modes = dmm.load_modes('pi2')
  assert isinstance(modes, dmm.ModeSet)
  leap = modes.motions[modes.index('leap_forward')]
  reference = dmm.sample_reference(leap, leap.phases)
  np.testing.assert_allclose(reference.position, leap.positions, atol=1e-9)
  slow = dataclasses.replace(leap, name='slow', duration=1.5, mirror='')
  encoder = dmm.train_encoder(['idle', 'walk_forward', slow], seed=1)
  assert encoder.codebook().names == ('idle', 'walk_forward', 'slow')
  assert max(encoder.rmse().values()) < 0.02
  with pytest.raises(ValueError, match='fly'):
    dmm.train_encoder('fly')


def test_docstrings_name_the_values_that_there_are() -> None:
  """Constants of modules are not in the API's pages."""
  tracks, cameras = set(layouts.NAMES), set(camera.VIEWS)
  for thing, values in (
    (dmm.plan, tracks | set(solver.PLANNERS)),
    (dmm.record, tracks),
    (dmm.make_worlds, tracks),
    (track.make, tracks),
    (dmm.RecordingConfig, cameras),
    (dmm.train, {f'{constants.TRAINING_STEPS:,}'}),
    (dmm.draw_plan, {'savefig'}),
  ):
    words = set(re.findall(r'[\w,]*\w', inspect.getdoc(thing) or ''))
    assert not values - words, thing


def test_every_value_of_a_report_is_defined() -> None:
  still = np.zeros((40, 3))
  upright = gait_metrics.Trace(
    *(still, still, still[:, 0], still[:, 0], still[:, :2]),
    *(still[:, :2], still[:, :2], 0.03, 0.6),
  )
  names = {*gait_metrics.metrics(upright), 'mra', 'survival'}
  names |= {metric.name for metric in motion_metrics.TABLE}
  everything = {**library.modes(), **library.four_footed_modes()}
  for motion in everything.values():
    names |= {criterion.metric for criterion in acceptance.criteria(motion)}
  names |= {name for name, *_ in acceptance._LEANS}
  text = inspect.getdoc(dmm.evaluate) or ''
  defined = re.findall(r'^ +([\w, ]+): ', text, re.M)
  known = {name for row in defined for name in row.split(', ')}
  assert not names - known
