"""Reinforcement learning: training loop, loggers, checkpoints, and PPO."""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.agents.checkpointing import Checkpointer as Checkpointer
  from dmc_multimode.agents.core import BatchedEnvironment as BatchedEnvironment
  from dmc_multimode.agents.core import (
    EnvironmentDescription as EnvironmentDescription,
  )
  from dmc_multimode.agents.core import Policy as Policy
  from dmc_multimode.agents.core import (
    TrainingEnvironment as TrainingEnvironment,
  )
  from dmc_multimode.agents.distributed import Communicator as Communicator
  from dmc_multimode.agents.loggers import Logger as Logger
  from dmc_multimode.agents.runner import TrainingConfig as TrainingConfig
  from dmc_multimode.agents.runner import TrainingLoop as TrainingLoop

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
__all__ = [
  'BatchedEnvironment',
  'Checkpointer',
  'Communicator',
  'EnvironmentDescription',
  'Logger',
  'Policy',
  'TrainingConfig',
  'TrainingEnvironment',
  'TrainingLoop',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
