"""What a policy withstands: physics steps, edges, masses, friction, pushes.

    python -m benchmarks.reliability.robustness --policy=pi2 --out=FILE.json

Everything is judged by the code of `dmc_multimode.bin.evaluate`, each case
apart: the physics in finer steps than in training; the edges of blocks nearer
or farther than the references have them; all masses and inertias, or all
sliding friction, higher or lower; pushes, which change the trunk's velocity by
0.3 m/s in a random horizontal direction once a second; and obstacles, which
every command meets that can: gaps under leaps, other blocks, steps ahead of
gaits.
"""

import dataclasses
import pathlib
import sys
from typing import Any, Sequence

from absl import flags
import mujoco
import numpy as np
import tqdm

from benchmarks import common
from benchmarks.reliability import robustness_cases
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.evaluation import evaluator as scoring
from dmc_multimode.evaluation import scores
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import events

_POLICY = flags.DEFINE_string(
  'policy', 'pi2', 'Name of a shipped policy, or a folder.'
)
_CASES = flags.DEFINE_list('cases', None, 'Names; all by default.')
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Like those of `evaluate`.', lower_bound=1
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of initial states and pushes.', 0)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')

Row = dict[str, Any]


class Evaluator(scoring.Evaluator):
  """Evaluates in a `Case`."""

  def __init__(
    self, case: robustness_cases.Case, policy: pretrained.Policy, seed: int
  ):
    """Evaluates `policy` from rest."""
    config = dataclasses.replace(policy.config, events=events.NONE)
    if case.physics_timestep is not None:
      config = dataclasses.replace(
        config, physics_timestep=case.physics_timestep
      )
    super().__init__(policy, config, seed, quiet=True)
    self._case = case

  def make_worlds(
    self, schedule: schedule_lib.ModeSchedule
  ) -> robustness_cases.Worlds:
    """Returns a world of the case for each row of `schedule`."""
    return robustness_cases.Worlds(
      self._case, self.policy, schedule, self.config, self.seed
    )


def judge(
  name: str, policy: pretrained.Policy, episodes: int, seed: int
) -> Row:
  """Returns the scores of `policy` in a case."""
  evaluator = Evaluator(robustness_cases.CASES[name], policy, seed)
  modes = scores.evaluate_modes(
    evaluator, scores.MODE_FACTOR * episodes, clock_rate=1.0
  )
  transitions = scores.evaluate_transitions(evaluator, episodes)
  row: Row = {'name': name}
  for kind, found in (('modes', modes), ('transitions', transitions)):
    for key in ('mra', 'survival'):
      values = {case: result[key] for case, result in found.items()}
      row[f'{key}_{kind}'] = float(np.mean(list(values.values())))
    row[f'worst_{kind}'] = min(found, key=lambda case: found[case]['mra'])
  return row


def _line(row: Row) -> str:
  return (
    f'{row["name"]:20}{row["mra_modes"]:9.3f}{row["mra_transitions"]:13.3f}'
    f'{row["survival_modes"]:10.3f}{row["survival_transitions"]:13.3f}'
    f'  {row["worst_transitions"]}'
  )


def _chosen() -> list[str]:
  """Returns the names of --cases; raises ValueError if one is unknown."""
  known = list(robustness_cases.CASES)
  names = _CASES.value or known
  for name in names:
    if name not in known:
      raise ValueError(f'--cases: {name!r} is not one of {", ".join(known)}.')
  return list(dict.fromkeys(names))


def _write(out: pathlib.Path | None, rows: Sequence[Row]) -> None:
  report = {
    'benchmark': 'robustness',
    'table': list(rows),
    'policy': _POLICY.value,
    'episodes': _EPISODES.value,
    'seed': _SEED.value,
  }
  common.write_report(out, report)


def main(argv: Sequence[str]) -> None:
  """Evaluates, prints, writes."""
  del argv
  out, names = common.out_path(_OUT.value), _chosen()
  policy = pretrained.load(_POLICY.value)
  print(f'{_POLICY.value}, mujoco {mujoco.__version__}')
  rows: list[Row] = []
  for name in tqdm.tqdm(names, unit='case'):
    rows.append(judge(name, policy, _EPISODES.value, _SEED.value))
    tqdm.tqdm.write(_line(rows[-1]), sys.stderr)
    _write(out, rows)
  print(
    f'{"":20}{"MRA modes":>9}{"transitions":>13}{"survival":>10}'
    f'{"transitions":>13}  worst transition'
  )
  for row in rows:
    print(_line(row))


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
