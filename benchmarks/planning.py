"""How plans are found: the paper's tracks (Table III), and random ones.

    python -m benchmarks.planning --policy=pi2 --out=planning.json

Every track of the paper is planned for from `--seeds` starts, which differ in
the noise on joints, tilt and velocities; then `--random` tracks with a gap, a
plateau and a block of random sizes in random order (`parkour`), from end to
end. Seconds are from the first roll-out to the last; steps are control steps of
all worlds together. The paper's times are its own, on another machine.
"""

import pathlib
import statistics
import sys
from typing import Any, Mapping, NamedTuple, Sequence

from absl import flags
import mujoco
import numpy as np
import torch
import tqdm

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.bin import app
from dmc_multimode.modes import library
from dmc_multimode.planner import planning
from dmc_multimode.planner import problem
from dmc_multimode.planner import q_learning
from dmc_multimode.planner import search

_POLICY = flags.DEFINE_string(
  'policy', 'pi2', 'Name of a shipped policy, or a folder.'
)
_PLANNERS = flags.DEFINE_list('planners', ['beam', 'q_learning'], 'Which.')
_SEEDS = flags.DEFINE_integer('seeds', 5, 'Starts on each track.', 0)
_RANDOM = flags.DEFINE_integer(
  'random', 100, 'Random tracks, for the first planner alone.', 0
)
_BEAMS = flags.DEFINE_integer(
  'beams', search.BeamConfig().beams, 'Of the beam search.', 1
)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')

_RANDOM_NAME = 'parkour'
_BEYOND = 0.4  # Metres behind the last edge of a random track: the goal.
_SPEED = 0.3  # m/s at least that time is left for.
_RANDOM_DT = 0.15  # Seconds.

Row = dict[str, Any]


class Problem(NamedTuple):
  """A row of Table III.

  Attributes:
    goal: of the trunk, metres.
    knots: of a plan.
    dt: seconds from knot to knot.
    paper: solve time in the paper, seconds.
  """

  goal: tuple[float, float, float]
  knots: int
  dt: float
  paper: float


PROBLEMS: Mapping[str, Problem] = {
  'gap': Problem((2.0, 0.0, 0.5), 11, 0.3, 185.0),
  'plateau': Problem((2.0, 0.0, 0.5), 11, 0.3, 213.0),
  'gap_block': Problem((2.0, 0.0, 0.9), 30, 0.15, 161.0),
}


def random_problem(seed: int) -> Problem:
  """Returns how to cross the random track of a seed."""
  terrain = track.make(_RANDOM_NAME).generate(np.random.RandomState(seed))
  last = np.flatnonzero(np.isfinite(terrain.starts[0]))[-1]
  x = float(terrain.starts[0, last]) + _BEYOND
  z = float(terrain.tops[0, last]) + library.STAND_HEIGHT
  return Problem((x, 0.0, z), round(x / _SPEED / _RANDOM_DT), _RANDOM_DT, 0.0)


def solve(
  policy: pretrained.Policy,
  name: str,
  wanted: Problem,
  seed: int,
  planner: planning.PlannerConfig,
) -> Row:
  """Returns what a planner finds on a track."""
  config = problem.ReachingConfig(wanted.goal, wanted.knots, wanted.dt, seed)
  make_arena = lambda: track.make(name)
  found = planning.Solver(policy, make_arena, config, planner).solve()
  return {
    'track': name,
    'seed': seed,
    'planner': 'beam'
    if isinstance(planner, search.BeamConfig)
    else ('q_learning'),
    'success': found.success,
    'return': found.episode_return,
    'solve_seconds': found.solve_seconds,
    'control_steps': found.control_steps,
    'goal': list(wanted.goal),
    'final_position': found.final_position.tolist(),
    'plan': list(found.plan.modes),
  }


def summary(rows: Sequence[Row]) -> Row:
  """Returns the row of the table for plans of one track and planner."""
  median = lambda key: float(statistics.median(row[key] for row in rows))
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
    'paper_seconds': (
      PROBLEMS[rows[0]['track']].paper if rows[0]['track'] in PROBLEMS else None
    ),
  }


def _line(row: Row) -> str:
  paper = row['paper_seconds']
  solved = f'{row["solved"]} of {row["of"]}'
  return (
    f'{row["track"]:12}{row["planner"]:12}{solved:>12}{row["return"]:9.1f}'
    f'{row["solve_seconds"]:9.2f}{row["steps_per_second"]:10.0f}'
    f'{"" if paper is None else format(paper, ".0f"):>9}'
  )


def _planners() -> dict[str, planning.PlannerConfig]:
  """Returns --planners; raises ValueError if one is unknown."""
  known: dict[str, planning.PlannerConfig] = {
    'beam': search.BeamConfig(_BEAMS.value),
    'q_learning': q_learning.QLearningConfig(),
  }
  for name in _PLANNERS.value:
    if name not in known:
      raise ValueError(
        f'--planners: {name!r} is not one of {", ".join(known)}.'
      )
  return {name: known[name] for name in _PLANNERS.value}


def _cases() -> list[tuple[str, Problem, int, planning.PlannerConfig]]:
  """Returns track, problem, seed and planner of every plan to be found."""
  planners = list(_planners().values())
  cases = [
    (name, wanted, seed, planner)
    for planner in planners
    for name, wanted in PROBLEMS.items()
    for seed in range(_SEEDS.value)
  ]
  for seed in range(_RANDOM.value):
    cases.append((_RANDOM_NAME, random_problem(seed), seed, planners[0]))
  return cases


def _write(out: pathlib.Path | None, rows: Sequence[Row]) -> None:
  report = {
    'benchmark': 'planning',
    'table': [summary(group) for group in _groups(rows)],
    'plans': list(rows),
    'policy': _POLICY.value,
    'beams': _BEAMS.value,
  }
  common.write_report(out, report)


def _groups(rows: Sequence[Row]) -> list[list[Row]]:
  groups: dict[tuple[str, str], list[Row]] = {}
  for row in rows:
    groups.setdefault((row['track'], row['planner']), []).append(row)
  return list(groups.values())


def main(argv: Sequence[str]) -> None:
  """Plans, prints, writes."""
  del argv
  out, cases = common.out_path(_OUT.value), _cases()
  policy = pretrained.load(_POLICY.value)
  torch.set_num_threads(1)  # As `plan` does.
  print(f'{_POLICY.value}, {common.CORES} cores, mujoco {mujoco.__version__}')
  rows: list[Row] = []
  for name, wanted, seed, planner in tqdm.tqdm(cases, unit='plan'):
    rows.append(solve(policy, name, wanted, seed, planner))
    if not rows[-1]['success']:
      x, _, z = rows[-1]['final_position']
      tqdm.tqdm.write(
        f'{name} {seed}: not solved, x = {x:.2f} of {wanted.goal[0]:.2f}, '
        f'z = {z:.2f} m',
        sys.stderr,
      )
    _write(out, rows)
  print(
    f'{"track":12}{"planner":12}{"solved":>12}{"return":>9}{"seconds":>9}'
    f'{"steps/s":>10}{"paper s":>9}'
  )
  for group in _groups(rows):
    print(_line(summary(group)))


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
