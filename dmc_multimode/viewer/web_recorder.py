"""Recordings from the page: a take, drawn, and sent to the browser."""

import re

import numpy as np
import viser

from dmc_multimode.viewer import captions
from dmc_multimode.viewer import session as session_lib
from dmc_multimode.viewer import take as take_lib
from dmc_multimode.viewer import web_scene


class Recorder:
  """Records what one browser sees; one video at a time."""

  def __init__(
    self,
    server: viser.ViserServer,
    session: session_lib.LiveSession,
    scene: web_scene.LiveScene,
    name: str,
  ):
    """Records nothing yet; `name` of the policy begins the files' names."""
    self._server, self._session, self._scene = server, session, scene
    self._name = re.sub(r'[^\w.-]+', '_', name)
    self._take: take_lib.Take | None = None
    self._drawing: take_lib.Drawing | None = None
    self._client: viser.ClientHandle | None = None
    self._eye = take_lib.Eye(np.array([0.0, -3.0, 1.0]), np.zeros(3))
    self._count = 0

  @property
  def progress(self) -> str:
    """Progress in words; empty for none."""
    if self._take:
      return f'recording: {self._take.seconds:.1f} s'
    return 'drawing the video' if self._drawing else ''

  @property
  def label(self) -> str:
    """Label of the button that starts and stops."""
    return 'V  stop and save' if self._take else 'V  record'

  def toggle(self, client: viser.ClientHandle | None) -> None:
    """Starts a recording of what a browser sees, or ends it and saves it there.

    Raises:
      ValueError: the last video is still being drawn, or has no step yet.
    """
    if self._drawing:
      raise ValueError('The last video is still being drawn.')
    self._client = client
    if not self._take:
      self._take = take_lib.Take(self._session.robot)
      return
    take, self._take = self._take, None
    self._drawing = take.draw()
    self._session.notice = (
      f'{take.seconds:.1f} s of video are being drawn; then your browser '
      'downloads them.'
    )

  def add(self, state: session_lib.LiveState) -> None:
    """Adds a control step, and sends a video that is ready."""
    if self._drawing and self._drawing.done:
      self._send()
    if not self._take:
      return
    step = state.step
    self._take.add(
      self._session.robot,
      captions.Caption(
        self._session.modes.index(step.mode),
        step.mode,
        (
          f'track {self._session.arena}',
          f'height {step.height:.2f} m over the ground',
          f'speed {step.speed:.2f} m/s',
          f'up for {state.survival.up:.0f} s',
        ),
        state.notice if state.down else '',
      ),
      self._look(),
    )
    if self._take.seconds >= take_lib.LONGEST:
      self.toggle(self._client)

  def close(self) -> None:
    """Ends a drawing."""
    if self._drawing:
      self._drawing.close()

  def _look(self) -> take_lib.Eye:
    """Returns the browser's camera, or its last one if it has left."""
    clients = self._server.get_clients()
    if self._client and self._client.client_id in clients:
      camera = self._client.camera
      self._eye = take_lib.Eye(
        np.array(camera.position), np.array(camera.look_at)
      )
    position, target = self._eye
    return take_lib.Eye(
      position + self._scene.target, target + self._scene.target
    )

  def _send(self) -> None:
    """Sends the video to the browser that asked, or to any that is left."""
    assert self._drawing
    drawing, self._drawing = self._drawing, None
    try:
      content = drawing.result()
    except OSError as error:
      self._session.notice = str(error)
      return
    clients = self._server.get_clients()
    asked = self._client.client_id if self._client else -1
    client = clients.get(asked) or next(iter(clients.values()), None)
    if client is None:
      self._session.notice = 'Nobody is left to take the video.'
      return
    self._count += 1
    name = f'{self._name}_{self._session.arena}_{self._count}.mp4'
    client.send_file_download(name, content, save_immediately=True)
    self._session.notice = f'The video {name} is in your downloads.'
