"""One multimodal policy against unimodal ones that are switched hard.

    python -m benchmarks.paper.switching --policy=pi2 \
      --before=unimodal_walk --after=unimodal_launch --out=switching.json

The paper's Fig. ma_mc_vis, right: walk, then launch onto a block. The command
comes at 20 phases of the walk, on the same starts for both. A switch has
succeeded when the robot stands on the block, on both feet, the trunk within 8
cm of its height over it, for a second; see `evaluation.acceptance`.
"""

import dataclasses
import pathlib
from typing import Any, Sequence

from absl import flags
import numpy as np

from benchmarks import common
from benchmarks.paper import hard_switch
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.evaluation import evaluator
from dmc_multimode.evaluation import figures
from dmc_multimode.suite.imitation import events
from dmc_multimode.utils import files

_POLICY = flags.DEFINE_string('policy', 'pi2', 'The multimodal policy.')
_BEFORE = flags.DEFINE_string(
  'before', 'unimodal_walk', 'The unimodal policy that runs first.'
)
_AFTER = flags.DEFINE_string(
  'after', 'unimodal_launch', 'The unimodal policy that is switched to.'
)
_PHASES = flags.DEFINE_integer(
  'phases', 20, 'Of the first mode at which the switch is tried.', 1
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.', 0)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')
_FIGURES = flags.DEFINE_string('figures', None, 'Folder to draw into.')

FIGURE_FILE = 'switching.png'


def _draw(
  heights: dict[str, np.ndarray], timestep: float, switch: float
) -> Any:
  """Draws the heights of the trunk in the switch at the middle phase."""
  drawn, ((axis,),) = figures.empty(1, 1, 7.0, 3.0)
  for i, (name, height) in enumerate(heights.items()):
    times = timestep * np.arange(1, len(height) + 1)
    axis.plot(times, height[:, height.shape[1] // 2], f'C{i}', label=name)
  axis.axvline(switch, color='0.5', linewidth=0.8)
  axis.set(xlabel='time (s)', ylabel='height of the trunk (m)')
  axis.legend(fontsize='small')
  return drawn


def main(argv: Sequence[str]) -> None:
  """Switches, prints, writes, draws."""
  del argv
  out = common.out_path(_OUT.value)
  folder = files.output_folder('figures', _FIGURES.value)
  multimodal = pretrained.load(_POLICY.value)
  unimodal = [pretrained.load(name) for name in (_BEFORE.value, _AFTER.value)]
  switched = hard_switch.HardSwitch(unimodal)
  first, second = switched.mode_set.names
  config = dataclasses.replace(multimodal.config, events=events.NONE)
  policies: dict[str, evaluator.Policy] = {
    _POLICY.value: multimodal,
    f'{_BEFORE.value}, {_AFTER.value}': switched,
  }
  rows, heights = {}, {}
  for name, policy in policies.items():
    rows[name], heights[name] = hard_switch.judge(
      policy, config, first, second, _PHASES.value, _SEED.value
    )
  print(f'{f"{first} -> {second}":40}{"succeeded":>12}{"fallen":>8}')
  for name, row in rows.items():
    share = f'{row["succeeded"]} of {row["of"]}'
    print(f'{name:40}{share:>12}{row["fallen"]:>8}')
  report = {'benchmark': 'switching', 'table': rows, 'seed': _SEED.value}
  common.write_report(out, report)
  if folder:
    switch = next(iter(rows.values()))['switches'][_PHASES.value // 2]
    drawn = _draw(heights, config.control_timestep, switch)
    figures.save(pathlib.Path(folder) / FIGURE_FILE, drawn)


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
