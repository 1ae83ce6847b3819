"""Steps of a live session, for tests."""

from typing import Callable

from dmc_multimode.viewer import session as session_lib


def run(
  session: session_lib.LiveSession,
  seconds: float,
  until: Callable[[session_lib.LiveState], bool] = lambda state: False,
) -> session_lib.LiveState:
  """Steps the session for so long, or until something is so."""
  for _ in range(round(seconds / session.robot.task.control_timestep)):
    state = session.step()
    if until(state):
      break
  return state
