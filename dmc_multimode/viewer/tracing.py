"""Roll-outs of a policy as numbers: what to plot, and no picture."""

import os
from typing import NamedTuple, Sequence, TYPE_CHECKING

import numpy as np

from dmc_multimode.viewer import gl
from dmc_multimode.viewer import recording

if TYPE_CHECKING:
  from dmc_multimode import pretrained


class Trace(NamedTuple):
  """A roll-out after each of its T control steps, world frame.

  Attributes:
    times: seconds since the start, [T].
    modes: names of the running modes, length T.
    position: of the trunk, metres, [T, 3].
    reference: where the mode wants the trunk, metres, [T, 3].
    support: height of the ground under the trunk, metres, [T].
    reward: normalised, in [0, 1], [T].
    causes: of a termination in the step, or 'none', length T.
  """

  times: np.ndarray
  modes: tuple[str, ...]
  position: np.ndarray
  reference: np.ndarray
  support: np.ndarray
  reward: np.ndarray
  causes: tuple[str, ...]


def trace(
  policy: 'str | os.PathLike[str] | pretrained.Policy',
  schedule: str | Sequence[tuple[str, float]],
  arena: str = 'flat',
  seed: int = 0,
  clock_rate: float = 1.0,
) -> Trace:
  """Rolls a policy out through a schedule, past every termination.

  Args:
    policy: name of a shipped policy, a folder, or a policy.
    schedule: 'MODE:SECONDS,MODE:SECONDS,...' or such pairs; see `record`.
    arena: name of the track; see `record`.
    seed: of the terrain and of the initial state's noise.
    clock_rate: rate of the phase clock, 1 being the references' own.

  Raises:
    FileNotFoundError: there is no such policy.
    ValueError: a mode or the arena is unknown, or a number is out of bounds.
  """
  what = recording.scheduled(schedule, arena, seed)
  gl.choose_backend()  # dm_control reads it, and so comes later.
  from dmc_multimode.viewer import rollout as rollout_lib

  rolled = rollout_lib.Rollout(
    recording.find_policy(policy),
    rollout_lib.RolloutConfig(**what, clock_rate=clock_rate),
  )
  rolled.start()
  core = rolled.task.core
  steps, wanted = [], []
  for step in rolled.steps():
    steps.append(step)
    wanted.append(core.reference(step.position[:1]).position[0])
  position = np.array([step.position for step in steps])
  return Trace(
    np.array([step.time for step in steps]),
    tuple(step.mode for step in steps),
    position,
    np.array(wanted),
    position[:, 2] - np.array([step.height for step in steps]),
    np.array([step.reward for step in steps]),
    tuple(step.cause for step in steps),
  )
