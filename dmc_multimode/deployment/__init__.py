"""Files with which robots and simulations run without this package.

deployment.write_onnx(pretrained.load('pi2'), 'out/pi2.onnx')  # and pi2.json
deployment.write_mjcf('out', arena='gap_block')
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import gl
from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.deployment.description import describe as describe
  from dmc_multimode.deployment.mjcf_export import write as write_mjcf
  from dmc_multimode.deployment.onnx_export import write as write_onnx

# Before modules of it import dm_control, which looks for a display.
gl.choose_late_without_display()

_HOMES = {
  'describe': 'description',
  'write_mjcf': 'mjcf_export:write',
  'write_onnx': 'onnx_export:write',
}
__all__ = ['describe', 'write_mjcf', 'write_onnx']


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
