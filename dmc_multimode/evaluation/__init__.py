"""Deterministic evaluation: scores, gait metrics, figures and reports.

One call computes all scores:

    values = evaluation.evaluate('pi2', seed=0)
    values['mra_modes'], values['acceptance']['walk_forward']
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.evaluation.episodes import Episodes as Episodes
  from dmc_multimode.evaluation.episodes import run_episodes as run_episodes
  from dmc_multimode.evaluation.evaluator import Evaluator as Evaluator
  from dmc_multimode.evaluation.scores import evaluate as evaluate

_HOMES = {
  'Episodes': 'episodes',
  'Evaluator': 'evaluator',
  'evaluate': 'scores',
  'run_episodes': 'episodes',
}
__all__ = [
  'Episodes',
  'Evaluator',
  'evaluate',
  'run_episodes',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
