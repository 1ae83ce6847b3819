"""One MJCF file of robot and track, for programs that know MuJoCo alone.

It is `xml/scene.xml` with the boxes of a track for its floor, and has the names
of that file: joints and actuators are those of `mini_biped.JOINTS`, the body of
the trunk is `trunk`, the boxes are `segment_0`, `segment_1`, ...
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

_PRECISION = 17  # Digits: every number is read as it was written.


def write(
  out_dir: str | os.PathLike[str],
  arena: str = 'flat',
  sizes: Mapping[str, layouts.Number] | None = None,
  seed: int = 0,
  timestep: float | None = None,
) -> pathlib.Path:
  """Writes a model of the robot on a track, a single file without assets.

  The robot stands on a free joint at the origin, facing +x. The keyframe
  `stand` has the crouch and the controls that carry it. The physics are those
  of the task of default configuration, with the joints' servo inertia for the
  time step, except that a diverged state is reset as everywhere in MuJoCo.

  Args:
    out_dir: folder of the file; made if it is missing.
    arena: one of `layouts.NAMES`.
    sizes: of the layout, metres; see its function in `layouts`.
    seed: of what the layout draws.
    timestep: of the physics, seconds; the tasks' own by default.

  Returns:
    The path of the file, `OUT_DIR/mini_biped_ARENA.xml`.

  Raises:
    OSError: the file cannot be written.
    ValueError: the arena or a size is unknown, or the time step is not
      positive and finite.
  """
  text = to_xml(arena, sizes, seed, timestep)
  path = pathlib.Path(out_dir) / f'mini_biped_{arena}.xml'
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write(path, text.encode())
  return path


def to_xml(
  arena: str = 'flat',
  sizes: Mapping[str, layouts.Number] | None = None,
  seed: int = 0,
  timestep: float | None = None,
) -> str:
  """Returns the model that `write` writes; see there."""
  if timestep is None:
    timestep = task_config.ImitationConfig().physics_timestep
  if not 0 < timestep < np.inf:
    raise ValueError(f'timestep must be positive and finite, got {timestep}.')
  terrain = track.make(arena, sizes=sizes).generate(np.random.RandomState(seed))
  root = mjcf.from_path(str(resources.path('xml', 'scene.xml')))
  root.model = f'mini_biped_{arena}'
  root.option.timestep = timestep
  _replace_floor(root, terrain)
  return root.to_xml_string(precision=_PRECISION)


def _replace_floor(root: Any, terrain: terrain_lib.Terrain) -> None:
  """Replaces the floor by the boxes of a terrain, a batch of one."""
  floor = root.find('geom', 'floor')
  looks = {'material': floor.material, 'friction': floor.friction}
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
