"""Runs the tests with the newest and the lowest versions that setup.cfg allows.

    pip install nox && nox -s newest lowest -- tests/suite

Each session is a fresh environment. `newest` has what pip finds within the
bounds of setup.cfg, `lowest` every lower bound, `lowest_core` those of mujoco,
dm-control and numpy with the newest of the rest. torch is what the variable
TORCH names, as for make, as a bare `torch` brings gigabytes of CUDA. Arguments
go to pytest; by default all tests run that need no extra.
"""

import configparser
import os
import pathlib
from typing import Collection

import nox
from packaging import requirements

_CORE = ('mujoco', 'dm-control', 'numpy')
_TESTS = (
  *('tests/agents', 'tests/arenas', 'tests/modes', 'tests/planner'),
  *('tests/pretrained', 'tests/suite', 'tests/utils'),
)
_TORCH = os.environ.get('TORCH', 'torch==2.13.0')

nox.options.sessions = ['newest', 'lowest']


def _required() -> dict[str, requirements.Requirement]:
  """Returns what setup.cfg requires but torch, by name."""
  parser = configparser.ConfigParser()
  parser.read(pathlib.Path(__file__).parent / 'setup.cfg', encoding='utf-8')
  lines = parser['options']['install_requires'].split()
  found = map(requirements.Requirement, lines)
  return {one.name: one for one in found if one.name != 'torch'}


def _lowest(requirement: requirements.Requirement) -> str:
  """Returns the requirement at its lower bound."""
  (bound,) = (s for s in requirement.specifier if s.operator == '>=')
  return f'{requirement.name}=={bound.version}'


def _test(session: nox.Session, low: Collection[str] = ()) -> None:
  """Installs, with the packages `low` at their lower bounds, and tests."""
  session.install(*_TORCH.split(), 'numpy')
  session.install(
    *(_lowest(r) if name in low else str(r) for name, r in _required().items()),
    *('hypothesis>=6.100', 'pytest>=8'),
  )
  session.run('python', '-m', 'pip', 'list')
  tests = session.posargs or _TESTS
  session.run('python', '-m', 'pytest', '-q', '-p', 'no:cacheprovider', *tests)


@nox.session
def newest(session: nox.Session) -> None:
  """Tests with the newest versions."""
  _test(session)


@nox.session
def lowest(session: nox.Session) -> None:
  """Tests with every lower bound."""
  _test(session, _required())


@nox.session
def lowest_core(session: nox.Session) -> None:
  """Tests with the lowest simulator and numpy, and the newest of the rest."""
  _test(session, _CORE)
