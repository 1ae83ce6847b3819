"""Profiles of the trunk's height in modes, and how far apart two are."""

import dataclasses
from typing import Sequence

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.evaluation import evaluator as scoring
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import terminations

_SETTLED = 1.2  # Seconds after which heights count.


def profiles(
  policy: pretrained.Policy,
  modes: Sequence[str],
  episodes: int,
  seed: int,
) -> dict[str, np.ndarray]:
  """Returns mean heights of the trunk over time.

  Args:
    policy: knows the modes.
    modes: names, M of them.
    episodes: of each.
    seed: of the initial states.

  Returns:
    Heights over the support, metres, of the robot and of the reference,
    [M, T] each; a robot that falls counts where it lies.

  Raises:
    ValueError: the policy does not know a mode.
  """
  config = dataclasses.replace(
    policy.config, events=events.NONE, limits=terminations.NO_LIMITS
  )
  ids = np.repeat([policy.mode_set.index(name) for name in modes], episodes)
  evaluator = scoring.Evaluator(policy, config, seed, quiet=True)
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
