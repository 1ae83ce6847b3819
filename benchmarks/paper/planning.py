"""Plans across the paper's tracks (Table III), and random ones.

    python -m benchmarks.paper.planning --policy=pi2 --out=planning.json

Every track of the paper is planned for from `--seeds` starts, which differ in
the noise on joints, tilt and velocities; then `--random` tracks with a gap, a
plateau and a block of random sizes in random order (`parkour`), from end to
end, or `--random_track`, pushed by `--push_speed` or not. Seconds are from the
first roll-out to the last; steps are control steps of all worlds together. The
paper's times are its own, on another machine.
`--seconds` is the budget of every plan, in place of a number of attempts; plans
then depend on the machine.

Under `torchrun` in place of `python`, several processes share the tracks; each
plans on its share of the cores, so that seconds grow and plans stay.
"""

import functools
import itertools
import json
import operator
import pathlib
import sys
from typing import Sequence

from absl import flags
import mujoco
import numpy as np

from benchmarks import common
from dmc_multimode import planner as planner_lib
from dmc_multimode import pretrained
from dmc_multimode.agents import distributed
from dmc_multimode.bin import app
from dmc_multimode.experiments import launch
from dmc_multimode.planner import beam_search
from dmc_multimode.planner import guided_search
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

_POLICY = common.define_policy()
_PLANNERS = flags.DEFINE_list('planners', ['beam', 'q_learning'], 'Which.')
_SEEDS = flags.DEFINE_integer('seeds', 5, 'Starts on each track.', 0)
_RANDOM = flags.DEFINE_integer(
  'random', 100, 'Random tracks, for the first planner alone.', 0
)
_TRACK = flags.DEFINE_string(
  'random_track', reaching.RANDOM_TRACK, 'Which random tracks.'
)
_PUSH_SPEED = flags.DEFINE_float(
  'push_speed', 0.0, 'Of pushes about once a second on random tracks, m/s.', 0.0
)
_BEAMS = flags.DEFINE_integer(
  'beams', beam_search.BeamConfig().beams, 'Of the beam search.', 1
)
_SECONDS = flags.DEFINE_float(
  'seconds', None, 'Wall-clock budget of a beam search; none by default.'
)
_SELECTOR = common.define_selector()
_OUT = common.define_out()

_COLUMNS = (
  'track | planner | solved:d | of:d | return:.1f | '
  'seconds=solve_seconds:.2f | steps/s=steps_per_second:.0f | '
  'paper s=paper_seconds:.0f'
)

Row = common.Row


def solve(
  policy: str,
  name: str,
  config: reaching.ReachingConfig,
  planner: solver_lib.PlannerConfig,
  threads: int = 0,
  seconds: float | None = None,
) -> Row:
  """Returns what a planner finds on a track, with threads or all cores."""
  pushes: Sequence[planner_lib.Push] = ()
  if name == _TRACK.value:
    knots = config.knots, config.knot_duration
    pushes = pushes_lib.draw(_PUSH_SPEED.value, *knots, config.seed)
  found = planner_lib.solve(
    policy,
    name,
    config.seed,
    config,
    planner=planner,
    pushes=pushes,
    num_threads=threads,
    quiet=True,
    seconds=seconds,
  )
  return {
    'track': name,
    'seed': config.seed,
    'planner': solver_lib.name_of(planner),
    'success': found.success,
    'return': found.episode_return,
    'solve_seconds': found.solve_seconds,
    'control_steps': found.control_steps,
    'goal': list(config.goal),
    'final_position': found.final_position.tolist(),
    'plan': list(found.plan.modes),
    **{k: v for k, v in found.origin.items() if k.startswith('decision')},
  }


def summary(rows: Sequence[Row]) -> Row:
  """Returns the row of the table for plans of one track and planner."""
  problem = reaching.PROBLEMS.get(rows[0]['track'])
  median = lambda key: float(np.median([row[key] for row in rows]))
  seconds = sum(row['solve_seconds'] for row in rows)
  steps = sum(row['control_steps'] for row in rows)
  return {
    'track': rows[0]['track'],
    'planner': rows[0]['planner'],
    'solved': sum(row['success'] for row in rows),
    'of': len(rows),
    'return': median('return'),
    'solve_seconds': median('solve_seconds'),
    'steps_per_second': steps / seconds,
    'paper_seconds': getattr(problem, 'paper_seconds', None),
  }


def _planners() -> dict[str, solver_lib.PlannerConfig]:
  """Returns --planners.

  Raises:
    ValueError: one is unknown, or takes no --seconds.
  """
  known: dict[str, solver_lib.PlannerConfig] = {
    'beam': beam_search.BeamConfig(_BEAMS.value),
    'guided': guided_search.GuidedConfig(folder=_SELECTOR.value),
    'q_learning': q_learning.QLearningConfig(),
    'selector': steering.SteeringConfig(_SELECTOR.value),
  }
  for name in _PLANNERS.value:
    if name not in known:
      raise ValueError(
        f'--planners: {name!r} is not one of {", ".join(known)}.'
      )
    solver_lib.check_seconds(_SECONDS.value, known[name])
  return {name: known[name] for name in _PLANNERS.value}


def _cases() -> list[
  tuple[str, reaching.ReachingConfig, solver_lib.PlannerConfig]
]:
  """Returns track, problem and planner of every plan to be found."""
  planners = list(_planners().values())
  cases = [
    (name, wanted.config(seed), planner)
    for planner in planners
    for name, wanted in reaching.PROBLEMS.items()
    for seed in range(_SEEDS.value)
  ]
  return cases + [
    (
      _TRACK.value,
      reaching.random_problem(seed, _TRACK.value),
      planners[0],
    )
    for seed in range(_RANDOM.value)
  ]


def _write(out: pathlib.Path | None, rows: Sequence[Row]) -> None:
  report = {
    'benchmark': 'planning',
    'table': [summary(group) for group in _groups(rows)],
    'plans': list(rows),
    'policy': _POLICY.value,
    'beams': _BEAMS.value,
    'seconds': _SECONDS.value,
  }
  common.write_report(out, report)


def _groups(rows: Sequence[Row]) -> list[list[Row]]:
  key = operator.itemgetter('planner', 'track')
  return [list(group) for _, group in itertools.groupby(rows, key)]


def _of_all_ranks(
  communicator: distributed.Communicator, mine: Sequence[Row]
) -> list[Row]:
  """Returns the rows of all cases in order at rank 0, and none elsewhere."""
  parts = communicator.collect(json.dumps(mine).encode())
  rows = [json.loads(part) for part in parts]
  count = sum(len(part) for part in rows)
  return [rows[i % len(rows)][i // len(rows)] for i in range(count)]


def _plan(communicator: distributed.Communicator) -> None:
  """Plans for every rank's share of the cases; rank 0 prints and writes."""
  out, cases = files.output_file('out', _OUT.value), _cases()
  pretrained.load(_POLICY.value)  # An error before the first plan.
  is_first, is_alone = communicator.rank == 0, communicator.size == 1
  threads = 0 if is_alone else distributed.local_cores()
  if is_first:
    print(f'{_POLICY.value}, {common.CORES} cores, mujoco {mujoco.__version__}')
  rows: list[Row] = []
  mine = cases[communicator.rank :: communicator.size]
  for name, config, planner in progress_bar.Bar(
    mine, unit='plan', disable=not is_first
  ):
    rows.append(
      solve(_POLICY.value, name, config, planner, threads, _SECONDS.value)
    )
    if not rows[-1]['success']:
      x, _, z = rows[-1]['final_position']
      progress_bar.Bar.write(
        f'{name} {config.seed}: not solved, x = {x:.2f} of '
        f'{config.goal[0]:.2f}, z = {z:.2f} m',
        sys.stderr,
      )
    if is_alone:
      _write(out, rows)
  rows = _of_all_ranks(communicator, rows)
  if is_first:
    _write(out, rows)
    common.print_table(_COLUMNS, map(summary, _groups(rows)))


def main(argv: Sequence[str]) -> int:
  """Plans, prints, writes, with the other ranks if there are any."""
  del argv
  return launch.run(_plan)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
