"""Planning over modes (Krishna and Nguyen, Sec. II-E).

One call finds a plan; `solve` is in `replanning`, an open loop being the case
of replanning never:

    result = planner.solve('pi2', arena='gap', seed=0)
    result.save('plan.json')
    planner.PlanFile.read('plan.json').plan.modes
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.planner.beam_search import BeamConfig as BeamConfig
  from dmc_multimode.planner.guided_search import GuidedConfig as GuidedConfig
  from dmc_multimode.planner.plan import Course as Course
  from dmc_multimode.planner.plan import ModePlan as ModePlan
  from dmc_multimode.planner.plan import PlanFile as PlanFile
  from dmc_multimode.planner.plan import PlanResult as PlanResult
  from dmc_multimode.planner.problem import ReachingProblem as ReachingProblem
  from dmc_multimode.planner.pushes import Push as Push
  from dmc_multimode.planner.q_learning import (
    QLearningConfig as QLearningConfig,
  )
  from dmc_multimode.planner.replanning import solve as solve
  from dmc_multimode.planner.solver import Solver as Solver

_HOMES = {
  'BeamConfig': 'beam_search',
  'Course': 'plan',
  'GuidedConfig': 'guided_search',
  'ModePlan': 'plan',
  'PlanFile': 'plan',
  'PlanResult': 'plan',
  'Push': 'pushes',
  'QLearningConfig': 'q_learning',
  'ReachingProblem': 'problem',
  'Solver': 'solver',
  'solve': 'replanning',
}
__all__ = [
  'BeamConfig',
  'Course',
  'GuidedConfig',
  'ModePlan',
  'PlanFile',
  'PlanResult',
  'Push',
  'QLearningConfig',
  'ReachingProblem',
  'Solver',
  'solve',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
