r"""Runs an exported policy in plain MuJoCo: nothing here is of dmc_multimode.

  python -m dmc_multimode.bin.export --policy=pi2 --out=out/pi2.onnx
  python -m dmc_multimode.bin.export --format=mjcf --arena=block \
    --sizes=distance:6 --out=out
  python examples/deploy_mujoco.py out/pi2.onnx out/mini_biped_block.xml

For 20 s the robot walks, leaps, stands, walks up to the block, launches itself
onto it and stands there. A third argument delays actions by so many seconds.
docs/DEPLOY.md has the formulas; modes that turn would also need the heading,
which is 0 here, and policies that scan the ground a scan.
"""

import json
import pathlib
import sys

import mujoco
import numpy as np
import onnxruntime

SECONDS = 20.0


class Controller:
  """Observations in, joint targets out; modes and clock inside."""

  def __init__(self, path: pathlib.Path):
    self.about = json.loads(path.with_suffix('.json').read_text())
    self.modes = {mode['name']: mode for mode in self.about['modes']}
    self.mode, self.phase = self.modes['idle'], 0.0
    self.anchor, self.pace = np.zeros(2), 1.0
    self._action: np.ndarray | None = None
    self._model = onnxruntime.InferenceSession(path)

  def command(self, name: str, place: np.ndarray, speed: np.ndarray) -> None:
    """Starts a mode, unless it runs, where the trunk is; x and y of both."""
    if self.mode['name'] == name:
      return
    self.mode, self.phase, self.anchor = self.modes[name], 0.0, place.copy()
    way = self._frames()[-1] - self._frames()[0]
    own = speed @ way * self.mode['duration'] / max(way @ way, 1e-9)
    self.pace = float(np.clip(own, 0, 1)) if self.mode['ramps'] else 1.0

  def _frames(self) -> np.ndarray:
    """Returns x and y of the mode's keyframes, [K, 2]."""
    return np.array([key['position'][:2] for key in self.mode['keyframes']])

  def reference(self) -> np.ndarray:
    """Returns x and y of where the trunk should be."""
    phases = [key['phase'] for key in self.mode['keyframes']]
    local = [np.interp(self.phase, phases, axis) for axis in self._frames().T]
    slow = self.pace + (1 - self.pace) * self.phase / 2
    return self.anchor + slow * np.array(local)

  def advance(self) -> None:
    """Advances the clock by a control step."""
    self.phase += self.about['control_timestep'] / self.mode['duration']
    if self.phase >= 1 and self.mode['kind'] == 'transient':
      self.phase = 1.0
    elif self.phase >= 1:
      way = self._frames()[-1] - self._frames()[0]
      if self.mode['kind'] == 'periodic':
        self.anchor += way * (1 + self.pace) / 2
      self.phase, self.pace = self.phase - 1, 1.0

  def act(self, place: np.ndarray, sensed: dict[str, np.ndarray]) -> np.ndarray:
    """Returns joint targets; x and y of the trunk are those of odometry."""
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


def sense(data: mujoco.MjData, support: float) -> dict[str, np.ndarray]:
  """Returns what sensors and odometry of a robot would, by parts."""
  trunk, matrix = data.qpos[3:7], np.zeros(9)
  mujoco.mju_quat2Mat(matrix, trunk)
  return {
    'height': data.qpos[2:3] - support,
    'orientation': trunk if trunk[0] >= 0 else -trunk,
    'joints_pos': data.qpos[7:],
    'velocity': matrix.reshape(3, 3).T @ data.qvel[:3],
    'angular_velocity': data.qvel[3:6],
    'joints_vel': data.qvel[6:],
  }


def main(policy: str, scene: str, delay: str = '0') -> int:
  """Runs a policy in a scene; returns 0 if the robot never falls."""
  controller = Controller(pathlib.Path(policy))
  model = mujoco.MjModel.from_xml_path(scene)
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key('stand').id)
  servos = [model.actuator(joint).id for joint in controller.about['joints']]
  boxes = [i for i in range(model.ngeom) if 'segment' in model.geom(i).name]
  starts = (model.geom_pos - model.geom_size)[boxes, 0]
  tops = (model.geom_pos + model.geom_size)[boxes, 2]
  run_up = starts[-1] - controller.modes['launch']['step']['edge']
  schedule = [  # Each mode for so many seconds, or to such an x.
    ('walk_forward', 4.2, np.inf),
    ('leap_forward', 3.6, np.inf),
    ('idle', 1.8, np.inf),
    ('walk_forward', np.inf, run_up),
    ('launch', 2.0, np.inf),
    ('idle', np.inf, np.inf),
  ]
  period, began = controller.about['control_timestep'], 0.0
  steps, late = (round(t / model.opt.timestep) for t in (period, float(delay)))
  for time in np.arange(0.0, SECONDS, period):
    _, seconds, place = schedule[0]
    if time - began > seconds - period / 2 or data.qpos[0] > place:
      began, schedule = time, schedule[1:]
    trunk = data.qpos[:2]
    controller.command(schedule[0][0], trunk, data.qvel[:2])
    support = tops[starts <= data.qpos[0]][-1]
    action = controller.act(trunk, sense(data, support))
    mujoco.mj_step(model, data, late)
    data.ctrl[servos] = action
    mujoco.mj_step(model, data, steps - late)
    controller.advance()
    x, z = data.qpos[0], data.qpos[2] - tops[starts <= data.qpos[0]][-1]
    if began == time or not z > controller.about['fallen_below']:
      print(f'{time:5.2f} s: {controller.mode["name"]} at x = {x:.2f} m')
    if not z > controller.about['fallen_below']:
      return 1
  print(f'{SECONDS:.0f} s: stands at x = {x:.2f} m, {z:.2f} m over the ground')
  return 0


if __name__ == '__main__':
  sys.exit(main(*sys.argv[1:]))
