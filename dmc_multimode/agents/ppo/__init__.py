"""Proximal policy optimisation (Schulman et al. 2017), latent-conditioned."""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.agents.ppo.acting import BatchedActor as BatchedActor
  from dmc_multimode.agents.ppo.acting import (
    FeedForwardActor as FeedForwardActor,
  )
  from dmc_multimode.agents.ppo.builder import PPOBuilder as PPOBuilder
  from dmc_multimode.agents.ppo.config import PPOConfig as PPOConfig
  from dmc_multimode.agents.ppo.fitting import fit as fit
  from dmc_multimode.agents.ppo.kickstarting import (
    ReferencePolicy as ReferencePolicy,
  )
  from dmc_multimode.agents.ppo.learning import PPOLearner as PPOLearner
  from dmc_multimode.agents.ppo.networks import ActorCritic as ActorCritic
  from dmc_multimode.agents.ppo.rollouts import Rollouts as Rollouts

_HOMES = {
  'ActorCritic': 'networks',
  'BatchedActor': 'acting',
  'FeedForwardActor': 'acting',
  'PPOBuilder': 'builder',
  'PPOConfig': 'config',
  'PPOLearner': 'learning',
  'ReferencePolicy': 'kickstarting',
  'Rollouts': 'rollouts',
  'fit': 'fitting',
}
__all__ = [
  'ActorCritic',
  'BatchedActor',
  'FeedForwardActor',
  'PPOBuilder',
  'PPOConfig',
  'PPOLearner',
  'ReferencePolicy',
  'Rollouts',
  'fit',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
