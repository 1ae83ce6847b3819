"""Tracks of live sessions: those of the library, and one without an end."""

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import track
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.viewer import rollout

ENDLESS = 'endless'  # An obstacle course that grows ahead of the robot.
NAMES = (*layouts.NAMES, ENDLESS)
_SEGMENTS = 32  # Segments of a track: bounds the number of ledges.


def make(name: str, difficulty: float) -> track.Track:
  """Returns a track.

  Args:
    name: one of `NAMES`.
    difficulty: of the endless track, 0 to 1.

  Raises:
    ValueError: the track is unknown.
  """
  if name == ENDLESS:
    return track.endless(difficulty)
  return track.make(name, _SEGMENTS)


def goal(
  robot: rollout.Robot, name: str, seed: int
) -> tuple[float, float, float] | None:
  """Returns the goal of a track, metres; None where it has no end."""
  if name in (ENDLESS, 'flat'):
    return None
  return reaching.problem(name, robot.task.root_entity.terrain, seed).goal


def extend(robot: rollout.Robot) -> None:
  """Puts obstacles ahead of a robot on an endless track."""
  arena = robot.task.root_entity
  if not isinstance(arena, track.EndlessTrack) or robot.over:
    return
  terrain = arena.extended(
    robot.task.core.terrain,
    float(robot.position[0]),
    robot.environment.random_state,
  )
  if terrain is not None:
    robot.task.set_terrain(robot.physics, terrain)
