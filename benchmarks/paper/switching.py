"""One multimodal policy against unimodal ones that are switched hard.

    python -m benchmarks.paper.switching --policy=pi2 \
      --before=unimodal_walk --after=unimodal_launch --out=switching.json

The paper's Fig. ma_mc_vis, right: walk, then launch onto a block. The command
comes at 20 phases of the walk, on the same starts for both. A switch has
succeeded when the robot stands on the block, on both feet, the trunk within 8
cm of its height over it, for a second; see `evaluation.acceptance`.
"""

import dataclasses
import functools
import pathlib
from typing import Any, Sequence

from absl import flags
import numpy as np
import torch

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import figures
from dmc_multimode.experiments import symmetry
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import files
from dmc_multimode.walkers import mini_biped

_POLICY = config_flags.define_path('policy', 'pi2', 'The multimodal policy.')
_BEFORE = config_flags.define_path(
  'before', 'unimodal_walk', 'The unimodal policy that runs first.'
)
_AFTER = config_flags.define_path(
  'after', 'unimodal_launch', 'The unimodal policy that is switched to.'
)
_PHASES = flags.DEFINE_integer(
  'phases', 20, 'Of the first mode at which the switch is tried.', 1
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.', 0)
_OUT = common.define_out()
_FIGURES = config_flags.define_path('figures', None, 'Folder to draw into.')

FIGURE_FILE = 'switching.png'
_CYCLES = 2  # Of the first mode before the earliest switch.
_SECONDS = 3.0  # That an episode goes on after the latest switch.


class HardSwitch:
  """Unimodal policies as one: each acts in the worlds that run its mode."""

  def __init__(self, policies: Sequence[pretrained.Policy]):
    """Combines policies of one mode each.

    Raises:
      ValueError: a policy knows more than one mode, or two know the same.
    """
    for policy in policies:
      if len(policy.mode_set) != 1:
        names = ', '.join(policy.mode_set.names)
        raise ValueError(f'A unimodal policy is needed, not one of {names}.')
    self._policies = tuple(policies)
    self.mode_set: mode_set_lib.ModeSet = mode_set_lib.one_hot(
      [policy.mode_set.motions[0] for policy in policies]
    )
    self._mode_of = symmetry.ModeOf(self.mode_set.latents)

  def select_action(self, observation: np.ndarray) -> np.ndarray:
    """Joint targets [B, 10] for observations [B, D] with one-hot commands."""
    running = self._mode_of(torch.from_numpy(observation)).numpy()
    start, end = self._mode_of.part.start, self._mode_of.part.stop
    actions = np.zeros(
      (len(observation), len(mini_biped.JOINTS)), dtype=np.float32
    )
    for i, policy in enumerate(self._policies):
      mine = observation[running == i]
      latent = np.tile(policy.mode_set.latents, (len(mine), 1))
      seen = np.concatenate([mine[:, :start], latent, mine[:, end:]], axis=1)
      actions[running == i] = policy.select_action(seen)
    return actions


def make_schedule(
  mode_set: mode_set_lib.ModeSet, first: str, second: str, phases: int
) -> schedule_lib.ModeSchedule:
  """Switches from one mode to another at so many phases, a world each."""
  modes = np.tile([mode_set.index(first), mode_set.index(second)], (phases, 1))
  cycles = _CYCLES + np.arange(phases) / phases
  starts = np.zeros((phases, 2))
  starts[:, 1] = cycles * mode_set.bank.durations[mode_set.index(first)]
  return schedule_lib.ModeSchedule(modes, starts, np.ones(phases))


def judge(
  policy: evaluator_lib.Policy,
  config: task_config.ImitationConfig,
  first: str,
  second: str,
  phases: int,
  seed: int,
) -> tuple[dict[str, Any], np.ndarray]:
  """Returns how the switches went, and the trunk's heights.

  The heights are in the world, metres, [T, phases]; nan after an episode.
  """
  mode_set = policy.mode_set
  schedule = make_schedule(mode_set, first, second, phases)
  config = dataclasses.replace(
    config,
    time_limit=float(schedule.starts.max()) + _SECONDS,
    limits=terminations.falls_alone(config.limits),
  )
  evaluator = evaluator_lib.Evaluator(policy, config, seed, quiet=True)
  found = evaluator.run(schedule, 'switches')
  motion = mode_set.motions[mode_set.index(second)]
  kept = []
  for trace in evaluator.traces(found, motion.duration):
    findings = acceptance.check(motion, [trace])
    kept.append(all(finding.passed for finding in findings))
  row = {
    'succeeded': int(np.sum(kept)),
    'of': phases,
    'fallen': int(np.sum(~found.survived)),
    'kept': kept,
    'switches': schedule.starts[:, 1].tolist(),
  }
  heights = found.traces['position'][:, :, 2].copy()
  late = np.arange(len(heights))[:, None] >= found.lengths
  heights[late] = np.nan
  return row, heights


def _draw(
  heights: dict[str, np.ndarray], timestep: float, switch: float, to: str
) -> Any:
  """Draws the heights of the trunk in the switch at the middle phase.

  Args:
    heights: of the trunk by policy, metres, [T, phases]; nan after a fall.
    timestep: seconds of a control step.
    switch: seconds.
    to: mode that is commanded then.
  """
  drawn, ((axis,),) = figures.empty(1, 1, 7.0, 3.0)
  for i, (name, height) in enumerate(heights.items()):
    times = timestep * np.arange(1, len(height) + 1)
    shown = height[:, height.shape[1] // 2]
    axis.plot(times, shown, f'C{i}', label=name)
    last = int(np.isfinite(shown).sum()) - 1
    if last < len(shown) - 1:
      axis.plot(times[last], shown[last], f'C{i}X', label=f'{name}: falls')
  axis.axvline(switch, color='0.5', linewidth=0.8, label=f'{to} is commanded')
  axis.set(xlabel='time (s)', ylabel='height over the world (m)')
  axis.legend(fontsize='small', title='height of the trunk')
  return drawn


def main(argv: Sequence[str]) -> None:
  """Switches, prints, writes, draws."""
  del argv
  out = files.output_file('out', _OUT.value)
  folder = files.output_folder('figures', _FIGURES.value)
  multimodal = pretrained.load(_POLICY.value)
  unimodal = [pretrained.load(name) for name in (_BEFORE.value, _AFTER.value)]
  switched = HardSwitch(unimodal)
  first, second = switched.mode_set.names
  config = task_config.evaluated(multimodal.config)
  policies: dict[str, evaluator_lib.Policy] = {
    _POLICY.value: multimodal,
    f'{_BEFORE.value}, {_AFTER.value}': switched,
  }
  rows, heights = {}, {}
  for name, policy in policies.items():
    rows[name], heights[name] = judge(
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
    drawn = _draw(heights, config.control_timestep, switch, second)
    figures.save(pathlib.Path(folder) / FIGURE_FILE, drawn)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
