"""One MJCF file of robot and track, for programs that know MuJoCo alone.

Of the mini biped it is `xml/scene.xml` with the boxes of a track for its floor;
of another robot its own model with the declared servos, such boxes, and its
meshes beside it. Names are those of the robot's model; actuators are in the
order of actions; the boxes are `segment_0`, `segment_1`, ...
"""

import os
import pathlib
from typing import Any, Mapping

from dm_control import mjcf
import numpy as np

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import files
from dmc_multimode.utils import resources
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

_ROOT = 'root'  # The free joint of robots.
# Contacts of the ground of tasks.
_CONTACT: Mapping[str, Any] = {
  'contype': 0,
  'conaffinity': 1,
  'condim': 3,
  'margin': 0,
  'solref': [0.02, 1],
  'solimp': [0.9, 0.95, 0.001, 0.5, 2],
}
_PRECISION = 17  # Digits: every number is read as it was written.


def write(
  out_dir: str | os.PathLike[str],
  arena: str = 'flat',
  sizes: Mapping[str, layouts.Number] | None = None,
  seed: int = 0,
  timestep: float | None = None,
  robot: robot_lib.Robot | str | os.PathLike[str] | None = None,
) -> pathlib.Path:
  """Writes a model of a robot on a track, with the robot's meshes, if any.

  The robot stands on a free joint at the origin, facing +x. The keyframe
  `stand` has its standing pose and the controls that carry it. The physics are
  those of the task of default configuration, except that a diverged state is
  reset as everywhere in MuJoCo.

  Args:
    out_dir: folder of the file; made if it is missing.
    arena: flat, gap, plateau, block, block_down, gap_block, stairs,
      stepping_stones, slope, rough, parkour, obstacle_course or
      gaps_and_blocks.
    sizes: of the layout, metres; see its function in `layouts`.
    seed: of what the layout draws.
    timestep: of the physics, seconds; the tasks' own by default.
    robot: declared robot, or its file; the mini biped by default. Its model is
      of its author, with a licence of its own.

  Returns:
    The path of the file, `OUT_DIR/ROBOT_ARENA.xml`.

  Raises:
    OSError: a file cannot be written.
    ValueError: the arena or a size is unknown, the time step is not positive
      and finite, or the robot is invalid.
  """
  found = robot_lib.find(robot)
  root = _scene(found, arena, sizes, seed, timestep)
  path = pathlib.Path(out_dir) / f'{found.name}_{arena}.xml'
  path.parent.mkdir(parents=True, exist_ok=True)
  for name, content in root.get_assets().items():
    files.write(path.with_name(name), content)
  files.write(path, root.to_xml_string(precision=_PRECISION).encode())
  return path


def to_xml(
  arena: str = 'flat',
  sizes: Mapping[str, layouts.Number] | None = None,
  seed: int = 0,
  timestep: float | None = None,
) -> str:
  """Returns the model of the mini biped that `write` writes; see there."""
  root = _scene(robot_lib.mini_biped(), arena, sizes, seed, timestep)
  return root.to_xml_string(precision=_PRECISION)


def _scene(
  robot: robot_lib.Robot,
  arena: str,
  sizes: Mapping[str, layouts.Number] | None,
  seed: int,
  timestep: float | None,
) -> Any:
  """Returns the MJCF of a robot on a track; see `write`."""
  if timestep is None:
    timestep = task_config.ImitationConfig().physics_timestep
  if not 0 < timestep < np.inf:
    raise ValueError(f'timestep must be positive and finite, got {timestep}.')
  terrain = track.make(arena, sizes=sizes).generate(np.random.RandomState(seed))
  scene = resources.path('xml', 'scene.xml')
  root = mjcf.from_path(str(scene))
  if not robot.is_mini_biped:
    root = _with_robot(root, robot)
  root.model = f'{robot.name}_{arena}'
  root.option.timestep = timestep
  _replace_floor(root, terrain)
  return root


def _with_robot(scene: Any, robot: robot_lib.Robot) -> Any:
  """Returns a robot's MJCF with options, light and floor of a scene."""
  derived, root = robot.derived, robot_walker.RobotWalker(robot).mjcf_model
  trunk = root.find('body', robot.declaration.trunk)
  trunk.add('freejoint', name=_ROOT)
  trunk.pos = [0.0, 0.0, derived.stand_height]
  option = scene.option
  root.option.integrator, root.option.cone = option.integrator, option.cone
  for name in ('island', 'autoreset'):
    setattr(root.option.flag, name, getattr(option.flag, name))
  floor = scene.find('geom', 'floor')
  # The robot's defaults, which are those of its file, are none of the ground's.
  root.worldbody.add(
    'geom',
    name='floor',
    type='plane',
    size=[1, 1, 1],
    friction=floor.friction,
    **_CONTACT,
  )
  root.worldbody.add('light', name='sun', pos=[0, 0, 4], directional=True)
  root.keyframe.add(
    'key',
    name='stand',
    qpos=[0, 0, derived.stand_height, 1, 0, 0, 0, *derived.pose],
    ctrl=derived.standing_action,
  )
  return root


def _replace_floor(root: Any, terrain: terrain_lib.Terrain) -> None:
  """Replaces the floor by the boxes of a terrain, a batch of one."""
  floor = root.find('geom', 'floor')
  looks = {
    name: getattr(floor, name)
    for name in ('material', 'friction', *_CONTACT)
    if getattr(floor, name) is not None
  }
  floor.remove()
  used = np.isfinite(terrain.starts[0])
  centres, halves = (values[0, used] for values in terrain_lib.boxes(terrain))
  for i, (centre, half) in enumerate(zip(centres, halves, strict=True)):
    root.worldbody.add(
      'geom',
      name=f'segment_{i}',
      type='box',
      pos=centre,
      size=half,
      rgba=track.COLOURS[i % len(track.COLOURS)],
      **looks,
    )
