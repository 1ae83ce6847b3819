"""Unimodal policies that are switched hard, and how the switches went."""

import dataclasses
from typing import Any, Sequence

import numpy as np
import torch

from dmc_multimode import pretrained
from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import evaluator as scoring
from dmc_multimode.experiments import symmetry
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import terminations

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
      (len(observation), observations.NUM_JOINTS), dtype=np.float32
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
  policy: scoring.Policy,
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
  evaluator = scoring.Evaluator(policy, config, seed, quiet=True)
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
