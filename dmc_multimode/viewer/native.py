"""dm_control's own viewer on a session: a window, and keys for the modes."""

import functools

from dm_control.viewer import application
from dm_control.viewer import user_input

from dmc_multimode.viewer import session as session_lib

_KEYS = 'QWERTYUIO'  # The viewer uses digits for groups of geoms.


def run(session: session_lib.LiveSession) -> None:
  """Opens the window; returns when it is closed.

  The viewer steps the robot itself. Backspace resets it, Space pauses, and Ctrl
  with the mouse applies forces.
  """
  app = application.Application(f'dmc_multimode: {session.arena}')
  for letter, mode in zip(_KEYS, session.modes, strict=False):
    key = getattr(user_input, f'KEY_{letter}')
    app._input_map.bind(functools.partial(session.command, mode), key)
    print(f'{letter}  {mode}')
  robot = session.robot
  app.launch(robot.environment, lambda timestep: robot.action())
