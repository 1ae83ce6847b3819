"""Tests of dmc_multimode.walkers.legs."""

import importlib.util
import pathlib

import mujoco
import numpy as np
import pytest

from dmc_multimode.walkers import legs
from dmc_multimode.walkers import robot as robot_lib
from dmc_multimode.walkers import robot_walker

_FILE = pathlib.Path(__file__).parents[1] / 'robots' / 'four_legs.yaml'


def test_without_mink(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(importlib.util, 'find_spec', lambda name: None)
  legs.find.cache_clear()
  robot = robot_lib.load(_FILE)
  with pytest.warns(UserWarning, match='mink is not installed: episodes of fo'):
    assert legs.find(robot) is None
  legs.find.cache_clear()


def test_feet_are_where_they_should_be() -> None:
  """And their velocities are those of the joints' rates."""
  pytest.importorskip('mink')
  robot = robot_lib.load(_FILE)
  found, height = legs.find(robot), robot.stand_height
  assert found is not None and legs.find(robot) is found
  np.testing.assert_array_equal(found.leg, np.repeat(np.arange(4), 3))
  model = robot_walker.compile_fixed(robot_walker.RobotWalker(robot))
  sites = [
    model.site(robot_walker.PREFIX + foot).id for foot in robot.declaration.feet
  ]

  def feet(joints: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_kinematics(model, data)
    return data.site_xpos[sites].copy()

  at = feet(robot.derived.pose)
  still = np.zeros((1, 4))
  pose, rates = found.place(still, np.full((1, 4), height), still, still)
  np.testing.assert_allclose(pose[0], robot.derived.pose, atol=1e-9)
  np.testing.assert_array_equal(rates, 0)
  ahead = np.array([[0.2, -0.2, 0.1, -0.07]]) * height
  down = np.array([[1.1, 0.8, 1.0, 0.9]]) * height
  speed, climb = np.full((1, 4), 0.4), np.full((1, 4), -0.2)
  joints, rates = found.place(ahead, down, speed, climb)
  wanted = np.stack([ahead[0], still[0], height - down[0]], axis=1)
  np.testing.assert_allclose(feet(joints[0]) - at, wanted, atol=0.004)
  step = 1e-3
  moved = (feet(joints[0] + step * rates[0]) - feet(joints[0])) / step
  # Feet go down as the trunk goes up.
  np.testing.assert_allclose(moved[:, 0], 0.4, atol=0.08)
  np.testing.assert_allclose(moved[:, 2], 0.2, atol=0.08)
