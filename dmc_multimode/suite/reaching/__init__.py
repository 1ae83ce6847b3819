"""Reaching a place by mode commands (Krishna and Nguyen, Sec. II-E)."""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'Policy': 'problem',
  'PROBLEMS': 'problem',
  'ReachingConfig': 'problem',
  'ReachingEnvironment': 'environment',
  'TRACKS': 'problem',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
