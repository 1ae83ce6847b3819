"""Files that somebody else made: nothing in them is executed."""

import ast
import json
import pathlib
import pickle
from typing import Any, Callable, Iterator
import zipfile

import numpy as np
import pytest
from safetensors import torch as safetensors_torch
import torch

import dmc_multimode
from dmc_multimode import pretrained
from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import loggers
from dmc_multimode.evaluation import training_figures
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import launch
from dmc_multimode.experiments import run_folder
from dmc_multimode.modes import codebook
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import training as encoder_training
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import resources
from tests.benchmarks import modules
from tests.bin import untrained

fuzz = modules.load('reliability.fuzz')

_PACKAGE = pathlib.Path(dmc_multimode.__file__).parent
_MODES = ('idle', 'walk_forward')

# Makes what is to be read into a folder; then reads it.
_Write = Callable[[pathlib.Path], Any]
_Read = Callable[[pathlib.Path], Any]


class _Planted:
  """A pickle that makes a file where it is loaded."""

  def __init__(self, mark: pathlib.Path) -> None:
    self._mark = mark

  def __reduce__(self) -> tuple[Any, ...]:
    return pathlib.Path.touch, (self._mark,)


def _pickle(path: pathlib.Path, mark: pathlib.Path) -> None:
  path.write_bytes(pickle.dumps(_Planted(mark)))


def _torch(path: pathlib.Path, mark: pathlib.Path) -> None:
  torch.save(_Planted(mark), path)
  assert zipfile.is_zipfile(path)


def _old_torch(path: pathlib.Path, mark: pathlib.Path) -> None:
  torch.save(_Planted(mark), path, _use_new_zipfile_serialization=False)


def _numpy(path: pathlib.Path, mark: pathlib.Path) -> None:
  with open(path, 'wb') as file:
    np.save(file, np.array([_Planted(mark)]), allow_pickle=True)


def _policy(folder: pathlib.Path) -> None:
  untrained.save(folder, _MODES, task_config.ImitationConfig(), {})


def _checkpoint(folder: pathlib.Path) -> None:
  for steps in (1, 2):
    checkpointing.Checkpointer(folder).save(
      {'x': torch.zeros(3)}, {'steps': steps}
    )


def _run(folder: pathlib.Path) -> None:
  motions = library.resolve(_MODES)
  run = run_config.RunConfig(modes=','.join(_MODES), one_hot=True)
  run_folder.RunFolder(folder).save(run, mode_set.one_hot(motions))


def _encoder(folder: pathlib.Path) -> None:
  rough = mode_encoder.EncoderConfig(
    max_rmse=10.0, min_separation=0.0, hidden=4
  )
  encoder_training.train(library.resolve(_MODES), rough).save(folder)


def _codebook(folder: pathlib.Path) -> None:
  mode_set.one_hot(library.resolve(_MODES)).codebook.save(folder)


def _nothing(folder: pathlib.Path) -> None:
  """Prepares nothing more than the planted fault."""


def _read_previous(folder: pathlib.Path) -> None:
  """As `Checkpointer.load` does where the newest one is damaged."""
  checkpointing.load_tensors(folder / checkpointing.PREVIOUS)


def _resume_log(folder: pathlib.Path) -> None:
  loggers.CSVLogger(folder / 'metrics.csv', resume_from=10)


def _read_plan(name: str) -> _Read:
  return lambda folder: plan_lib.PlanFile.read(folder / name)


_READERS: list[tuple[str, _Write, _Read]] = [
  (policy_lib.WEIGHTS_FILE, _policy, pretrained.load),
  (policy_lib.DESCRIPTION_FILE, _policy, pretrained.load),
  (policy_lib.METRICS_FILE, _policy, pretrained.load),
  (
    checkpointing.NAME,
    _nothing,
    lambda folder: checkpointing.Checkpointer(folder).load(),
  ),
  (checkpointing.PREVIOUS, _checkpoint, _read_previous),
  (
    run_folder.CONFIG_FILE,
    _run,
    lambda path: run_folder.RunFolder(path).load(),
  ),
  (mode_encoder.WEIGHTS_FILE, _encoder, mode_encoder.load),
  (mode_encoder.CONFIG_FILE, _encoder, mode_encoder.load),
  (codebook.FILE, _codebook, lambda f: codebook.load(f / codebook.FILE)),
  (
    'modes.yaml',
    _nothing,
    lambda folder: mode_files.load(folder / 'modes.yaml'),
  ),
  (
    'modes.json',
    _nothing,
    lambda folder: mode_files.load(folder / 'modes.json'),
  ),
  ('modes.pkl', _nothing, lambda folder: mode_files.load(folder / 'modes.pkl')),
  ('plan.json', _nothing, _read_plan('plan.json')),
  ('plan.pkl', _nothing, _read_plan('plan.pkl')),
  ('metrics.csv', _nothing, training_figures.read),
  ('metrics.csv', _nothing, _resume_log),
]


@pytest.mark.parametrize('plant', [_pickle, _torch, _old_torch, _numpy])
@pytest.mark.parametrize(
  ('name', 'write', 'read'), _READERS, ids=[row[0] for row in _READERS]
)
def test_no_pickle_is_executed(
  tmp_path: pathlib.Path,
  name: str,
  write: _Write,
  read: _Read,
  plant: Callable[[pathlib.Path, pathlib.Path], None],
) -> None:
  folder, mark = tmp_path / 'folder', tmp_path / 'ran'
  folder.mkdir()
  write(folder)
  plant(folder / name, mark)
  with pytest.raises(ValueError) as caught:
    read(folder)
  assert name in str(caught.value)
  assert len(str(caught.value).splitlines()) == 1
  assert not mark.exists()


def test_note_of_a_launch_is_not_executed(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setenv('TORCHELASTIC_RUN_ID', 'launch')
  _run(tmp_path)
  noted = run_folder.RunFolder(tmp_path).launch
  _pickle(noted, tmp_path / 'ran')
  with pytest.raises(ValueError):
    launch.is_restart(noted)
  assert not (tmp_path / 'ran').exists()


def test_they_would_be_executed(tmp_path: pathlib.Path) -> None:
  """Otherwise the tests above would prove little."""
  marks = [tmp_path / f'ran{i}' for i in range(3)]
  path = tmp_path / 'file'
  _pickle(path, marks[0])
  pickle.loads(path.read_bytes())
  _torch(path, marks[1])
  torch.load(path, weights_only=False)
  _numpy(path, marks[2])
  np.load(path, allow_pickle=True)
  assert all(mark.exists() for mark in marks)


# The source.

_UNSAFE_MODULES = {'pickle', 'marshal', 'shelve', 'dill', 'cloudpickle'}
_UNSAFE_CALLS = {
  *('eval', 'exec', 'compile', '__import__', 'torch.load', 'np.load'),
  *('yaml.load', 'yaml.unsafe_load', 'yaml.full_load', 'os.system'),
  *('dist.gather_object', 'dist.scatter_object_list'),
  *('dist.all_gather_object', 'dist.broadcast_object_list'),
}
_XML_CALLS = {
  *('from_path', 'from_file', 'from_xml_path', 'from_xml_string'),
  *('from_binary_path', 'from_string', 'from_zip'),
}


def _calls() -> Iterator[tuple[str, str, ast.Call]]:
  """Every call in the package: module, name of what is called, node."""
  for path in sorted(_PACKAGE.rglob('*.py')):
    module = str(path.relative_to(_PACKAGE).with_suffix(''))
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
      if isinstance(node, ast.Call):
        yield module, ast.unparse(node.func), node


def test_the_package_calls_nothing_that_executes_data() -> None:
  found = [(m, name) for m, name, _ in _calls() if name in _UNSAFE_CALLS]
  assert not found
  for path in _PACKAGE.rglob('*.py'):
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
      if isinstance(node, ast.Import):
        names = {alias.name.partition('.')[0] for alias in node.names}
        assert not names & _UNSAFE_MODULES, path
      if isinstance(node, ast.ImportFrom):
        assert (node.module or '').partition('.')[0] not in _UNSAFE_MODULES


def test_xml_comes_from_the_package_alone() -> None:
  """Files of the package, and what Composer made of them.

  And robots, whose model `walkers.robot_files` has read or checked.
  """
  found = {
    (module, name): ast.unparse(node.args[0])
    for module, name, node in _calls()
    if name.rpartition('.')[2] in _XML_CALLS
  }
  assert found == {
    ('walkers/robot_walker', 'mjcf.from_xml_string'): 'robot.model.xml',
    # Read and checked, for what its compiler infers; without assets.
    ('walkers/robot_files', 'mujoco.MjSpec.from_string'): 'text',
    (
      'walkers/robot_walker',
      'mujoco.MjSpec.from_string',
    ): 'root.to_xml_string()',
    (
      'deployment/mjcf_export',
      'mjcf.from_path',
    ): 'str(scene)',
    # Its own, from a process to the one that it starts.
    (
      'viewer/take',
      'mujoco.MjModel.from_binary_path',
    ): 'str(folder / _MODEL)',
    (
      'suite/imitation/mujoco_worlds',
      'mujoco.MjSpec.from_string',
    ): 'root.to_xml_string()',
  }


@pytest.mark.parametrize(
  'name', ['../setup.cfg', '/etc/passwd', 'a/../../setup.cfg', '', 'absent.xml']
)
def test_no_other_xml_can_be_named(name: str) -> None:
  with pytest.raises(FileNotFoundError):
    resources.path('xml', name)


# Limits come before memory.


def _sparse(path: pathlib.Path, size: int) -> None:
  with open(path, 'r+b') as file:
    file.truncate(size)  # It takes no room.


@pytest.mark.parametrize(
  ('name', 'write', 'read', 'size'),
  [
    (mode_encoder.CONFIG_FILE, _encoder, mode_encoder.load, 65 << 20),
    (mode_encoder.WEIGHTS_FILE, _encoder, mode_encoder.load, 65 << 20),
    (
      codebook.FILE,
      _codebook,
      lambda folder: codebook.load(folder / codebook.FILE),
      2 << 20,
    ),
    (
      checkpointing.NAME,
      _checkpoint,
      lambda folder: checkpointing.load_tensors(folder / checkpointing.NAME),
      5 << 30,
    ),
  ],
)
def test_too_large(
  tmp_path: pathlib.Path, name: str, write: _Write, read: _Read, size: int
) -> None:
  write(tmp_path)
  _sparse(tmp_path / name, size)
  with pytest.raises(ValueError, match='too large'):
    read(tmp_path)


def _weights(header: dict[str, Any], size: int) -> bytes:
  text = json.dumps(header).encode()
  return len(text).to_bytes(8, 'little') + text + bytes(size)


_METADATA = {'__metadata__': {'json': json.dumps({'format': 'x'})}}


@pytest.mark.parametrize(
  'header',
  [
    {'x': {'dtype': 'F32', 'shape': [10**12], 'data_offsets': [0, 8]}},
    {'x': {'dtype': 'F32', 'shape': [2**32, 2**32], 'data_offsets': [0, 8]}},
    {'x': {'dtype': 'F32', 'shape': [-2], 'data_offsets': [0, 8]}},
    {'x': {'dtype': 'PY', 'shape': [1], 'data_offsets': [0, 8]}},
    {'x': 3},
  ],
)
def test_shapes_that_the_file_does_not_hold(
  tmp_path: pathlib.Path, header: dict[str, Any]
) -> None:
  path = tmp_path / 'file'
  longer = (2**63).to_bytes(8, 'little') + b'{}'  # A header than its file.
  for content in (_weights({**_METADATA, **header}, 8), longer):
    path.write_bytes(content)
    with pytest.raises(ValueError, match='truncated or was not written by'):
      checkpointing.load_tensors(path)


@pytest.mark.parametrize('kind', [torch.float8_e4m3fn, torch.complex64])
def test_weights_of_another_type(
  tmp_path: pathlib.Path, kind: torch.dtype
) -> None:
  """Cast where that can be done; refused otherwise, and never a traceback."""
  _encoder(tmp_path)
  path = tmp_path / mode_encoder.WEIGHTS_FILE
  weights = safetensors_torch.load(path.read_bytes())
  other = {key: value.to(kind) for key, value in weights.items()}
  content = safetensors_torch.save(other)
  path.write_bytes(content)
  described = json.loads((tmp_path / mode_encoder.CONFIG_FILE).read_text())
  described['weights_sha256'] = mode_encoder.digest(content)
  (tmp_path / mode_encoder.CONFIG_FILE).write_text(json.dumps(described))
  with pytest.raises(ValueError, match='do not fit'):
    mode_encoder.load(tmp_path)


# Parsers.


@pytest.mark.parametrize('name', fuzz.parsers())
def test_no_parser_raises_another_error(
  tmp_path: pathlib.Path, name: str
) -> None:
  found = fuzz.feed(name, 200, 0, tmp_path)
  assert found['refused'] > 100
  assert not found['escapes']
