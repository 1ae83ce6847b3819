"""Parsers of what users may be handed, and files to begin with: for `fuzz`.

Every target takes the bytes of a file and may raise nothing but the error that
its parser documents, in one line.
"""

import functools
import json
import pathlib
from typing import Any, Callable, Mapping, NamedTuple, Sequence

from dmc_multimode.modes import codebook
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.planner import plan as plan_lib

_MODE = """\
name: hop_in_place
kind: periodic
duration: 0.6  # Seconds.
takeoff: 0.25
mirror: hop_in_place
half_cycle_symmetric: true
step: {edge: 0.3, height: -0.1}
keyframes:
  - {phase: 0.0, position: [0, 0, 0.5], contacts: [1, 1]}
  - phase: 5e-1
    position: [0, 0, .6]
    euler: [0, 0, 45]
    contacts: [0, 0]
  - {phase: 1, position: [0, 0, 0.5], orientation: [1, 0, 0, 0],
     contacts: [1, 1]}
"""
# What means something to a parser, and what numbers go wrong with.
WORDS = tuple(
  word.encode()
  for word in (
    *'[]{}:,-?&*!|>\'"%@#\n\t .\\',
    *('null', 'true', '.inf', '-.inf', '.nan', 'NaN', 'Infinity', '1e999'),
    *('1e-320', '-0', '0', '1', '9' * 400, '-1e4', '0x10', '1_000', '~'),
    *('!!python/name:os.system', '!!binary', '<<', '---', '...', '\\ud800'),
    *('\x00', '\ufeff', '\u2028', '[' * 40, '{"a":' * 40, 'pi2'),
    *('name', 'kind', 'keyframes', 'phase', 'position', 'modes', 'step'),
    *('plan', 'knots', 'dt', 'arena', 'sizes', 'seed', 'pushes', 'time'),
    *('velocity', 'latents', 'hidden_sizes', 'task', 'gains', 'limits'),
  )
)


class Target(NamedTuple):
  """A parser.

  Attributes:
    run: parses the bytes of a file.
    seeds: files that it reads.
    errors: what it may raise.
    share: of the cases.
  """

  run: Callable[[bytes], Any]
  seeds: Sequence[bytes]
  errors: tuple[type[Exception], ...]
  share: float


def _written(
  path: pathlib.Path, read: Callable[[pathlib.Path], Any], content: bytes
) -> Any:
  """Writes a file and reads it."""
  path.write_bytes(content)
  return read(path)


def _read_plan(path: pathlib.Path) -> None:
  plan_lib.course(plan_lib.read(path))


def targets(folder: pathlib.Path) -> Mapping[str, Target]:
  """Returns all parsers by the name of what they read.

  Args:
    folder: in which files are written to be read.
  """
  motions = library.resolve('pi3')
  modes = {'modes': [mode_files.motion_to_dict(motion) for motion in motions]}
  plan = {
    'plan': ['idle', 'launch', 'launch', 'idle'],
    'knots': 4,
    'dt': 0.3,
    'arena': 'gap',
    'sizes': {'width': 0.3},
    'seed': 2,
    'pushes': [{'time': 0.6, 'velocity': [0.5, 0, -0.1]}],
  }
  as_json = lambda value: json.dumps(value).encode()
  one = as_json(modes['modes'][0])
  target = lambda name, read, seeds, error, share: Target(
    functools.partial(_written, folder / name, read), seeds, (error,), share
  )
  return {
    'mode file, YAML': target(
      'modes.yaml',
      mode_files.load,
      [_MODE.encode()],
      mode_files.ModeFileError,
      0.2,
    ),
    'mode file, JSON': target(
      'modes.json', mode_files.load, [one], mode_files.ModeFileError, 0.05
    ),
    'plan file': target(
      'plan.json', _read_plan, [as_json(plan)], ValueError, 0.65
    ),
    'codebook.json': target(
      codebook.FILE,
      codebook.load,
      [mode_set.one_hot(motions).codebook.to_json().encode()],
      ValueError,
      0.1,
    ),
  }
