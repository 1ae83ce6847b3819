"""Planning over modes (Krishna and Nguyen, Sec. II-E): when to command which.

One call finds a plan, and its file holds it:

    result = planner.solve('pi2', arena='gap', seed=0)
    result.save('plan.json')
    planner.PlanFile.read('plan.json').plan.modes
"""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'BeamConfig': 'beam_search',
  'Course': 'plan',
  'ModePlan': 'plan',
  'PlanFile': 'plan',
  'PlanResult': 'plan',
  'Push': 'pushes',
  'QLearningConfig': 'q_learning',
  'ReachingProblem': 'problem',
  'Solver': 'solver',
  'solve': 'replanning',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
