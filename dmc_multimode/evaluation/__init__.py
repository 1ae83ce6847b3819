"""Deterministic evaluation: scores, gait metrics, figures and reports.

One call measures everything:

    values = evaluation.evaluate('pi2', seed=0)
    values['mra_modes'], values['acceptance']['walk_forward']
"""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'Episodes': 'episodes',
  'Evaluator': 'evaluator',
  'evaluate': 'scores',
  'run_episodes': 'episodes',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
