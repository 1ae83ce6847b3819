r"""Runs an exported policy in plain MuJoCo: nothing here is of dmc_multimode.

  python -m dmc_multimode.bin.export --policy=pi2 --out=out/pi2.onnx
  python -m dmc_multimode.bin.export --format=mjcf --arena=block \
    --sizes=distance:6 --out=out
  python examples/deploy_mujoco.py out/pi2.onnx out/mini_biped_block.xml

For 20 s the robot walks, leaps, stands, walks up to the block and launches
itself onto it. A third argument delays actions, seconds. See docs/DEPLOY.md.
"""

import pathlib
import sys

import mujoco
import numpy as np


def main(policy: str, scene: str, delay: str = '0') -> int:
  """Runs a policy in a scene; returns 0 if the robot never falls."""
  sys.path.insert(0, str(pathlib.Path(policy).parent))
  import controller  # type: ignore[import-not-found]

  robot = controller.Controller(policy)
  model = mujoco.MjModel.from_xml_path(scene)
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key('stand').id)
  servos = [model.actuator(joint).id for joint in robot.about['joints']]
  boxes = [i for i in range(model.ngeom) if 'segment' in model.geom(i).name]
  starts = (model.geom_pos - model.geom_size)[boxes, 0]
  tops = (model.geom_pos + model.geom_size)[boxes, 2]
  run_up = starts[-1] - robot.modes['launch']['step']['edge']
  # Each mode for so many seconds, or to such an x, metres.
  schedule = [('walk_forward', 4.2, np.inf), ('leap_forward', 3.6, np.inf)]
  schedule += [('idle', 1.8, np.inf), ('walk_forward', np.inf, run_up)]
  schedule += [('launch', 2.0, np.inf), ('idle', np.inf, np.inf)]
  period, began = robot.about['control_timestep'], 0.0
  steps, late = (round(t / model.opt.timestep) for t in (period, float(delay)))
  for time in np.arange(0.0, 20.0, period):
    _, seconds, place = schedule[0]
    if time - began > seconds - period / 2 or data.qpos[0] > place:
      began, (_, *schedule) = time, schedule
    robot.command(schedule[0][0], data.qpos[:2], data.qvel[:2])
    ground = tops[starts <= data.qpos[0]][-1]
    seen = controller.sense(data.qpos, data.qvel, ground)
    if began == time or not seen['height'] > robot.about['fallen_below']:
      print(f'{time:5.2f} s: {robot.mode["name"]} at x = {data.qpos[0]:.2f} m')
    if not seen['height'] > robot.about['fallen_below']:
      return 1
    action = robot.act(data.qpos[:2], seen)
    mujoco.mj_step(model, data, late)
    data.ctrl[servos] = action
    mujoco.mj_step(model, data, steps - late)
    robot.advance()
  print(f'20 s: stands at x = {data.qpos[0]:.2f} m, z = {data.qpos[2]:.2f} m')
  return 0


if __name__ == '__main__':
  sys.exit(main(*sys.argv[1:]))
