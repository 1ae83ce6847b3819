"""Scene of the page: robot, reference and ground.

mjviser turns the robot's geoms into meshes. The ground is drawn here, as in the
videos, because its boxes change their sizes. The world moves past the origin,
at which the page's camera looks, so that people may turn it while it follows.
"""

import mjviser
import mujoco
import numpy as np
from scipy.spatial import transform
import viser

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.viewer import camera as camera_lib
from dmc_multimode.viewer import rollout

_VIEW = camera_lib.VIEWS['side']._replace(distance=3.0)  # At first.
_NEAR = 0.1  # Metres; what is nearer is not drawn.
_ENVIRONMENT = 0.2  # Intensity of the ambient light.
_FIELD_OF_VIEW = np.radians(45.0)
_FLAT = 1e-4  # Half-height of boxes drawn for planes, metres.
_SHADOW_RADIUS, _SHADOW_LIFT = 0.16, 0.006  # Metres.
_CORNERS = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing='ij'))
_VERTICES = _CORNERS.reshape(3, 8).T  # Of a box of half-sizes 1; x is slowest.
_SIDES = np.array(  # Counter-clockwise from outside.
  [
    [0, 1, 3, 2],
    [4, 6, 7, 5],
    [0, 4, 5, 1],
    [2, 3, 7, 6],
    [0, 2, 6, 4],
    [1, 5, 7, 3],
  ]
)
_FACES = np.concatenate([_SIDES[:, [0, 1, 2]], _SIDES[:, [0, 2, 3]]])
_SKY = np.array([[190, 214, 235], [242, 245, 250]])  # Above and below.
PATH, _PATH_WIDTH = (235, 120, 40), 3.0  # Of a plan: colour, pixels.


class LiveScene:
  """Draws a robot and its surroundings on a page.

  Attributes:
    target: world point that is at the origin of the page, metres, [3].
  """

  def __init__(self, server: viser.ViserServer, robot: rollout.Robot):
    """Builds the meshes.

    Args:
      server: of the page.
      robot: any robot of the session: all have the same geoms.
    """
    self._server, self._aim = server, camera_lib.Aim()
    self._view = _VIEW.scaled(robot.task.config.robot.size)
    self.target = np.zeros(3)
    # These two frames follow the robot; the first is mjviser's.
    self._frames = [
      server.scene.add_frame(name, show_axes=False)
      for name in ('/bodies', '/world')
    ]
    self._robot = mjviser.ViserMujocoScene(
      server, camera_lib.without_ground(robot), 1
    )
    self._robot.camera_tracking_enabled = False
    *colour, opacity = camera_lib.GHOST
    self._reference = server.scene.add_box(
      '/world/reference',
      tuple(colour),
      tuple(2 * robot.task.config.robot.derived.trunk_size),
      opacity=opacity,
      cast_shadow=False,
      receive_shadow=False,
    )
    self._shadow = server.scene.add_cylinder(
      '/world/shadow',
      radius=_SHADOW_RADIUS,
      height=2 * _FLAT,
      color=(30, 40, 50),
      opacity=0.35,
      cast_shadow=False,
      receive_shadow=False,
    )
    self._drawn_ground: tuple[bytes, int] | None = None
    self._path: viser.SceneNodeHandle | None = None
    self._set_up_view()

  def _set_up_view(self) -> None:
    """Sets up camera and light, cheap enough without a GPU."""
    azimuth, elevation = np.radians([self._view.azimuth, self._view.elevation])
    forward = np.array(
      [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
      ]
    )
    camera = self._server.initial_camera
    camera.position = -self._view.distance * forward
    camera.look_at = np.zeros(3)
    camera.fov, camera.near = _FIELD_OF_VIEW, _NEAR
    # Shadows are too slow without a GPU; a disc shows the height.
    self._server.scene.configure_default_lights(cast_shadow=False)
    self._server.scene.configure_environment_map(
      'studio', environment_intensity=_ENVIRONMENT
    )
    shares = np.linspace(0.0, 1.0, 64)[:, None, None]
    sky = _SKY[0] + shares * (_SKY[1] - _SKY[0])
    self._server.scene.set_background_image(sky.astype(np.uint8), 'png')

  def show(self, robot: rollout.Robot) -> None:
    """Draws the robot; does nothing if its state is not finite."""
    position, data = robot.position, robot.physics.data
    if not np.isfinite(position).all():
      return
    self.target = self._aim.follow(robot.task, position, self._view)
    offset = -self.target
    with self._server.atomic():
      self._show_ground(robot.task.root_entity.terrain, float(position[0]))
      for frame in self._frames:
        frame.position = offset
      place, rotation = camera_lib.reference_pose(
        robot.task, float(position[0])
      )
      self._reference.position = place
      self._reference.wxyz = transform.Rotation.from_matrix(rotation).as_quat(
        scalar_first=True
      )
      height = robot.task.core.support(position[:1])[0] + _SHADOW_LIFT
      self._shadow.position = np.array([*position[:2], height])
      self._robot.update_from_arrays(
        data.xpos[None].copy(), data.xmat.reshape(1, -1, 3, 3).copy()
      )

  def show_path(self, path: np.ndarray | None) -> None:
    """Draws the path of a plan's trunk, metres, [T, 3]; none if None."""
    if self._path is not None:
      self._path.remove()
      self._path = None
    if path is not None:
      self._path = self._server.scene.add_line_segments(
        '/world/path',
        np.stack([path[:-1], path[1:]], axis=1),
        PATH,
        thickness=_PATH_WIDTH,
        thickness_units='screen',
      )

  def _show_ground(self, terrain: terrain_lib.Terrain, x: float) -> None:
    """Redraws the ground around `x` where it has changed."""
    ground = b''.join(field.tobytes() for field in terrain), round(x)
    if ground == self._drawn_ground:
      return
    self._drawn_ground = ground
    boxes = [
      *camera_lib.segments(terrain),
      *camera_lib.ground_marks(terrain, round(x)),
    ]
    flat = [box.shape == mujoco.mjtGeom.mjGEOM_PLANE for box in boxes]
    halves = np.array([box.halves for box in boxes])
    halves[flat, 2] = _FLAT
    self._server.scene.add_batched_meshes_simple(
      '/world/ground',
      _VERTICES,
      _FACES,
      batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(boxes), 1)),
      batched_positions=np.array([box.centre for box in boxes]),
      batched_scales=halves,
      batched_colors=np.array(
        [np.round(255 * np.array(box.colour[:3])) for box in boxes], np.uint8
      ),
      flat_shading=True,
      lod='off',
      cast_shadow=False,
    )
