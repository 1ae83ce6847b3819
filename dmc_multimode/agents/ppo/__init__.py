"""Proximal policy optimisation (Schulman et al. 2017), latent-conditioned."""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'ActorCritic': 'networks',
  'BatchedActor': 'acting',
  'FeedForwardActor': 'acting',
  'PPOBuilder': 'builder',
  'PPOConfig': 'config',
  'PPOLearner': 'learning',
  'ReferencePolicy': 'kickstarting',
  'Rollouts': 'rollouts',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
