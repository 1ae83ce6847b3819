"""Trainings that are killed, starved and lied to: what is lost?

    python -m benchmarks.reliability.faults --out=faults.json

A tiny training of `dmc_multimode.bin.train` is disturbed in every way that
`fault_cases` has, resumed, and compared with the same training undisturbed: a
hash of everything that a checkpoint holds, after every single iteration. What
is counted:

- cases: how often the fault happened;
- explained: how often the process ended as documented: with that exit code, and
  where it is an error with one line that says so, and no traceback;
- states: iterations whose state was compared; different: not the same bits;
- lost: whole checkpoints that a resumed run did not go on from (a damaged one
  does not count); again: the most iterations that had to be done again.

Some faults need root: small disks are mounted, and the process whose folder is
read-only is another user's. They are skipped elsewhere, with the reason. Ends
with 3 if anything is lost, different or unexplained.
"""

import pathlib
import tempfile
from typing import Any, Callable, Mapping, Sequence

from absl import flags
import tqdm

from benchmarks import common
from benchmarks.reliability import fault_cases
from dmc_multimode.bin import app

_KILLS = flags.DEFINE_integer('kills', 50, 'Half of them in checkpoints.', 2)
_CASES = flags.DEFINE_integer('cases', 3, 'Of each other random fault.', 1)
_ONLY = flags.DEFINE_list('only', None, 'Names of faults; all by default.')
_SEED = flags.DEFINE_integer('seed', 0, 'Of the moments.', 0)
_FOLDER = flags.DEFINE_string(
  'folder', None, 'Where to work; by default a temporary folder.'
)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')

Fault = Callable[[fault_cases.Campaign], fault_cases.Row]


def _faults() -> Mapping[str, Fault]:
  """Returns all faults by name."""
  kills, cases = _KILLS.value // 2, _CASES.value
  return {
    'killed': lambda campaign: campaign.killed(_KILLS.value - kills),
    'killed_in_checkpoint': lambda c: c.killed_in_checkpoint(kills),
    'sigterm': lambda campaign: campaign.asked_to_stop('SIGTERM', cases),
    'sigint': lambda campaign: campaign.asked_to_stop('SIGINT', cases),
    'sigint_twice': lambda campaign: campaign.interrupted_twice(cases),
    'disk_full': fault_cases.Campaign.disk_full,
    'folder_gone': fault_cases.Campaign.folder_gone,
    'folder_read_only': fault_cases.Campaign.folder_read_only,
    'clock_jumps': lambda campaign: campaign.clock_jumps(cases),
    'world_nan': lambda campaign: campaign.world_nan(cases),
    'worlds_nan': fault_cases.Campaign.worlds_nan,
    'reward_nan': fault_cases.Campaign.reward_nan,
    'newest_damaged': fault_cases.Campaign.newest_damaged,
    'both_damaged': fault_cases.Campaign.both_damaged,
  }


def _chosen() -> Mapping[str, Fault]:
  """Returns --only; raises ValueError for what is not there."""
  known = _faults()
  names = _ONLY.value if _ONLY.value is not None else list(known)
  unknown = [name for name in names if name not in known]
  if unknown:
    raise ValueError(
      f'--only: there is no {unknown[0]!r}; there are {", ".join(known)}.'
    )
  return {name: known[name] for name in names}


def run(folder: pathlib.Path) -> list[fault_cases.Row]:
  """Runs the faults in a folder; returns the rows of the table."""
  chosen = _chosen()
  campaign = fault_cases.Campaign(folder, _SEED.value)
  rows = []
  try:
    for name, fault in tqdm.tqdm(chosen.items(), unit='fault'):
      try:
        rows.append(fault(campaign))
      except fault_cases.Skipped as error:
        rows.append(fault_cases.Row(name, skipped=str(error)))
      tqdm.tqdm.write(_line(rows[-1]))
  finally:
    campaign.close()
  return rows


_TITLES = ('cases', 'explained', 'states', 'different', 'lost', 'again')


def _values(row: fault_cases.Row) -> tuple[int, ...]:
  return (
    row.cases,
    row.explained,
    row.compared,
    row.different,
    row.checkpoints_lost,
    row.most_lost,
  )


def _line(row: fault_cases.Row) -> str:
  if row.skipped:
    return f'{row.fault:40}  skipped: {row.skipped}'
  cells = ''.join(f'{value:11}' for value in _values(row))
  return '\n'.join([f'{row.fault:40}{cells}', *row.problems])


def _failed(row: fault_cases.Row) -> bool:
  whole = row.explained == row.cases
  bad = row.problems or row.different or row.checkpoints_lost
  return bool(bad) or not whole


def main(argv: Sequence[str]) -> int:
  """Runs, prints, writes; returns whether all is well."""
  del argv
  out = common.out_path(_OUT.value)
  with tempfile.TemporaryDirectory(dir=_FOLDER.value) as folder:
    rows = run(pathlib.Path(folder))
  print(f'{"fault":40}' + ''.join(f'{title:>11}' for title in _TITLES))
  for row in rows:
    print(_line(row))
  total = [sum(column) for column in zip(*map(_values, rows), strict=True)]
  print(
    f'{total[0]} faults: {total[4]} checkpoints lost, {total[3]} states '
    f'different of {total[2]}, {total[0] - total[1]} ends unexplained.'
  )
  report: dict[str, Any] = {
    'benchmark': 'faults',
    'table': [vars(row) for row in rows],
    'kills': _KILLS.value,
    'seed': _SEED.value,
  }
  common.write_report(out, report)
  return app.EXIT_UNSOLVED if any(map(_failed, rows)) else 0


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
