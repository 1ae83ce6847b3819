"""Measures how well a policy tells two modes apart: mode aliasing.

    python -m benchmarks.paper.aliasing --policy=pi2 --policy=pi2_one_hot \
      --modes=walk_forward,leap_forward --out=aliasing.json

The paper's Fig. mode_alias_colap_dphase, left: with one-hot commands walk and
leap came out with much the same profile of the trunk's height. Separation is
the root mean square of the difference of the two modes' heights at the same
times after their starts, when settled, over that of their references: 1 where
the modes differ as they should, 0 where they are one.
"""

import functools
import pathlib
from typing import Any, Sequence

from absl import flags
import numpy as np

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import figures
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import files

_POLICY = config_flags.define_paths(
  'policy', ['pi2', 'pi2_one_hot'], 'Shipped policies or folders.'
)
_MODES = flags.DEFINE_list(
  'modes', ['walk_forward', 'leap_forward'], 'The two to tell apart.'
)
_EPISODES = flags.DEFINE_integer('episodes', 16, 'Of each mode.', 1)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.', 0)
_OUT = common.define_out()
_FIGURES = config_flags.define_path('figures', None, 'Folder to draw into.')

FIGURE_FILE = 'aliasing.png'
_SETTLED = 1.2  # Seconds after which heights count.


def profiles(
  policy: pretrained.Policy,
  modes: Sequence[str],
  episodes: int,
  seed: int,
) -> dict[str, np.ndarray]:
  """Returns mean heights of the trunk over time, in so many episodes a mode.

  Heights are over the support, metres, of the robot and of the reference,
  [M, T] each; a robot that falls counts where it lies.
  """
  config = task_config.evaluated(policy.config, limits=terminations.NO_LIMITS)
  ids = np.repeat([policy.mode_set.index(name) for name in modes], episodes)
  evaluator = evaluator_lib.Evaluator(policy, config, seed, quiet=True)
  found = evaluator.run(schedule_lib.single(ids), 'profiles')
  result = {}
  for name, key in (('robot', 'position'), ('reference', 'reference')):
    height = (found.traces[key][:, :, 2] - found.traces['support']).T
    result[name] = height.reshape(len(modes), episodes, -1).mean(axis=1)
  return result


def separation(heights: dict[str, np.ndarray], timestep: float) -> float:
  """Returns how far apart the robot's two profiles are, of the references'."""
  settled = round(_SETTLED / timestep)
  apart = lambda rows: np.sqrt(
    np.mean((rows[0, settled:] - rows[1, settled:]) ** 2)
  )
  return float(apart(heights['robot']) / apart(heights['reference']))


def _draw(
  found: dict[str, dict[str, np.ndarray]],
  modes: Sequence[str],
  timestep: float,
) -> Any:
  """Draws the profiles of every policy, and the references'."""
  drawn, (axes,) = figures.empty(1, len(found), 5.0, 3.0)
  for axis, (policy, heights) in zip(axes, found.items(), strict=True):
    times = timestep * np.arange(1, heights['robot'].shape[1] + 1)
    for i, mode in enumerate(modes):
      axis.plot(times, heights['robot'][i], f'C{i}', label=mode)
      axis.plot(times, heights['reference'][i], f'C{i}--', linewidth=0.8)
    axis.set(title=policy, xlabel='time (s)')
    axis.sharey(axes[0])
  axes[0].set_ylabel('height of the trunk (m)')
  axes[0].legend(fontsize='small')
  return drawn


def main(argv: Sequence[str]) -> None:
  """Measures, prints, writes, draws."""
  del argv
  out = files.output_file('out', _OUT.value)
  folder = files.output_folder('figures', _FIGURES.value)
  if len(set(_MODES.value)) != 2 or len(_MODES.value) != 2:
    raise ValueError('--modes must name two modes that differ.')
  found, table, timestep = {}, {}, 0.0
  print(f'{" / ".join(_MODES.value):40}{"separation":>12}')
  for name in _POLICY.value:
    policy = pretrained.load(name)
    timestep = policy.config.control_timestep
    found[name] = profiles(policy, _MODES.value, _EPISODES.value, _SEED.value)
    table[name] = separation(found[name], timestep)
    print(f'{name:40}{table[name]:12.3f}')
  common.write_report(
    out,
    {
      'benchmark': 'aliasing',
      'separation': table,
      'modes': _MODES.value,
      'seed': _SEED.value,
    },
  )
  if folder:
    drawn = _draw(found, _MODES.value, timestep)
    figures.save(pathlib.Path(folder) / FIGURE_FILE, drawn)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
