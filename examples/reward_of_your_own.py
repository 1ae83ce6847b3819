"""Trains with a reward term of your own: less power, at the joints.

    python examples/reward_of_your_own.py

An environment is whatever has `step`, `reset` and the specifications; here a
subclass of ours subtracts what the servos spend from the reward.
"""

import numpy as np
from numpy import typing as npt

from dmc_multimode.agents import ppo
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env

_WEIGHT = 2e-4  # Per watt and control step.


class FrugalImitation(batched_env.BatchedImitation):
  """Imitation whose reward is less for positive mechanical power."""

  def step(self, actions: npt.ArrayLike) -> batched_env.BatchedTimeStep:
    """See the base class."""
    step = super().step(actions)
    stiffness, damping = 30.0, 0.5  # Nm/rad and Nm s/rad, of all servos.
    joints, rates = self.qpos[:, 7:], self.qvel[:, 6:]
    torque = stiffness * (np.asarray(actions) - joints) - damping * rates
    power = np.maximum(torque * rates, 0.0).sum(axis=1)
    cost = np.where(step.last, 0.0, _WEIGHT * power)  # The next one has begun.
    return step._replace(reward=step.reward - cost)


def main(steps: int = 3_000_000, num_worlds: int = 512) -> None:
  """Trains a walk."""
  task = multimode_biped.make_modes_task('walk_forward')
  ppo.fit(FrugalImitation(task, num_worlds, seed=0), steps)


if __name__ == '__main__':
  main()
