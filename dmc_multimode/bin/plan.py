r"""Plans mode commands across a track.

  python -m dmc_multimode.bin.plan --flagfile=flags/plan_gap.flags \
    --policy=pi2 --out=plan.json --figure=plan.png

A plan is open-loop, and pushes are unknown to the planner. With --replan_every
it plans again on the way, from the robot's current state, and writes the modes
that were commanded:

  python -m dmc_multimode.bin.plan --flagfile=flags/plan_gap_block.flags \
    --policy=pi2 --push=0.6:-0.5 --replan_every=2 --out=plan.json
"""

from typing import Sequence

from absl import flags

from dmc_multimode import planner
from dmc_multimode.arenas import layouts
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import plan_figures
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import solver
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import files

_POLICY = flags.DEFINE_string(
  'policy', 'pi2', 'Name of a shipped policy, or a folder.'
)
_ARENA = flags.DEFINE_string(
  'arena', 'gap_block', f'{", ".join(layouts.NAMES)}.'
)
_SIZES = flags.DEFINE_list(
  'sizes', [], 'Of the arena, metres: width:0.3,distance:1.0.'
)
_GOAL = flags.DEFINE_list(
  'goal', ['2.0', '0.0', '0.9'], 'Of the trunk, metres: x,y,z.'
)
_KNOTS = flags.DEFINE_integer('knots', 30, 'Of the plan.')
_DT = flags.DEFINE_float('dt', 0.15, 'Seconds from knot to knot.')
_SEED = flags.DEFINE_integer('seed', 0, 'Of a random track, and the planner.')
_PLANNER = flags.DEFINE_enum(
  'planner', 'beam', list(solver.PLANNERS), 'Which planner.'
)
_REPLAN_EVERY = flags.DEFINE_integer(
  'replan_every', 0, 'Knots after which to plan again; 0 for never.'
)
_PUSH = flags.DEFINE_list(
  'push', [], 'What pushes the robot, m/s: SECONDS:VX or SECONDS:VX:VY, ...'
)
_THREADS = flags.DEFINE_integer(
  'threads', 0, 'Of the physics; 0 for every core.', lower_bound=0
)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write the plan to.')
_FIGURE = flags.DEFINE_string('figure', None, 'PNG file to draw the plan to.')

for _name, _config in solver.PLANNERS.items():
  config_flags.define(_config, _name)


def _read_problem() -> reaching.ReachingConfig:
  """Returns the reaching problem of the flags."""
  try:
    x, y, z = (float(value) for value in _GOAL.value)
  except ValueError as error:
    raise ValueError(
      f'--goal={",".join(_GOAL.value)} is not X,Y,Z in metres.'
    ) from error
  return reaching.ReachingConfig(
    (x, y, z), _KNOTS.value, _DT.value, _SEED.value
  )


def _read_sizes() -> dict[str, float]:
  """Returns the sizes of --sizes by name."""
  sizes: dict[str, float] = {}
  for item in _SIZES.value:
    name, _, value = item.partition(':')
    try:
      sizes[name.strip()] = float(value)
    except ValueError as error:
      raise ValueError(f'--sizes: {item!r} is not NAME:METRES.') from error
  return sizes


def _print(found: planner.PlanResult) -> None:
  for name, seconds in zip(*found.plan.segments(), strict=True):
    print(f'{name}: {seconds:g} s')
  x, _, z = found.final_position
  print(
    f'{"reached" if found.success else "did NOT reach"} the goal: trunk at '
    f'x = {x:.2f}, z = {z:.2f} m; solved in {found.solve_seconds:.1f} s, '
    f'{found.control_steps} control steps'
  )


def main(argv: Sequence[str]) -> int:
  """Plans, prints, writes, draws; returns 0 if the goal was reached."""
  del argv
  out = files.output_file('out', _OUT.value)
  figure = files.output_file('figure', _FIGURE.value)
  found = planner.solve(
    _POLICY.value,
    _ARENA.value,
    _SEED.value,
    _read_problem(),
    _read_sizes(),
    config_flags.read(solver.PLANNERS[_PLANNER.value], _PLANNER.value),
    [pushes_lib.parse(item) for item in _PUSH.value],
    _REPLAN_EVERY.value,
    _THREADS.value,
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
