"""Trainings: what decides a run, how it is built, run and found again.

policy = experiments.train('runs/mine', modes='pi2', steps=10_000_000)
"""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'Run': 'setup',
  'RunConfig': 'config',
  'RunFolder': 'run_folder',
  'build': 'setup',
  'train': 'training',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
