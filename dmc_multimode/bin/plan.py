r"""Plans a way across a track: which mode to command when.

  python -m dmc_multimode.bin.plan --flagfile=flags/plan_gap.flags \
    --policy=pi2 --out=plan.json --figure=plan.png

A plan is open-loop: with pushes that the planner does not know of, it leads
elsewhere. With --replan_every the planner runs again on the way, from where the
robot then is, and what is written are the modes that were commanded:

  python -m dmc_multimode.bin.plan --flagfile=flags/plan_gap_block.flags \
    --policy=pi2 --push=0.6:-0.5 --replan_every=2 --out=plan.json
"""

import json
from typing import Any, Callable, Sequence

from absl import flags
import numpy as np
import torch
import tqdm

from dmc_multimode import pretrained
from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import track
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import plan_figures
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import replanning
from dmc_multimode.planner import solver as planning
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
  'planner', 'beam', ['beam', 'q_learning'], 'Which planner.'
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

_PLANNERS: dict[str, planning.PlannerConfig] = {
  'beam': beam_search.BeamConfig(),
  'q_learning': q_learning.QLearningConfig(),
}
for _name, _config in _PLANNERS.items():
  config_flags.define(_config, _name)


def read_config() -> reaching.ReachingConfig:
  """Returns the problem that the flags describe."""
  try:
    x, y, z = (float(value) for value in _GOAL.value)
  except ValueError as error:
    raise ValueError(
      f'--goal={",".join(_GOAL.value)} is not X,Y,Z in metres.'
    ) from error
  return reaching.ReachingConfig(
    (x, y, z), _KNOTS.value, _DT.value, _SEED.value
  )


def read_sizes() -> dict[str, float]:
  """Returns the sizes that --sizes gives."""
  sizes: dict[str, float] = {}
  for item in _SIZES.value:
    name, _, value = item.partition(':')
    try:
      sizes[name.strip()] = float(value)
    except ValueError as error:
      raise ValueError(f'--sizes: {item!r} is not NAME:METRES.') from error
  return sizes


def read_pushes(
  config: reaching.ReachingConfig,
) -> tuple[pushes_lib.Push, ...]:
  """Returns the pushes that --push gives; all are at knots of the problem."""
  try:
    pushes = tuple(pushes_lib.parse(item) for item in _PUSH.value)
    pushes_lib.by_knot(pushes, config.knots, config.knot_duration)
  except ValueError as error:
    raise ValueError(f'--push: {error}') from error
  return pushes


def read_replan_every() -> int:
  """Returns --replan_every."""
  if _REPLAN_EVERY.value < 0:
    raise ValueError(
      f'--replan_every must not be negative, got {_REPLAN_EVERY.value}.'
    )
  return _REPLAN_EVERY.value


def describe(
  found: planning.Found,
  config: reaching.ReachingConfig,
  sizes: dict[str, float],
  pushes: Sequence[pushes_lib.Push],
) -> dict[str, Any]:
  """Returns what is written to --out."""
  return {
    'success': found.success,
    'final_position': [float(value) for value in found.final_position],
    'goal': list(config.goal),
    'return': found.episode_return,
    'solve_seconds': found.solve_seconds,
    'rollouts': found.rollouts,
    'control_steps': found.control_steps,
    **plan_lib.to_dict(found.plan),
    'arena': _ARENA.value,
    'sizes': sizes,
    'seed': config.seed,
    'pushes': pushes_lib.to_list(pushes),
    'replan_every': _REPLAN_EVERY.value,
    'planner': _PLANNER.value,
    'policy': _POLICY.value,
  }


def _solve(
  policy: pretrained.Policy,
  make_arena: Callable[[], track.Track],
  config: reaching.ReachingConfig,
  pushes: Sequence[pushes_lib.Push],
  replan_every: int,
) -> planning.Found:
  """Plans under a progress bar, which begins anew with every search."""
  planner = config_flags.read(_PLANNERS[_PLANNER.value], _PLANNER.value)
  solver = planning.Solver(policy, make_arena, config, planner, _THREADS.value)
  is_beam = isinstance(planner, beam_search.BeamConfig)
  bar = tqdm.tqdm(unit='knot' if is_beam else 'episode')

  def report(status: planning.Status) -> None:
    if status.done <= bar.n:
      bar.reset()
    bar.total = status.total
    bar.set_description(status.search, refresh=False)
    bar.set_postfix_str(
      f'return {status.best:.1f}, {status.distance:.2f} m to go', refresh=False
    )
    bar.update(status.done - bar.n)

  with bar:
    return replanning.solve(solver, pushes, replan_every, report)


def _print(found: planning.Found) -> None:
  for name, seconds in zip(*found.plan.segments(), strict=True):
    print(f'{name}: {seconds:g} s')
  x, _, z = found.final_position
  print(
    f'{"reached" if found.success else "did NOT reach"} the goal: trunk at '
    f'x = {x:.2f}, z = {z:.2f} m; solved in {found.solve_seconds:.1f} s, '
    f'{found.control_steps} control steps'
  )


def main(argv: Sequence[str]) -> int:
  """Plans, prints, writes, draws; returns whether the goal was reached."""
  del argv
  out = files.output_file('out', _OUT.value)
  figure = files.output_file('figure', _FIGURE.value)
  config, sizes = read_config(), read_sizes()
  pushes, replan_every = read_pushes(config), read_replan_every()
  make_arena = lambda: track.make(_ARENA.value, sizes=sizes)
  terrain = make_arena().generate(np.random.RandomState(config.seed))
  policy = pretrained.load(_POLICY.value)
  torch.set_num_threads(1)  # Batches are small; the physics has the cores.
  found = _solve(policy, make_arena, config, pushes, replan_every)
  _print(found)
  if out:
    out.parent.mkdir(parents=True, exist_ok=True)
    values = describe(found, config, sizes, pushes)
    files.write(out, json.dumps(values, indent=1).encode())
    print(f'The plan is in {out}')
  if figure:
    step = policy.config.control_timestep
    drawn = plan_figures.draw(found.plan, found.path, step, terrain, pushes)
    figures.save(figure, drawn)
    print(f'The figure is in {figure}')
  return 0 if found.success else app.EXIT_UNSOLVED


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
