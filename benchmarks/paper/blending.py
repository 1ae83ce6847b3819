"""Measures the velocity of blends of two modes: do latents carry attributes?

    python -m benchmarks.paper.blending --policy=pi1 --figures=figures

A blend commands the weighted mean of two latents, `walk_forward*0.3+idle*0.7`.
The paper claims that its latent space has the attributes of motions in it, so
that what lies between two modes is a motion between them. Each pair of --modes
is commanded in shares of the second from 0 to 1; the velocity is that of the
trunk along world x and y, once settled, of robots whose episodes only a fall
ends. That of the reference is the weighted mean of the two modes'.
"""

import dataclasses
import functools
import pathlib
from typing import Sequence

from absl import flags
import matplotlib.figure
import numpy as np

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import figures
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import files

_POLICY = config_flags.define_paths(
  'policy', ['pi1'], 'Shipped policies or folders.'
)
_MODES = flags.DEFINE_multi_string(
  'modes',
  ['idle,walk_forward', 'walk_forward,walk_left'],
  'Two modes to blend, with a comma; repeated, several pairs.',
)
_SHARES = flags.DEFINE_integer('shares', 11, 'Of each pair, 0 and 1 too.', 2)
_EPISODES = flags.DEFINE_integer('episodes', 16, 'Of each blend.', 1)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.', 0)
_OUT = common.define_out()
_FIGURES = config_flags.define_path('figures', None, 'Folder to draw into.')

FIGURE_FILE = 'blending.png'
_COLUMNS = (
  '=blend | share:.2f | vx=velocity_x:.3f | vy=velocity_y:.3f | '
  'reference vx=reference_x:.3f | vy=reference_y:.3f | survival:.3f'
)

Row = common.Row


def names(first: str, second: str, shares: Sequence[float]) -> list[str]:
  """Returns the blends of two modes by the share of the second, in [0, 1]."""
  found = {0.0: first, 1.0: second}
  for share in shares:
    mine, rest = round(share, 4), round(1 - round(share, 4), 4)
    found.setdefault(mine, f'{first}*{rest:g}+{second}*{mine:g}')
  return [found[round(share, 4)] for share in shares]


def measure(
  policy: pretrained.Policy,
  modes: tuple[str, str],
  shares: Sequence[float],
  episodes: int,
  seed: int,
) -> list[Row]:
  """Returns velocities of the blends of two modes, a row each.

  Args:
    policy: that is commanded.
    modes: first and second.
    shares: of the second, in [0, 1].
    episodes: of each blend; a fall ends one.
    seed: of the initial states.

  Raises:
    ValueError: the policy has no such mode, or the two cannot be blended.
  """
  blends = names(*modes, shares)
  policy = dataclasses.replace(
    policy, mode_set=mode_set_lib.with_blends(policy.mode_set, blends)
  )
  config = task_config.evaluated(
    policy.config, limits=terminations.falls_alone(policy.config.limits)
  )
  ids = np.array([policy.mode_set.index(name) for name in blends])
  evaluator = evaluator_lib.Evaluator(policy, config, seed, quiet=True)
  found = evaluator.run(schedule_lib.single(np.repeat(ids, episodes)), 'blends')
  rows = []
  for i, name in enumerate(blends):
    mine = found.rows(np.arange(i * episodes, (i + 1) * episodes))
    traces = evaluator.traces(mine, policy.mode_set.bank.durations[ids[i]])
    settled = {
      key: np.mean([t.velocity(getattr(t, key))[:2] for t in traces], axis=0)
      for key in ('position', 'reference')
    }
    rows.append(
      {
        'blend': name,
        'share': float(shares[i]),
        'velocity_x': float(settled['position'][0]),
        'velocity_y': float(settled['position'][1]),
        'reference_x': float(settled['reference'][0]),
        'reference_y': float(settled['reference'][1]),
        'survival': float(mine.survived.mean()),
      }
    )
  return rows


def _draw(
  found: dict[str, dict[str, list[Row]]],
) -> matplotlib.figure.Figure:
  """Draws velocities over shares: a row a policy, a column a pair."""
  pairs = [*next(iter(found.values()))]
  drawn, grid = figures.empty(len(found), len(pairs), 4.5, 3.0)
  for axes, (policy, by_pair) in zip(grid, found.items(), strict=True):
    for axis, (pair, rows) in zip(axes, by_pair.items(), strict=True):
      shares = [row['share'] for row in rows]
      for key, style in (('velocity', 'o-'), ('reference', '--')):
        who = 'robot' if key == 'velocity' else 'reference'
        for colour, way in (('C0', 'x'), ('C1', 'y')):
          speeds = [row[f'{key}_{way}'] for row in rows]
          label = f'{who}, {way}'
          axis.plot(shares, speeds, style, color=colour, label=label)
      fallen = [row['share'] for row in rows if row['survival'] < 1]
      if fallen:
        axis.plot(fallen, [0.0] * len(fallen), 'kx', label='some fell')
      first, second = pair.split(',')
      axis.set(title=policy, xlabel=f'{first} to {second}: share of the second')
    axes[0].set_ylabel('velocity (m/s)')
  grid[0][0].legend(fontsize='small')
  return drawn


def _pairs() -> list[tuple[str, str]]:
  """Returns --modes; raises ValueError in one line if one is no pair."""
  pairs = []
  for text in _MODES.value:
    first, comma, second = text.partition(',')
    if not (first and comma and second) or ',' in second or first == second:
      raise ValueError(f'--modes={text!r} must name two modes that differ.')
    pairs.append((first, second))
  return pairs


def main(argv: Sequence[str]) -> None:
  """Measures, prints, writes, draws."""
  del argv
  out = files.output_file('out', _OUT.value)
  folder = files.output_folder('figures', _FIGURES.value)
  pairs = _pairs()
  shares = np.linspace(0.0, 1.0, _SHARES.value).tolist()
  found: dict[str, dict[str, list[Row]]] = {}
  for name in _POLICY.value:
    policy, found[name] = pretrained.load(name), {}
    for pair in pairs:
      rows = measure(policy, pair, shares, _EPISODES.value, _SEED.value)
      found[name][','.join(pair)] = rows
      print(name)
      common.print_table(_COLUMNS, rows)
  common.write_report(
    out,
    {
      'benchmark': 'blending',
      'blends': found,
      'episodes': _EPISODES.value,
      'seed': _SEED.value,
    },
  )
  if folder:
    figures.save(pathlib.Path(folder) / FIGURE_FILE, _draw(found))


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
