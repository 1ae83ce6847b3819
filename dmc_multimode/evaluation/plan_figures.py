"""The paper's figure of a plan: modes and height over time, and a side view."""

from typing import Any

import matplotlib.figure
import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.evaluation import figures
from dmc_multimode.planner import plan as plan_lib

_MARGIN = 0.5  # Metres of track before and after the path.
_DEPTH = 0.1  # Metres of ground below the lowest.


def draw(found: plan_lib.PlanResult) -> matplotlib.figure.Figure:
  """Draws a plan, its path, and the times of pushes."""
  course = found.course
  terrain = track.make(course.arena, sizes=course.sizes).generate(
    np.random.RandomState(course.seed)
  )
  drawn, axes = figures.empty(2, 1, 8.0, 2.6)
  _draw_time(axes[0, 0], found, terrain)
  for push in course.pushes:
    axes[0, 0].axvline(push.time, color='C1', linestyle='--')
  _draw_side(axes[1, 0], found.path, terrain)
  _draw_goal(axes[1, 0], found)
  return drawn


def _draw_time(
  axis: Any, found: plan_lib.PlanResult, terrain: terrain_lib.Terrain
) -> None:
  """Draws modes, height of the trunk and support over time."""
  plan, path = found.plan, found.path
  names = list(dict.fromkeys(plan.modes))
  knots = plan.knot_duration * np.arange(len(plan.modes) + 1)
  levels = [names.index(mode) for mode in plan.modes]
  axis.step(knots, [*levels, levels[-1]], 'C0', where='post')
  axis.set_yticks(range(len(names)), names)
  axis.set(xlabel='time (s)', ylim=(-0.5, len(names) - 0.5))
  axis.tick_params(axis='y', colors='C0')
  axis.text(plan.duration, -0.4, ' rest', color='0.4')
  times = np.linspace(0.0, found.seconds, len(path) + 1)[1:]
  rows = terrain_lib.Terrain(
    *(np.repeat(field, len(path), axis=0) for field in terrain)
  )
  ground = terrain_lib.support_height(rows, path[:, 0])
  other = axis.twinx()
  other.axvspan(plan.duration, found.seconds, color='0.95', zorder=0)
  other.fill_between(times, ground, step='mid', color='0.85')
  other.plot(times, path[:, 2], 'C3')
  other.set_ylabel('height of the trunk (m)', color='C3')
  other.set_ylim(0.0, 1.1 * path[:, 2].max())
  axis.set_zorder(other.get_zorder() + 1)
  axis.patch.set_visible(False)


def _draw_side(
  axis: Any, path: np.ndarray, terrain: terrain_lib.Terrain
) -> None:
  """Draws the path over the profile of the track, to scale."""
  low, high = path[:, 0].min() - _MARGIN, path[:, 0].max() + _MARGIN
  used = np.isfinite(terrain.starts[0])
  bottom = terrain.tops[0][used].min() - _DEPTH
  for start, end, top in zip(
    *(field[0][used] for field in terrain), strict=True
  ):
    left, right = max(start, low), min(end, high)
    if left < right:
      axis.fill_between([left, right], bottom, top, color='0.75', linewidth=0)
  axis.plot(path[:, 0], path[:, 2], 'C3')
  axis.plot(*path[-1, [0, 2]], 'C3o')
  axis.set(xlabel='x (m)', ylabel='z (m)', xlim=(low, high), aspect='equal')


def _draw_goal(axis: Any, found: plan_lib.PlanResult) -> None:
  """Marks the goal, and says how the robot ended."""
  x, _, z = found.goal
  axis.plot(x, z, 'k+', markersize=12)
  off = found.final_position - np.array(found.goal)
  axis.set_title(
    f'{"reached" if found.success else "not reached"}: '
    f'{np.linalg.norm(off):.2f} m from the goal (+), at '
    f'{found.final_speed:.2f} m/s, after {found.seconds:.1f} s',
    fontsize='medium',
  )
