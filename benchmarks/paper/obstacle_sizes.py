"""Finds how wide a gap and how high a block a policy can cross.

    python -m benchmarks.paper.obstacle_sizes --policy=pi2 \
      --figure=sizes.png --out=sizes.json

The paper's tracks have a gap of 0.45 m and blocks of 0.4 m. Here the tracks
`gap` and `block` grow from what is easy to what nothing crosses; each size is
tried from `--seeds` starts, which differ in the noise on joints, tilt and
velocities. The goal is 0.4 m behind the edge, in time for 0.3 m/s: the paper's
3.3 s for its gap are less than a selector takes, which would hide its limit.

A guided search has half of `--seconds`, and where it fails a beam search the
other half; the selector chooses once a knot, and needs no budget. What a search
finds in its time depends on the machine.
"""

import functools
import itertools
import pathlib
from typing import Mapping, NamedTuple, Sequence

from absl import flags
import matplotlib.figure
import numpy as np

from benchmarks import common
from dmc_multimode import planner as planner_lib
from dmc_multimode.arenas import track as track_lib
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import figures
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

_POLICY = common.define_policy()
_PLANNERS = flags.DEFINE_list('planners', ['guided', 'selector'], 'Which.')
_SEEDS = flags.DEFINE_integer('seeds', 5, 'Starts on each track.', 1)
_SECONDS = flags.DEFINE_float(
  'seconds', 10.0, 'Wall-clock budget of a plan, of all its searches together.'
)
_SELECTOR = common.define_selector()
_FIGURE = config_flags.define_path('figure', None, 'PNG file to draw to.')
_OUT = common.define_out()

_COLUMNS = (
  'obstacle | metres=size:.2f | planner | reached:d | of:d | '
  'seconds=solve_seconds:.2f'
)


class Obstacle(NamedTuple):
  """A track with one size that varies.

  Attributes:
    size: its name among those of the track.
    label: of the axis.
    paper: the paper's, metres.
    default: sizes that are tried, metres.
  """

  size: str
  label: str
  paper: float
  default: tuple[float, ...]


def _steps(first: float, last: float) -> tuple[float, ...]:
  """Returns sizes in steps of 5 cm, both ends included, metres."""
  count = round((last - first) / 0.05) + 1
  return tuple(np.linspace(first, last, count).round(2).tolist())


OBSTACLES: Mapping[str, Obstacle] = {  # By the name of the track.
  'gap': Obstacle('width', 'width of the gap (m)', 0.45, _steps(0.2, 0.8)),
  'block': Obstacle('height', 'height of the block (m)', 0.4, _steps(0.2, 0.7)),
}
_SIZES = {
  name: flags.DEFINE_list(
    f'{name}s', [f'{size:g}' for size in obstacle.default], 'Sizes, metres.'
  )
  for name, obstacle in OBSTACLES.items()
}


def searches(name: str, folder: str = '') -> list[solver_lib.PlannerConfig]:
  """Returns what a planner tries, one after the other.

  Args:
    name: of the planner.
    folder: of the selector.

  Raises:
    ValueError: it is unknown.
  """
  known: dict[str, list[solver_lib.PlannerConfig]] = {
    'guided': [
      planner_lib.GuidedConfig(folder=folder),
      planner_lib.BeamConfig(),
    ],
    'beam': [planner_lib.BeamConfig()],
    'selector': [steering.SteeringConfig(folder)],
  }
  if name not in known:
    raise ValueError(f'--planners: {name!r} is not one of {", ".join(known)}.')
  return known[name]


def solve(
  policy: str,
  track: str,
  size: float,
  seed: int,
  planners: Sequence[solver_lib.PlannerConfig],
  knot_duration: float,
  seconds: float,
) -> common.Row:
  """Returns what the planners find, one after the other until one succeeds.

  Args:
    policy: name or folder.
    track: one of `OBSTACLES`.
    size: of its obstacle, metres.
    seed: of the start.
    planners: that share the seconds.
    knot_duration: of all plans, seconds.
    seconds: budget.
  """
  sizes = {OBSTACLES[track].size: size}
  arena = track_lib.make(track, sizes=sizes)
  terrain = arena.generate(np.random.RandomState(seed))
  config = reaching.in_knots(reaching.crossing(terrain, seed), knot_duration)
  tried: list[plan_lib.PlanResult] = []
  for planner in planners:
    steers = isinstance(planner, steering.SteeringConfig)
    tried.append(
      planner_lib.solve(
        policy,
        track,
        seed,
        config,
        sizes,
        planner,
        quiet=True,
        seconds=None if steers else seconds / len(planners),
      )
    )
    if tried[-1].success:
      break
  return {
    'seed': seed,
    'success': tried[-1].success,
    'found_by': tried[-1].origin['planner'],
    'solve_seconds': sum(found.solve_seconds for found in tried),
    'final_position': tried[-1].final_position.tolist(),
    'plan': list(tried[-1].plan.modes),
  }


def draw(rows: Sequence[common.Row]) -> matplotlib.figure.Figure:
  """Draws the share of the starts from which planners succeed, by size.

  Args:
    rows: of the table.
  """
  drawn, axes = figures.empty(1, len(OBSTACLES), 4.5, 3.2)
  for axis, (track, obstacle) in zip(axes[0], OBSTACLES.items(), strict=True):
    mine = [row for row in rows if row['obstacle'] == track]
    for i, planner in enumerate(dict.fromkeys(r['planner'] for r in mine)):
      found = [row for row in mine if row['planner'] == planner]
      axis.plot(
        [row['size'] for row in found],
        [row['reached'] / row['of'] for row in found],
        ('o-', 's--', '^:')[i % 3],  # Lines may lie on one another.
        label=planner,
      )
    axis.axvline(
      obstacle.paper,
      color='0.5',
      linewidth=0.8,
      label=f"the paper's, {obstacle.paper:g} m",
    )
    axis.set(xlabel=obstacle.label, ylim=(-0.05, 1.05))
    axis.legend(fontsize='small')
  axes[0, 0].set_ylabel('share of the starts that reach the goal')
  return drawn


def _sizes(track: str) -> list[float]:
  """Returns the sizes of a flag in rising order, metres.

  Raises:
    ValueError: one is no number.
  """
  try:
    return sorted({float(size) for size in _SIZES[track].value})
  except ValueError as error:
    raise ValueError(f'--{track}s are metres: {error}.') from error


def main(argv: Sequence[str]) -> None:
  """Plans, prints, writes, draws."""
  del argv
  out = files.output_file('out', _OUT.value)
  figure = files.output_file('figure', _FIGURE.value)
  planners = {
    name: searches(name, _SELECTOR.value)
    for name in dict.fromkeys(_PLANNERS.value)
  }
  solver_lib.check_seconds(_SECONDS.value, planner_lib.BeamConfig())
  knot_duration = steering.load(
    steering.SteeringConfig(_SELECTOR.value), _POLICY.value
  ).knot_duration
  cases = [
    (track, size, name)
    for track in OBSTACLES
    for size, name in itertools.product(_sizes(track), planners)
  ]
  table: list[common.Row] = []
  with progress_bar.Bar(total=len(cases) * _SEEDS.value, unit='plan') as bar:
    for track, size, name in cases:
      plans: list[common.Row] = []
      for seed in range(_SEEDS.value):
        plans.append(
          solve(
            _POLICY.value,
            track,
            size,
            seed,
            planners[name],
            knot_duration,
            _SECONDS.value,
          )
        )
        bar.update()
      table.append(
        {
          'obstacle': track,
          'size': size,
          'planner': name,
          'reached': sum(plan['success'] for plan in plans),
          'of': len(plans),
          'solve_seconds': float(
            np.median([plan['solve_seconds'] for plan in plans])
          ),
          'plans': plans,
        }
      )
      common.show(_COLUMNS, table[-1])
      report: common.Row = {'benchmark': 'obstacle_sizes', 'table': table}
      report |= {'policy': _POLICY.value, 'seconds': _SECONDS.value}
      common.write_report(out, report)
  common.print_table(_COLUMNS, table)
  if figure:
    figures.save(pathlib.Path(figure), draw(table))
    print(f'The figure is in {figure}')


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
