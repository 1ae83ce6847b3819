"""Trained policies that ship with the package, and loading any policy.

from dmc_multimode import pretrained
pretrained.names()
policy = pretrained.load('quickstart')
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.pretrained.folder import names as names
  from dmc_multimode.pretrained.policy import load as load
  from dmc_multimode.pretrained.policy import Policy as Policy

_HOMES = {'Policy': 'policy', 'load': 'policy', 'names': 'folder'}
__all__ = ['Policy', 'load', 'names']


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
