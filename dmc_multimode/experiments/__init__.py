"""Trainings: configuration, construction and folder of a run.

policy = experiments.train('runs/mine', modes='pi2', steps=10_000_000)
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.experiments.config import RunConfig as RunConfig
  from dmc_multimode.experiments.run_folder import RunFolder as RunFolder
  from dmc_multimode.experiments.setup import build as build
  from dmc_multimode.experiments.setup import Run as Run
  from dmc_multimode.experiments.sweeping import sweep as sweep
  from dmc_multimode.experiments.training import train as train

_HOMES = {
  'Run': 'setup',
  'RunConfig': 'config',
  'RunFolder': 'run_folder',
  'build': 'setup',
  'sweep': 'sweeping',
  'train': 'training',
}
__all__ = [
  'Run',
  'RunConfig',
  'RunFolder',
  'build',
  'sweep',
  'train',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
