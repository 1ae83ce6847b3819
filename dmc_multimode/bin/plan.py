r"""Plans mode commands across a track.

  python -m dmc_multimode.bin.plan --arena=gap \
    --policy=pi2 --out=plan.json --figure=plan.png

Each track has its own goal and knots: those of the paper's Table III, and of
another track those that cross it. --goal, --knots and --dt are in their place.
A plan is open-loop, and pushes are unknown to the planner. With --replan_every
it plans again on the way, from the robot's current state, and writes the modes
that were commanded:

  python -m dmc_multimode.bin.plan --arena=gap_block \
    --policy=pi2 --push=0.6:-0.5 --replan_every=2 --out=plan.json

With --seconds it returns in time with the best plan so far, successful or not.
"""

import dataclasses
from typing import Any, Sequence

from absl import flags
import numpy as np

from dmc_multimode import planner
from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import track
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import plan_figures
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import solver
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import files

_POLICY = config_flags.define_path(
  'policy', 'pi2', 'Name of a shipped policy, or a folder.'
)
_ARENA = flags.DEFINE_string(
  'arena', 'gap_block', f'{", ".join(layouts.NAMES)}.'
)
_SIZES = config_flags.define_sizes()
_GOAL = flags.DEFINE_list(
  'goal', None, "Of the trunk, metres: x,y,z; the track's own by default."
)
_KNOTS = flags.DEFINE_integer('knots', None, 'Of the plan; likewise.')
_DT = flags.DEFINE_float('dt', None, 'Seconds from knot to knot; likewise.')
_SEED = flags.DEFINE_integer('seed', 0, 'Of a random track, and the planner.')
_PLANNER = flags.DEFINE_enum(
  'planner',
  None,
  list(solver.PLANNERS),
  'Which planner; by default guided for a policy with a selector, else beam.',
)
_REPLAN_EVERY = flags.DEFINE_integer(
  'replan_every', 0, 'Knots after which to plan again; 0 for never.'
)
_SECONDS = flags.DEFINE_float(
  'seconds',
  None,
  'Wall-clock budget of each planning, without the compilation of worlds; the '
  'search begins anew with more beams or samples until it is spent. By default '
  'it ends after its attempts.',
)
_PUSH = flags.DEFINE_list(
  'push', [], 'What pushes the robot, m/s: SECONDS:VX or SECONDS:VX:VY, ...'
)
_THREADS = flags.DEFINE_integer(
  'threads', 0, 'Of the physics; 0 for every core.', lower_bound=0
)
_OUT = config_flags.define_path('out', None, 'JSON file to write the plan to.')
_FIGURE = config_flags.define_path(
  'figure', None, 'PNG file to draw the plan to.'
)

for _name, _config in solver.PLANNERS.items():
  config_flags.define(_config, _name)


def _read_problem(sizes: dict[str, float]) -> reaching.ReachingConfig:
  """Returns the track's own problem, with what the flags change in it."""
  terrain = track.make(_ARENA.value, sizes=sizes).generate(
    np.random.RandomState(_SEED.value)
  )
  changes: dict[str, Any] = {
    'knots': _KNOTS.value,
    'knot_duration': _DT.value,
  }
  if _GOAL.value is not None:
    try:
      x, y, z = (float(value) for value in _GOAL.value)
    except ValueError as error:
      raise ValueError(
        f'--goal={",".join(_GOAL.value)} is not X,Y,Z in metres.'
      ) from error
    changes['goal'] = x, y, z
  return dataclasses.replace(
    reaching.problem(_ARENA.value, terrain, _SEED.value),
    **{name: value for name, value in changes.items() if value is not None},
  )


def _print(found: planner.PlanResult) -> None:
  for name, seconds in zip(*found.plan.segments(), strict=True):
    print(f'{name}: {seconds:g} s')
  x, y, z = found.final_position
  print(
    f'{"stands at" if found.success else "does NOT stand at"} the goal after '
    f'{found.seconds:.1f} s: trunk at x = {x:.2f}, y = {y:.2f}, z = {z:.2f} m, '
    f'{found.final_speed:.2f} m/s; solved in {found.solve_seconds:.1f} s, '
    f'{found.control_steps} control steps'
  )


def main(argv: Sequence[str]) -> int:
  """Plans, prints, writes, draws; returns 0 if the goal was reached."""
  del argv
  out = files.output_file('out', _OUT.value)
  figure = files.output_file('figure', _FIGURE.value)
  sizes = config_flags.read_sizes(_SIZES.value)
  name = _PLANNER.value or solver.default_name(_POLICY.value)
  found = planner.solve(
    _POLICY.value,
    _ARENA.value,
    _SEED.value,
    _read_problem(sizes),
    sizes,
    config_flags.read(solver.PLANNERS[name], name),
    [pushes_lib.parse(item) for item in _PUSH.value],
    _REPLAN_EVERY.value,
    _THREADS.value,
    seconds=_SECONDS.value,
  )
  _print(found)
  if out:
    found.save(out)
    print(f'The plan is in {out}')
  if figure:
    figures.save(figure, plan_figures.draw(found))
    print(f'The figure is in {figure}')
  return 0 if found.success else app.EXIT_UNSOLVED


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
