"""Policies to be looked at: videos, a page in the browser, a window.

One call films a schedule:

    viewer.record('pi2', 'walk_forward:2,launch:2', out='video.mp4')
"""

from typing import Any

from dmc_multimode.utils import lazy

_HOMES = {
  'Camera': 'camera',
  'LiveSession': 'session',
  'Recording': 'recording',
  'RecordingConfig': 'recording',
  'Rollout': 'rollout',
  'RolloutConfig': 'rollout',
  'choose_backend': 'gl',
  'film': 'recording',
  'record': 'recording',
  'view': 'serving',
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
  return lazy.find(__name__, _HOMES, name)
