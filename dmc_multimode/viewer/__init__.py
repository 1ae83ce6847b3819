"""Views of policies: videos, a browser page, dm_control's viewer.

One call records a schedule:

    viewer.record('pi2', 'walk_forward:2,launch:2', out='video.mp4')
"""

from typing import Any, TYPE_CHECKING

from dmc_multimode.utils import lazy

if TYPE_CHECKING:
  from dmc_multimode.utils.gl import choose_backend as choose_backend
  from dmc_multimode.viewer.camera import Camera as Camera
  from dmc_multimode.viewer.recording import film as film
  from dmc_multimode.viewer.recording import record as record
  from dmc_multimode.viewer.recording import Recording as Recording
  from dmc_multimode.viewer.recording import RecordingConfig as RecordingConfig
  from dmc_multimode.viewer.rollout import Rollout as Rollout
  from dmc_multimode.viewer.rollout import RolloutConfig as RolloutConfig
  from dmc_multimode.viewer.serving import view as view
  from dmc_multimode.viewer.session import LiveSession as LiveSession
  from dmc_multimode.viewer.tracing import Trace as Trace
  from dmc_multimode.viewer.tracing import trace as trace

_HOMES = {
  'Camera': 'camera',
  'LiveSession': 'session',
  'Recording': 'recording',
  'RecordingConfig': 'recording',
  'Rollout': 'rollout',
  'RolloutConfig': 'rollout',
  'Trace': 'tracing',
  'choose_backend': 'gl',
  'film': 'recording',
  'record': 'recording',
  'trace': 'tracing',
  'view': 'serving',
}
__all__ = [
  'Camera',
  'LiveSession',
  'Recording',
  'RecordingConfig',
  'Rollout',
  'RolloutConfig',
  'Trace',
  'choose_backend',
  'film',
  'record',
  'trace',
  'view',
]


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
