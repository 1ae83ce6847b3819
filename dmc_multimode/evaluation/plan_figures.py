"""The paper's figure of a plan: modes and height over time, and a side view."""

from typing import Any

import matplotlib.figure
import numpy as np

from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.evaluation import figures
from dmc_multimode.planner import plan as plan_lib

_MARGIN = 0.5  # Metres of track before and after the path.
_DEPTH = 0.25  # Metres of ground below the lowest.
_LEAST = 0.02  # Metres: narrower gaps and lower rises are not named.
_GROUND, _TRUNK, _GOAL = '0.75', 'C3', 'C2'
_SMALL = 'small'


def draw(found: plan_lib.PlanResult) -> matplotlib.figure.Figure:
  """Draws a plan, its path, and the times of pushes.

  Args:
    found: result of `plan`.

  Returns:
    A matplotlib figure, to save by `draw_plan(result).savefig('plan.png')`;
    notebooks show it.
  """
  course = found.course
  terrain = track.make(course.arena, sizes=course.sizes).generate(
    np.random.RandomState(course.seed)
  )
  drawn, axes = figures.empty(2, 1, 8.0, 2.9)
  _draw_time(axes[0, 0], found, terrain)
  _draw_side(axes[1, 0], found, terrain)
  return drawn


def _draw_time(
  axis: Any, found: plan_lib.PlanResult, terrain: terrain_lib.Terrain
) -> None:
  """Draws modes, height of the trunk and support over time."""
  plan, path = found.plan, found.path
  names = list(dict.fromkeys(plan.modes))
  knots = plan.knot_duration * np.arange(len(plan.modes) + 1)
  levels = [names.index(mode) for mode in plan.modes]
  axis.step(
    knots, [*levels, levels[-1]], 'C0', where='post', label='commanded mode'
  )
  axis.set_yticks(range(len(names)), names)
  axis.set(xlabel='time (s)', ylim=(-0.5, len(names) - 0.5))
  axis.tick_params(axis='y', colors='C0')
  axis.text(plan.duration, -0.4, ' rest', color='0.4')
  for i, push in enumerate(found.course.pushes):
    label = '' if i else 'push'
    axis.axvline(push.time, color='C1', linestyle='--', label=label)
  times = np.linspace(0.0, found.seconds, len(path) + 1)[1:]
  rows = terrain_lib.Terrain(
    *(np.repeat(field, len(path), axis=0) for field in terrain)
  )
  ground = terrain_lib.support_height(rows, path[:, 0])
  other = axis.twinx()
  other.axvspan(plan.duration, found.seconds, color='0.95', zorder=0)
  other.fill_between(
    times, ground, step='mid', color='0.85', label='ground under the trunk'
  )
  other.plot(times, path[:, 2], _TRUNK, label='trunk')
  other.set_ylabel('height over the world (m)', color=_TRUNK)
  other.set_ylim(0.0, 1.1 * path[:, 2].max())
  axis.set_zorder(other.get_zorder() + 1)
  axis.patch.set_visible(False)
  handles = [
    part for each in (axis, other) for part in each.get_legend_handles_labels()
  ]
  axis.legend(
    handles[0] + handles[2],
    handles[1] + handles[3],
    fontsize=_SMALL,
    ncols=4,
    loc='lower left',
    bbox_to_anchor=(0.0, 1.0),
    frameon=False,
  )


def _draw_side(
  axis: Any, found: plan_lib.PlanResult, terrain: terrain_lib.Terrain
) -> None:
  """Draws path and goal over the profile of the track, to scale."""
  path = found.path
  low = min(path[:, 0].min(), found.goal[0]) - _MARGIN
  high = max(path[:, 0].max(), found.goal[0]) + _MARGIN
  _draw_ground(axis, terrain, low, high)
  axis.plot(path[:, 0], path[:, 2], _TRUNK, label='path of the trunk')
  axis.plot(*path[0, [0, 2]], f'{_TRUNK}o', fillstyle='none', label='start')
  axis.plot(*path[-1, [0, 2]], f'{_TRUNK}o', label='end')
  axis.plot(
    *(found.goal[0], found.goal[2]),
    color=_GOAL,
    marker='*',
    markersize=16,
    alpha=0.7,
    linestyle='none',
    label='goal of the trunk',
  )
  axis.set(xlabel='x (m)', ylabel='height (m)', xlim=(low, high))
  axis.set_aspect('equal')
  axis.legend(
    fontsize=_SMALL,
    loc='upper center',
    bbox_to_anchor=(0.5, -0.25),
    ncols=5,
    frameon=False,
  )
  off = found.final_position - np.array(found.goal)
  axis.set_title(
    f'{"reached" if found.success else "not reached"}: '
    f'{np.linalg.norm(off):.2f} m from the goal, at '
    f'{found.final_speed:.2f} m/s, after {found.seconds:.1f} s',
    fontsize='medium',
  )


def _draw_ground(
  axis: Any, terrain: terrain_lib.Terrain, low: float, high: float
) -> None:
  """Draws the profile from `low` to `high`, and names its gaps and rises."""
  used = np.isfinite(terrain.starts[0])
  segments = list(
    zip(*(field[0][used].tolist() for field in terrain), strict=True)
  )
  bottom = min(top for *_, top in segments) - _DEPTH
  label = 'ground'
  for start, end, top in segments:
    left, right = max(start, low), min(end, high)
    if left < right:
      axis.fill_between(
        [left, right], bottom, top, color=_GROUND, linewidth=0, label=label
      )
      label = ''
  text = {'fontsize': _SMALL, 'color': '0.2', 'va': 'top'}
  for (_, end, before), (start, _, top) in zip(
    segments[:-1], segments[1:], strict=True
  ):
    if not low < start < high:
      continue
    if start - end > _LEAST:
      middle = (end + start) / 2
      axis.text(
        middle, before, f'gap\n{start - end:.2f} m', ha='center', **text
      )
    if abs(top - before) > _LEAST:
      kind = 'up' if top > before else 'down'
      axis.text(start, top, f' {kind} {abs(top - before):.2f} m', **text)
