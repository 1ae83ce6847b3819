"""Controller of an exported policy; `export` writes this file beside the model.

It knows numpy, onnxruntime and the exported JSON, and nothing of dmc_multimode,
so that it may be copied to a robot.
"""

import json
import os
import pathlib
from typing import Any

import numpy as np
import onnxruntime

_SCANNED = 0.09 * np.arange(16) - 0.18  # Metres ahead of the trunk.
_SCAN_AGE = 0.03  # Seconds from a scan to its use.
_LEDGE = 0.02  # Metres: smaller steps of the ground are none.


class Controller:
  """Observations in, joint targets out; modes and clock inside.

  Attributes:
    about: content of the JSON.
    modes: the modes in it, by name.
    mode: the one that runs.
    phase: of its clock, in [0, 1].
    heading: the commanded one, radians; modes that turn change it.
  """

  def __init__(self, path: str | os.PathLike[str]):
    """Loads the .onnx file and the .json beside it.

    A mode that stands runs at first, or the first one if there is none; it
    begins where the robot is at the first `act` or `command`.
    """
    path = pathlib.Path(path)
    self.about = json.loads(path.with_suffix('.json').read_text())
    self.modes = {mode['name']: mode for mode in self.about['modes']}
    rests = [m for m in self.about['modes'] if m['kind'] == 'steady']
    self.mode, self.phase = (rests or self.about['modes'])[0], 0.0
    self.heading = 0.0
    self._anchor, self._pace = np.full(2, np.nan), 1.0  # Not begun yet.
    self._action: np.ndarray | None = None
    self._model = onnxruntime.InferenceSession(path)

  def command(self, name: str, place: np.ndarray, speed: np.ndarray) -> None:
    """Starts a mode, unless it runs.

    Args:
      name: of the mode.
      place: x and y of the trunk by odometry, metres, [2].
      speed: their rates, m/s, [2].
    """
    self._begin(place)
    if self.mode['name'] == name:
      return
    self.heading += self._yaw()
    self.mode, self.phase, self._anchor = self.modes[name], 0.0, place.copy()
    way = self._way()
    own = speed @ way * self.mode['duration'] / max(way @ way, 1e-9)
    self._pace = float(np.clip(own, 0, 1)) if self.mode['ramps'] else 1.0

  def _begin(self, place: np.ndarray) -> None:
    """Starts the first mode at a place, unless it has been started."""
    if np.isnan(self._anchor).any():
      self._anchor = np.array(place, dtype=float)

  def _keys(self, field: str) -> np.ndarray:
    """Returns a field of the mode's keyframes, [K, ...]."""
    return np.array([key[field] for key in self.mode['keyframes']])

  def _way(self) -> np.ndarray:
    """Returns the way of a cycle, x and y in the world, metres, [2]."""
    frames = self._keys('position')[:, :2]
    return _turn(frames[-1] - frames[0], self.heading)

  def _yaw(self) -> float:
    """Returns the yaw of the keyframes at the phase, radians."""
    phases, frames = self._keys('phase'), self._keys('orientation')
    passed = int(np.searchsorted(phases, self.phase, 'right'))
    last = min(passed, len(phases) - 1) - 1
    before, after = frames[last], frames[last + 1]
    after = after if before @ after >= 0 else -after
    share = (self.phase - phases[last]) / (phases[last + 1] - phases[last])
    angle = np.arccos(min(before @ after, 1.0))
    if angle > 1e-9:  # Spherical interpolation.
      before = before * np.sin((1 - share) * angle)
      before = before + after * np.sin(share * angle)
    w, x, y, z = before / np.linalg.norm(before)
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))

  def reference(self) -> np.ndarray:
    """Returns x and y of where the trunk should be, metres, [2]."""
    phases, frames = self._keys('phase'), self._keys('position')[:, :2]
    local = [np.interp(self.phase, phases, axis) for axis in frames.T]
    slow = self._pace + (1 - self._pace) * self.phase / 2
    return self._anchor + slow * _turn(np.array(local), self.heading)

  def steps(self, seconds: float) -> int:
    """Converts a duration to control steps; rounds gaits up to whole cycles.

    There the robot is on the ground, where another mode may begin.
    """
    period, cycle = self.about['control_timestep'], self.mode['duration']
    if self.mode['kind'] == 'periodic':
      seconds = cycle * np.ceil(seconds / cycle - 1e-6)
    return round(seconds / period)

  def advance(self) -> None:
    """Advances the clock by a control step."""
    self.phase += self.about['control_timestep'] / self.mode['duration']
    if self.phase >= 1 and self.mode['kind'] == 'transient':
      self.phase = 1.0
    elif self.phase >= 1:
      if self.mode['kind'] == 'periodic':
        self._anchor += self._way() * (1 + self._pace) / 2
        self.heading += self.mode['turn']
      self.phase, self._pace = self.phase - 1, 1.0

  def look(
    self, track: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
  ) -> tuple[float, float, np.ndarray]:
    """Returns what a map tells of the ground.

    Args:
      track: where pieces of the ground start and end along x, and their tops,
        metres, [3, N], in the order of the starts.
      qpos, qvel: as for `sense`.

    Returns:
      The support under the trunk, metres, on the first piece if the trunk is
      before it; how far along x the next piece starts that is more than 2 cm
      higher or lower, infinity for none; and a scan for `act`, [16].
    """
    starts, ends, tops = track
    support = tops[max(np.searchsorted(starts, qpos[0], 'right') - 1, 0)]
    is_ledge = (starts > qpos[0]) & (np.abs(tops - support) > _LEDGE)
    ledge = (starts[is_ledge] - qpos[0]).min(initial=np.inf)
    ahead = np.cos(self.heading) * _SCANNED
    at = (qpos[0] - _SCAN_AGE * qvel[0] + ahead)[:, None]
    heights = np.where((starts <= at) & (at <= ends), tops, -np.inf).max(axis=1)
    return float(support), float(ledge), heights - support

  def act(
    self,
    place: np.ndarray,
    sensed: dict[str, np.ndarray],
    scan: np.ndarray | None = None,
  ) -> np.ndarray:
    """Returns joint targets, radians, [J].

    Args:
      place: x and y of the trunk by odometry, metres, [2].
      sensed: result of `sense`, or the same parts of a robot's sensors; its
        orientation is that in the world.
      scan: heights of the ground over the support, as they were 0.03 s ago,
        metres, for policies that observe a `ground_scan`: [16], at the places
        that its formula says, minus infinity for no ground.

    Raises:
      ValueError: the policy observes a scan, and there is none, or of another
        length.
    """
    sizes = {part['name']: part['size'] for part in self.about['observation']}
    if 'ground_scan' in sizes:
      if scan is None or np.shape(scan) != (sizes['ground_scan'],):
        raise ValueError(
          'This policy observes the ground: give act(..., scan=...) the '
          f'{sizes["ground_scan"]} heights of ground_scan.'
        )
      sensed = {**sensed, 'ground_scan': np.clip(scan, -0.6, 0.6)}
    self._begin(place)
    if self._action is None:
      self._action = sensed['joints_pos']
    angle = 2 * np.pi * self.phase
    parts = {
      'clock': [np.sin(angle), np.cos(angle)],
      'command': self.mode['latent'],
      'displacement': np.clip(
        _turn(place - self.reference(), -self.heading), -0.5, 0.5
      ),
      'clock_rate': [1.0],
      'previous_action': self._action,
      **sensed,
      'orientation': _in_heading(sensed['orientation'], self.heading),
    }
    seen = np.concatenate([parts[name] for name in sizes])
    seen = seen[None].astype(np.float32)
    (actions,) = self._model.run(None, {'observation': seen})
    bounds = self.about['action']
    self._action = np.clip(actions[0], bounds['minimum'], bounds['maximum'])
    return self._action


def _turn(vector: np.ndarray, angle: float) -> np.ndarray:
  """Turns x and y [2] by an angle, radians."""
  c, s = np.cos(angle), np.sin(angle)
  return np.array(
    [c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]]
  )


def _in_heading(orientation: np.ndarray, heading: float) -> np.ndarray:
  """Returns an orientation [4] relative to a heading, with w >= 0."""
  c, s = np.cos(heading / 2), np.sin(heading / 2)
  w, x, y, z = orientation
  turned = np.array(
    [c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w]
  )
  return turned if turned[0] >= 0 else -turned


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


def track_of(model: Any) -> np.ndarray:
  """Returns the map for `Controller.look` of an exported model, [3, N].

  Args:
    model: MjModel with the boxes `segment_0`, `segment_1`, ...
  """
  names = [model.geom(i).name for i in range(model.ngeom)]
  boxes = [name.rpartition('/')[2].startswith('segment_') for name in names]
  middle, half = model.geom_pos[boxes].T, model.geom_size[boxes].T
  return np.stack([(middle - half)[0], *(middle + half)[[0, 2]]])
