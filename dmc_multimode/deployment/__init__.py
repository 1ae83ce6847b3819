"""Files with which robots and simulations run without this package.

deployment.write_mjcf('out', arena='gap_block')
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.deployment.mjcf_export import write as write_mjcf

_HOMES = {'write_mjcf': 'mjcf_export:write'}
__all__ = ['write_mjcf']


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
