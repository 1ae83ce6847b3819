r"""Checks a robot's declaration: compiles, mirrors, stands and drops it.

  python -m dmc_multimode.bin.check_robot --robot=my_robot.yaml \
    --picture=my_robot.png

draws its stance, with the feet and the axes of their sites and the trunk, and
prints all that follows from the declaration and its model. It warns of servos
that are unlike those of the robots that come along, and ends with exit code 2
and one line if something is broken. No policy balances the robot here: one that
falls after a while is not broken. See docs/ROBOTS.md.
"""

import sys
from typing import Iterator, Sequence, TYPE_CHECKING

import numpy as np

from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import files
from dmc_multimode.viewer import gl

if TYPE_CHECKING:
  from dmc_multimode.walkers import robot as robot_lib
  from dmc_multimode.walkers import trial

_ROBOT = config_flags.define_path(
  'robot',
  None,
  'YAML or JSON file of the robot, or the name of one that comes along.',
  required=True,
)
_PICTURE = config_flags.define_path(
  'picture', None, 'PNG file to write, of the stance; none by default.'
)

# Of the robots that come along, and a little more: limit / stiffness, radians,
# and damping / stiffness, seconds.
_SCALES = (0.4, 1.2)
_DAMPINGS = (1 / 60, 1 / 8)
_SLACK = 1e-6  # Of these: some robots are at their ends.


def rows(robot: 'robot_lib.Robot') -> Iterator[tuple[str, str]]:
  """Yields names and values of a robot, as text with units."""
  derived = robot.derived
  yield 'robot', f'{robot.name}, hash {robot.digest[:12]}'
  yield 'mass', f'{derived.mass:.3g} kg'
  yield (
    'standing height',
    f"{derived.stand_height:g} m, {robot.size:.3g} of the mini biped's",
  )
  yield 'leg length', f'{derived.leg_length:g} m'
  yield 'stance width', f'{derived.stance_width:g} m'
  yield 'left and right differ', f'{derived.mirror.asymmetry:.1g}'
  yield 'feet', ', '.join(robot.declaration.feet)
  yield (
    'soles below the sites',
    ', '.join(f'{depth:g}' for depth in derived.sole_depth) + ' m',
  )
  yield 'control period', f'{robot.declaration.control_timestep:g} s'


def joint_rows(robot: 'robot_lib.Robot') -> Iterator[tuple[str, ...]]:
  """Yields a head, and a row for each joint, of text; radians, Nm and s."""
  derived, mirror = robot.derived, robot.derived.mirror
  yield (
    *('joint', 'range', 'pose', 'action', 'standing', 'stiffness', 'limit'),
    *('scale', 'damping', 'mirror'),
  )
  span = lambda bounds: f'{bounds[0]:+.2f} {bounds[1]:+.2f}'
  for i, name in enumerate(robot.joints):
    sign = '-' if mirror.joint_signs[i] < 0 else ''
    yield (
      name,
      span(derived.joint_limits[:, i]),
      f'{derived.pose[i]:+.2f}',
      span(derived.action_bounds[:, i]),
      f'{derived.standing_action[i]:+.2f}',
      f'{derived.stiffness[i]:g}',
      f'{derived.stiffness[i] * derived.action_scale[i]:.3g}',
      f'{derived.action_scale[i]:.2f}',
      f'{derived.damping[i]:.3g}',
      sign + robot.joints[mirror.joint_order[i]],
    )


def unusual(robot: 'robot_lib.Robot') -> Iterator[str]:
  """Yields lines on servos unlike those of the robots that come along."""
  derived = robot.derived
  for what, values, (low, high) in (
    ('limit / stiffness', derived.action_scale, _SCALES),
    ('damping / stiffness', derived.damping / derived.stiffness, _DAMPINGS),
  ):
    odd = (values < low - _SLACK) | (values > high + _SLACK)
    if odd.any():
      found = (
        f'{values[i]:.2g} of {robot.joints[i]}' for i in np.where(odd)[0]
      )
      yield (
        f'warning: {what} is {low:.2g} to {high:.3g} of robots that come '
        f'along, and here {", ".join(found)}'
      )


def _show(table: Sequence[Sequence[str]]) -> None:
  """Prints rows in columns."""
  widths = [max(map(len, column)) for column in zip(*table, strict=True)]
  for row in table:
    cells = zip(row, widths, strict=True)
    print('  '.join(cell.ljust(width) for cell, width in cells).rstrip())


def _outcome(found: 'trial.Trial') -> str:
  """Returns the outcome of a trial in one line."""
  load = f'at most {found.load:.1f} times its weight'
  if not found.stands:
    return f'falls after {found.seconds:.1f} s, {load}'
  return (
    f'stands for {found.seconds:g} s: {1000 * found.sunk:.0f} mm lower, tilted '
    f'by {found.tilt:.2f} rad, {sum(found.feet)} of {len(found.feet)} feet '
    f'down, {load}'
  )


def main(argv: Sequence[str]) -> None:
  """Checks the robot; `argv` holds no flags."""
  del argv
  if not _ROBOT.value:
    raise ValueError('--robot must name a file.')
  if _PICTURE.value:
    gl.choose_backend()
    if not _PICTURE.value.lower().endswith('.png'):
      raise ValueError('--picture must end in .png.')
  # Late, as these import dm_control.
  from dmc_multimode.viewer import stance
  from dmc_multimode.walkers import robot as robot_lib
  from dmc_multimode.walkers import trial

  out = files.output_file('picture', _PICTURE.value)
  robot = robot_lib.load(_ROBOT.value)
  _show(list(rows(robot)))
  print()
  _show(list(joint_rows(robot)))
  print(
    'scale: limit / stiffness, radians from joint to target that take the '
    "whole torque; damping: the servo's and the joint's own"
  )
  for line in unusual(robot):
    print(line, file=sys.stderr)
  model = trial.on_ground(robot)
  if out:
    stance.write(robot, model, out)
  print()
  height = trial.DROP * robot.stand_height
  stood = trial.drop(robot, model=model)
  if stood.fault:
    raise ValueError(f'{_ROBOT.value}: the robot cannot stand: {stood.fault}.')
  dropped = trial.drop(robot, height, model=model)
  if dropped.fault:
    raise ValueError(
      f'{_ROBOT.value}: dropped by {1000 * height:.0f} mm, the robot fails: '
      f'{dropped.fault}.'
    )
  _show(
    [
      ('standing action', _outcome(stood)),
      (f'dropped by {1000 * height:.0f} mm', _outcome(dropped)),
    ]
  )
  if not stood.stands:
    print('nothing balances it here: training has to learn to balance')


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
