"""The physics is sane: energy, torques, and feet in the ground."""

import pytest

from benchmarks.reliability import fault_physics
from dmc_multimode.arenas import layouts

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
