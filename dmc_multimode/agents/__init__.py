"""Reinforcement learning: training loop, loggers, checkpoints, and PPO."""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'BatchedEnvironment': 'core',
  'Checkpointer': 'checkpointing',
  'Communicator': 'distributed',
  'EnvironmentDescription': 'core',
  'Logger': 'loggers',
  'Policy': 'core',
  'TrainingConfig': 'runner',
  'TrainingEnvironment': 'core',
  'TrainingLoop': 'runner',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
