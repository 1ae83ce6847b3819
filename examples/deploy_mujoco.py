r"""Runs an exported policy in plain MuJoCo alone; see docs/DEPLOY.md.

python -m dmc_multimode.bin.export --policy=pi2 --out=out/pi2.onnx
python -m dmc_multimode.bin.export --format=mjcf --out=out
python examples/deploy_mujoco.py out/pi2.onnx out/mini_biped_flat.xml
"""

import argparse
import pathlib
import sys

import mujoco


def main(policy: str, scene: str, schedule: str = '', delay: str = '') -> None:
  """Runs a schedule, or 2 s of each mode without a ledge; delay in seconds."""
  sys.path.insert(0, str(pathlib.Path(policy).parent))
  import controller  # type: ignore[import-not-found]

  robot = controller.Controller(policy)
  level = [name for name, mode in robot.modes.items() if 'step' not in mode]
  text = schedule or ':2,'.join([*level, robot.mode['name']]) + ':2'
  parts = [part.partition(':')[::2] for part in text.split(',')]
  for name, seconds in parts:
    if name not in robot.modes or not seconds.replace('.', '', 1).isdigit():
      sys.exit(f'{name}:{seconds} is no {"|".join(robot.modes)}:SECONDS.')
  model = mujoco.MjModel.from_xml_path(scene)
  data, track = mujoco.MjData(model), controller.track_of(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key('stand').id)
  joints = [model.joint(i).name for i in model.actuator_trnid[:, 0]]
  if joints != robot.about['joints']:
    sys.exit(f'{scene} has another robot than {policy}.')
  times = robot.about['control_timestep'], float(delay or 0)
  steps, late = (round(time / model.opt.timestep) for time in times)
  if not 0 <= late <= steps:
    sys.exit(f'--delay={delay} is not from 0 to {times[0]} s.')
  for i, (name, seconds) in enumerate(parts, 1):
    robot.command(name, data.qpos[:2], data.qvel[:2])
    print(f'{data.time:5.2f} s: {name} at x = {data.qpos[0]:.2f} m')
    ledge_after = robot.modes[parts[i][0]].get('step', {}) if parts[i:] else {}
    for _ in range(robot.steps(float(seconds))):
      ground, ledge, scan = robot.look(track, data.qpos, data.qvel)
      seen = controller.sense(data.qpos, data.qvel, ground)
      if not seen['height'] > robot.about['fallen_below']:
        sys.exit(f'{data.time:5.2f} s: fell at x = {data.qpos[0]:.2f} m')
      if ledge < ledge_after.get('edge', 0):
        break
      action = robot.act(data.qpos[:2], seen, scan)
      mujoco.mj_step(model, data, late)
      data.ctrl = action
      mujoco.mj_step(model, data, steps - late)
      robot.advance()
  print(f'{data.time:5.2f} s: at x, y, z = {data.qpos[:3].round(2)} m')


if __name__ == '__main__':
  parser = argparse.ArgumentParser()
  for argument in ('policy', 'scene', '--schedule', '--delay'):
    parser.add_argument(argument, default='')
  main(**vars(parser.parse_args()))
