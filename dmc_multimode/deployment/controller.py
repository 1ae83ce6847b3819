"""Controller of an exported policy; `export` writes this file beside the model.

It knows numpy, onnxruntime and the exported JSON, and nothing of dmc_multimode,
so that it may be copied to a robot. Modes that turn would also need the
heading, which is 0 here, and policies that scan the ground a scan.
"""

import json
import os
import pathlib

import numpy as np
import onnxruntime


class Controller:
  """Observations in, joint targets out; modes and clock inside.

  Attributes:
    about: content of the JSON.
    modes: the modes in it, by name.
    mode: the one that runs.
    phase: of its clock, in [0, 1].
  """

  def __init__(self, path: str | os.PathLike[str]):
    """Loads the .onnx file and the .json beside it; idle runs."""
    path = pathlib.Path(path)
    self.about = json.loads(path.with_suffix('.json').read_text())
    self.modes = {mode['name']: mode for mode in self.about['modes']}
    self.mode, self.phase = self.modes['idle'], 0.0
    self._anchor, self._pace = np.zeros(2), 1.0
    self._action: np.ndarray | None = None
    self._model = onnxruntime.InferenceSession(path)

  def command(self, name: str, place: np.ndarray, speed: np.ndarray) -> None:
    """Starts a mode, unless it runs.

    Args:
      name: of the mode.
      place: x and y of the trunk by odometry, metres, [2].
      speed: their rates, m/s, [2].
    """
    if self.mode['name'] == name:
      return
    self.mode, self.phase, self._anchor = self.modes[name], 0.0, place.copy()
    way = self._frames()[-1] - self._frames()[0]
    own = speed @ way * self.mode['duration'] / max(way @ way, 1e-9)
    self._pace = float(np.clip(own, 0, 1)) if self.mode['ramps'] else 1.0

  def _frames(self) -> np.ndarray:
    """Returns x and y of the mode's keyframes, metres, [K, 2]."""
    return np.array([key['position'][:2] for key in self.mode['keyframes']])

  def reference(self) -> np.ndarray:
    """Returns x and y of where the trunk should be, metres, [2]."""
    phases = [key['phase'] for key in self.mode['keyframes']]
    local = [np.interp(self.phase, phases, axis) for axis in self._frames().T]
    slow = self._pace + (1 - self._pace) * self.phase / 2
    return self._anchor + slow * np.array(local)

  def advance(self) -> None:
    """Advances the clock by a control step."""
    self.phase += self.about['control_timestep'] / self.mode['duration']
    if self.phase >= 1 and self.mode['kind'] == 'transient':
      self.phase = 1.0
    elif self.phase >= 1:
      way = self._frames()[-1] - self._frames()[0]
      if self.mode['kind'] == 'periodic':
        self._anchor += way * (1 + self._pace) / 2
      self.phase, self._pace = self.phase - 1, 1.0

  def act(self, place: np.ndarray, sensed: dict[str, np.ndarray]) -> np.ndarray:
    """Returns joint targets, radians, [J].

    Args:
      place: x and y of the trunk by odometry, metres, [2].
      sensed: result of `sense`, or the same parts of a robot's sensors.
    """
    if self._action is None:
      self._action = sensed['joints_pos']
    angle = 2 * np.pi * self.phase
    parts = {
      'clock': [np.sin(angle), np.cos(angle)],
      'command': self.mode['latent'],
      'displacement': np.clip(place - self.reference(), -0.5, 0.5),
      'clock_rate': [1.0],
      'previous_action': self._action,
      **sensed,
    }
    seen = np.concatenate([parts[p['name']] for p in self.about['observation']])
    seen = seen[None].astype(np.float32)
    (actions,) = self._model.run(None, {'observation': seen})
    bounds = self.about['action']
    self._action = np.clip(actions[0], bounds['minimum'], bounds['maximum'])
    return self._action


def sense(
  qpos: np.ndarray, qvel: np.ndarray, support: float
) -> dict[str, np.ndarray]:
  """Returns what sensors and odometry of a robot would, by parts.

  Args:
    qpos: of MuJoCo: a free joint at the trunk, and the joints, [7 + J].
    qvel: likewise, [6 + J].
    support: height of the ground under the trunk, metres.
  """
  trunk, speed = qpos[3:7], qvel[:3]
  across = 2 * np.cross(trunk[1:], speed)
  # Into the trunk's frame: rotated by the conjugate.
  local = speed - trunk[0] * across + np.cross(trunk[1:], across)
  return {
    'height': qpos[2:3] - support,
    'orientation': trunk if trunk[0] >= 0 else -trunk,
    'joints_pos': qpos[7:],
    'velocity': local,
    'angular_velocity': qvel[3:6],
    'joints_vel': qvel[6:],
  }
