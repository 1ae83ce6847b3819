"""The physics is sane: energy, torques, and feet in the ground."""

import numpy as np
import pytest

from benchmarks.reliability import fault_physics
from dmc_multimode.arenas import layouts
from dmc_multimode.suite.imitation import batched_env

_TIMESTEPS = (fault_physics.USERS_TIMESTEP, fault_physics.TRAINING_TIMESTEP)


@pytest.mark.parametrize('timestep', _TIMESTEPS)
@pytest.mark.parametrize('seed', range(3))
def test_a_drop_gains_no_energy(timestep: float, seed: int) -> None:
  found = fault_physics.drop(timestep, seed)
  assert found.excess <= 0.0
  assert found.start > 60.0  # 14 kg from half a metre.


@pytest.mark.parametrize('arena', layouts.NAMES)
def test_torques_are_bounded(arena: str) -> None:
  """By Eq. 2, whatever is asked for."""
  found = fault_physics.random_actions(
    arena, fault_physics.TRAINING_TIMESTEP, fault_physics.FULL, 400, 20
  )
  assert found.torque == pytest.approx(30.0) and found.torque <= 30.0
  assert not found.diverged


def test_depth_by_hand() -> None:
  """Half of a foot is put into the ground, toe first."""
  task = fault_physics._task('flat', 0.005)
  worlds = batched_env.BatchedImitation(task, 2, 0, 1)
  worlds.reset()
  feet = [7, 10]
  assert worlds.physics.model.geom(feet[0]).name == 'walker/left_foot'
  position = np.zeros((2, worlds.physics.model.ngeom, 3))
  rotation = np.tile(np.eye(3).ravel(), (2, worlds.physics.model.ngeom, 1))
  position[:, feet] = [0.0, 0.0, 0.2]
  position[1, feet[0]] = [0.0, 0.0, 0.004]  # A level foot of +-10 mm.
  found = fault_physics._depths(
    worlds, worlds.core.terrain, feet, {'xpos': position, 'xmat': rotation}
  )
  np.testing.assert_allclose(found, [0.0, 0.006], atol=1e-12)
