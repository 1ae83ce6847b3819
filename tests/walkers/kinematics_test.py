"""Tests of dmc_multimode.walkers.kinematics against the compiled robot."""

import functools

from dm_control import composer
import mujoco
import numpy as np
import pytest

from dmc_multimode.utils import constants
from dmc_multimode.walkers import kinematics
from dmc_multimode.walkers import mini_biped

_HEIGHTS = (kinematics.LOWEST, 0.43, 0.5, 0.57, 0.62, kinematics.HIGHEST)
_CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1])).reshape(3, -1)


@functools.cache
def _model() -> mujoco.MjModel:
  """The robot in empty space."""
  arena = composer.Arena()
  walker = mini_biped.MiniBiped()
  walker.create_root_joints(arena.attach(walker))
  root = arena.mjcf_model
  return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def _standing_joints(
  height: np.ndarray, climb: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Joints that put flat soles under the hips of an upright trunk."""
  both = lambda values: np.repeat(values[:, None], 2, axis=1)
  nothing = np.zeros((len(height), 2))
  return kinematics.placing(nothing, both(height), nothing, both(climb))


def _standing(height: float, climb: float = 0.0) -> mujoco.MjData:
  """The robot at a height, climbing at some speed, with such legs."""
  model = _model()
  data = mujoco.MjData(model)
  angles, rates = _standing_joints(np.array([height]), np.array([climb]))
  data.qpos[2], data.qpos[7:] = height, angles[0]
  data.qvel[2], data.qvel[6:] = climb, rates[0]
  mujoco.mj_forward(model, data)
  return data


def _sole(data: mujoco.MjData, side: str) -> np.ndarray:
  """Returns the four lower corners of a foot, world metres, [4, 3]."""
  foot = data.geom(f'walker/{side}_foot')
  half_sizes = _model().geom(f'walker/{side}_foot').size
  corners = foot.xmat.reshape(3, 3) @ (_CORNERS * half_sizes[:, None])
  return foot.xpos + corners.T


@pytest.mark.parametrize('climb', (-0.8, 0.7))
@pytest.mark.parametrize('height', _HEIGHTS)
def test_feet_rest_under_the_hips(height: float, climb: float) -> None:
  """Flat on the ground, while the trunk moves."""
  data, velocity = _standing(height, climb), np.zeros(6)
  crouch = _standing(constants.STAND_HEIGHT)
  for side in mini_biped.SIDES:
    sole, under = _sole(data, side), _sole(crouch, side)
    np.testing.assert_allclose(sole[:, 2], 0.0, atol=1e-3)
    np.testing.assert_allclose(sole[:, :2], under[:, :2], atol=1e-6)
    # Flat, more exactly than the sole's place is rounded in the XML.
    assert np.ptp(sole[:, 2]) < 1e-6
    foot = _model().geom(f'walker/{side}_foot').id
    mujoco.mj_objectVelocity(
      _model(), data, mujoco.mjtObj.mjOBJ_GEOM, foot, velocity, 0
    )
    # Metres and radians a second; the XML rounds the crouch to 1e-6.
    np.testing.assert_allclose(velocity, np.zeros(6), atol=1e-5)


def test_crouch_is_zero_and_far_is_cut_to_what_legs_can_do() -> None:
  heights = np.array([constants.STAND_HEIGHT, 0.0, 2.0])
  angles, rates = _standing_joints(heights, np.array([0.0, 0.5, 0.5]))
  np.testing.assert_allclose(angles[0], np.zeros(10), atol=1e-12)
  np.testing.assert_array_equal(rates[0], np.zeros(10))
  bounds = np.array([kinematics.LOWEST, kinematics.HIGHEST])
  expected = _standing_joints(bounds, np.array([0.5, 0.5]))
  np.testing.assert_array_equal((angles[1:], rates[1:]), expected)
  assert np.isfinite(expected).all()
  row = lambda value: np.full((1, 2), value)
  far = kinematics.placing(row(0.4), row(0.6), row(0.2), row(0.2))
  assert np.isfinite(far).all()


def test_legs_are_alike_and_joints_within_their_ranges() -> None:
  heights = np.linspace(kinematics.LOWEST, kinematics.HIGHEST, 20)
  angles, rates = _standing_joints(heights, np.ones(20))
  for values in (angles, rates):
    np.testing.assert_array_equal(values[:, :5], values[:, 5:])
    np.testing.assert_array_equal(values[:, :2], np.zeros((20, 2)))
  model = _model()
  for i, name in enumerate(mini_biped.JOINTS):
    joint = model.joint(f'walker/{name}')
    assert joint.limited[0], name
    assert angles[:, i].min() >= joint.range[0], name
    assert angles[:, i].max() <= joint.range[1], name


@pytest.mark.parametrize('rate', (-0.6, 0.0, 0.5))
@pytest.mark.parametrize('height', (0.42, 0.5, 0.58))
@pytest.mark.parametrize('forward', (-0.1, 0.0, 0.12))
def test_soles_are_where_they_should_be(
  forward: float, height: float, rate: float
) -> None:
  """The left one; the right one stays under its hip, 5 cm higher."""
  model, data = _model(), mujoco.MjData(_model())
  row = lambda left, right: np.array([[left, right]])
  angles, rates = kinematics.placing(
    row(forward, 0.0),
    row(height, height - 0.05),
    row(rate, 0.0),
    row(-0.3, 0.4),
  )
  data.qpos[2], data.qpos[7:], data.qvel[6:] = height, angles[0], rates[0]
  mujoco.mj_forward(model, data)
  crouch, velocity = _standing(constants.STAND_HEIGHT), np.zeros(6)
  for side, x, z, moved in (
    ('left', forward, 0.0, (rate, 0.0, 0.3)),
    ('right', 0.0, 0.05, (0.0, 0.0, -0.4)),
  ):
    expected = _sole(crouch, side) + [x, 0.0, z]
    np.testing.assert_allclose(_sole(data, side), expected, atol=1e-5)
    foot = model.geom(f'walker/{side}_foot').id
    mujoco.mj_objectVelocity(
      model, data, mujoco.mjtObj.mjOBJ_GEOM, foot, velocity, 0
    )
    np.testing.assert_allclose(velocity[:3], np.zeros(3), atol=1e-5)
    np.testing.assert_allclose(velocity[3:], moved, atol=1e-5)


_LEFT = np.array([[True, False]])  # Swings.


def test_stepping_by_hand() -> None:
  """A third of a step after its middle, at 0.6 m/s."""
  length = 0.3
  forward, lift, forward_rate, lift_rate = kinematics.stepping(
    np.array([0.6]), _LEFT, np.array([length / 3]), np.array([length])
  )
  np.testing.assert_allclose(forward, [[0.06, -0.06]])
  np.testing.assert_allclose(lift, [[0.03, 0.0]])
  np.testing.assert_allclose(forward_rate, [[0.6, -0.6]])
  fall = -0.06 * np.pi / length * np.sin(np.pi / 3)
  np.testing.assert_allclose(lift_rate, [[fall, 0.0]])
  # Nothing where no foot swings.
  none, one = np.zeros((1, 2), dtype=bool), np.ones(1)
  for values in kinematics.stepping(one, none, 0.1 * one, one):
    np.testing.assert_array_equal(values, np.zeros((1, 2)))
  np.testing.assert_array_equal(kinematics.sway(none, 0.1 * one, one), [0.0])


@pytest.mark.parametrize('side', [-1.0, 1.0])
@pytest.mark.parametrize('length', [0.2, 0.5])
def test_sway_leads_from_step_to_step(length: float, side: float) -> None:
  """A pendulum over the standing foot is back in the middle in the end."""

  def at(time: float) -> float:
    swinging = _LEFT if side < 0 else ~_LEFT
    found = kinematics.sway(swinging, np.array([time]), np.array([length]))
    return float(found[0])

  foot, y, v, dt = side * 0.09, 0.0, at(-length / 2), 1e-5
  assert side * v > 0.1
  for i in range(round(length / dt)):
    if i == round(length / dt / 2):
      assert v == pytest.approx(0.0, abs=0.5e-3)
      assert 0.0 <= side * y <= 0.09
    v += dt * 9.81 / constants.STAND_HEIGHT * (y - foot)
    y += dt * v
  assert y == pytest.approx(0.0, abs=0.5e-3)
  assert v == pytest.approx(at(length / 2), abs=0.5e-3)
