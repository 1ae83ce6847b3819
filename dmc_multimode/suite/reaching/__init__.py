"""Reaching a place by mode commands (Krishna and Nguyen, Sec. II-E)."""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.suite.reaching.environment import (
    ReachingEnvironment as ReachingEnvironment,
  )
  from dmc_multimode.suite.reaching.problem import Policy as Policy
  from dmc_multimode.suite.reaching.problem import PROBLEMS as PROBLEMS
  from dmc_multimode.suite.reaching.problem import (
    ReachingConfig as ReachingConfig,
  )
  from dmc_multimode.suite.reaching.problem import TRACKS as TRACKS

_HOMES = {
  'Policy': 'problem',
  'PROBLEMS': 'problem',
  'ReachingConfig': 'problem',
  'ReachingEnvironment': 'environment',
  'TRACKS': 'problem',
}
__all__ = [
  'PROBLEMS',
  'Policy',
  'ReachingConfig',
  'ReachingEnvironment',
  'TRACKS',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
