"""Takes: what a live session showed, drawn into a video afterwards.

A session runs in real time, and its page is drawn by the browser. So a take
keeps poses alone, some hundred numbers a control step, and a process of its own
draws them when the take has ended, at every control step and in full size.

`python -m dmc_multimode.viewer.take FOLDER OUT` is that process.
"""

import contextlib
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np
import safetensors.numpy

from dmc_multimode.viewer import captions
from dmc_multimode.viewer import gl
from dmc_multimode.viewer import video

if TYPE_CHECKING:
  from dmc_multimode.viewer import rollout as rollout_lib

LONGEST = 120.0  # Seconds of a take.
_WIDTH, _HEIGHT = 960, 540  # Pixels.
_FIELD_OF_VIEW = 45.0  # Degrees, vertical, as that of the page.
_MODEL, _POSES, _TEXTS, _GROUNDS = (
  'model.mjb',
  'poses.safetensors',
  'texts.json',
  'grounds.safetensors',
)
_VIDEO = f'take{video.SUFFIX}'
_NICE = 10  # The session comes first.


class Eye(NamedTuple):
  """A camera.

  Attributes:
    position: world metres, [3].
    target: what it looks at, world metres, [3].
  """

  position: np.ndarray
  target: np.ndarray


class Take:
  """Poses of a session."""

  def __init__(self, robot: 'rollout_lib.Robot'):
    """Begins a take of any robot of a session: all have the same geoms."""
    from dmc_multimode.viewer import camera as camera_lib

    self._model = camera_lib.without_ground(robot)
    self._period = robot.task.control_timestep
    self._poses: dict[str, list[np.ndarray]] = {
      name: [] for name in ('qpos', 'ghost', 'turn', 'eye', 'target', 'ground')
    }
    self._grounds: list[np.ndarray] = []
    self._texts: list[dict[str, Any]] = []
    self._size = robot.task.config.robot.derived.trunk_size

  @property
  def seconds(self) -> float:
    """Duration until now."""
    return len(self._texts) * self._period

  def add(
    self,
    robot: 'rollout_lib.Robot',
    caption: captions.Caption,
    eye: Eye,
  ) -> None:
    """Adds a control step; nothing if the state is not finite.

    Args:
      robot: after the step.
      caption: of the frame.
      eye: the camera.
    """
    from dmc_multimode.viewer import camera as camera_lib

    qpos = robot.physics.data.qpos.copy()
    if not np.isfinite(qpos).all():
      return
    ghost, turn = camera_lib.reference_pose(robot.task, float(qpos[0]))
    terrain = np.stack([field[0] for field in robot.task.root_entity.terrain])
    if not (self._grounds and np.array_equal(self._grounds[-1], terrain)):
      self._grounds.append(terrain.copy())
    values = (qpos, ghost, turn, eye.position, eye.target)
    for kept, value in zip(self._poses.values(), values, strict=False):
      kept.append(np.array(value))
    self._poses['ground'].append(np.array(len(self._grounds) - 1))
    self._texts.append(caption._asdict())

  def draw(self) -> 'Drawing':
    """Starts to draw the video in a process of its own.

    Raises:
      ValueError: there is no control step.
    """
    if not self._texts:
      raise ValueError('There is nothing to draw: the take has no step.')
    import mujoco

    folder = tempfile.TemporaryDirectory(prefix='dmc_multimode_take_')
    path = pathlib.Path(folder.name)
    mujoco.mj_saveModel(self._model, str(path / _MODEL), None)
    poses = {name: np.stack(kept) for name, kept in self._poses.items()}
    poses |= {'size': np.array(self._size), 'period': np.array(self._period)}
    safetensors.numpy.save_file(poses, path / _POSES)
    grounds = {str(i): ground for i, ground in enumerate(self._grounds)}
    safetensors.numpy.save_file(grounds, path / _GROUNDS)
    (path / _TEXTS).write_text(json.dumps(self._texts))
    return Drawing(folder)


class Drawing:
  """A video that is being drawn."""

  def __init__(self, folder: 'tempfile.TemporaryDirectory[str]'):
    """Starts the process on the files in `folder`, and removes them later."""
    self._folder = folder
    path = pathlib.Path(folder.name)
    environment = dict(os.environ)
    if environment.get(gl.VARIABLE) == 'disable':  # That of the session.
      del environment[gl.VARIABLE]
    command = [sys.executable, '-m', __name__, str(path), str(path / _VIDEO)]
    self._process = subprocess.Popen(
      command,
      env=environment,
      stdin=subprocess.DEVNULL,
      stdout=subprocess.DEVNULL,
      stderr=subprocess.PIPE,
      text=True,
    )

  @property
  def done(self) -> bool:
    """True once the process has ended."""
    return self._process.poll() is not None

  def result(self) -> bytes:
    """Waits, and returns the file's content, an .mp4.

    Raises:
      OSError: it could not be drawn; one line says why.
    """
    _, errors = self._process.communicate()
    with self._folder:
      if self._process.returncode:
        lines = errors.strip().splitlines() or ['the process was killed']
        raise OSError(f'The video could not be drawn: {lines[-1]}')
      return (pathlib.Path(self._folder.name) / _VIDEO).read_bytes()

  def close(self) -> None:
    """Ends the process and removes its files."""
    if not self.done:
      self._process.kill()
    self._process.communicate()
    self._folder.cleanup()


def _film(folder: pathlib.Path, out: pathlib.Path) -> None:
  """Draws the take whose files are in `folder`."""
  from dm_control import mujoco as control
  from dm_control.mujoco import engine
  from dm_control.mujoco import wrapper
  import mujoco

  from dmc_multimode.arenas import terrain as terrain_lib
  from dmc_multimode.viewer import camera as camera_lib

  poses = safetensors.numpy.load_file(folder / _POSES)
  grounds = safetensors.numpy.load_file(folder / _GROUNDS)
  texts = json.loads((folder / _TEXTS).read_text())
  model = mujoco.MjModel.from_binary_path(str(folder / _MODEL))
  view = model.vis
  view.global_.offwidth, view.global_.offheight = _WIDTH, _HEIGHT
  view.global_.fovy = _FIELD_OF_VIEW
  physics = control.Physics.from_model(wrapper.MjModel(model))
  boxes: list[camera_lib.Box] = []
  camera = engine.Camera(
    physics,
    _HEIGHT,
    _WIDTH,
    -1,
    max_geom=model.ngeom + camera_lib.EXTRA_GEOMS,
    scene_callback=lambda physics, scene: camera_lib.add_boxes(scene, boxes),
  )
  with video.open_writer(out, 1 / float(poses['period'])) as append:
    for i, text in enumerate(texts):
      physics.data.qpos[:] = poses['qpos'][i]
      mujoco.mj_kinematics(model, physics.data.ptr)
      mujoco.mj_camlight(model, physics.data.ptr)
      terrain = terrain_lib.Terrain(*grounds[str(poses['ground'][i])][:, None])
      boxes[:] = [
        *camera_lib.segments(terrain),
        *camera_lib.ground_marks(terrain, float(poses['qpos'][i, 0])),
        camera_lib.Box(
          poses['ghost'][i],
          poses['size'],
          camera_lib.GHOST,
          poses['turn'][i],
        ),
      ]
      _aim(camera._render_camera, Eye(poses['eye'][i], poses['target'][i]))
      append(captions.label(camera.render(), captions.Caption(**text)))


def _aim(pose: Any, eye: Eye) -> None:
  """Points MuJoCo's free camera as the page's."""
  way = eye.target - eye.position
  distance = float(np.linalg.norm(way))
  pose.lookat[:], pose.distance = eye.target, distance
  pose.azimuth = np.degrees(np.arctan2(way[1], way[0]))
  pose.elevation = np.degrees(np.arcsin(way[2] / distance))


def _main() -> None:
  """Draws; one line says what is wrong, if anything is."""
  folder, out = map(pathlib.Path, sys.argv[1:])
  with contextlib.suppress(OSError):
    os.nice(_NICE)
  try:
    gl.choose_backend()
    _film(folder, out)
  except (OSError, ValueError) as problem:
    print(problem, file=sys.stderr)
    sys.exit(2)


if __name__ == '__main__':
  _main()
