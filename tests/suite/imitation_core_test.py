"""Tests of dmc_multimode.suite.imitation_core: where episodes begin."""

import dataclasses

from absl.testing import absltest
from absl.testing import parameterized
import mujoco
import numpy as np

from dmc_multimode.arenas import terrain
from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.modes import schedule
from dmc_multimode.suite import batched
from dmc_multimode.suite import config
from dmc_multimode.suite import episodes
from dmc_multimode.suite import legs
from dmc_multimode.suite import mini_biped
from dmc_multimode.suite import multimode_biped

_MOTIONS = tuple(library.modes().values())
_PHASES = 60  # Of each mode, drawn.
_CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)


class _Starts:
  """Every mode of the library, begun many times over, without noise.

  Attributes:
    modes: index of the mode of each world, [B].
    gaps: of the corners of the feet (left, right) from what is below them,
      metres, [B, 2, 8].
    speeds: of the feet, [B, 2, 6], angular and linear, rad/s and m/s.
  """

  def __init__(self, reference_starts: float):
    task_config = dataclasses.replace(
      config.ImitationConfig(),
      reference_starts=reference_starts,
      joint_noise=0.0,
      velocity_noise=0.0,
      tilt_noise=0.0,
    )
    self.modes = np.repeat(np.arange(len(_MOTIONS)), _PHASES)
    task = multimode_biped.make_task(
      _MOTIONS,
      codebook.one_hot(_MOTIONS),
      episodes.ScheduledEpisodes(schedule.single(self.modes)),
      config=task_config,
    )
    self.worlds = batched.BatchedImitation(
      task, len(self.modes), 0, 1, auto_reset=False
    )
    self.worlds.reset()
    self.tracker = self.worlds.core.tracker
    self.reference = self.tracker.reference()
    self._measure_feet()

  def _measure_feet(self) -> None:
    model = self.worlds.model
    data = mujoco.MjData(model)
    shape = (len(self.modes), 2)
    self.gaps, self.speeds = np.zeros((*shape, 8)), np.zeros((*shape, 6))
    for world in range(len(self.modes)):
      data.qpos[:] = self.worlds.qpos[world]
      data.qvel[:] = self.worlds.qvel[world]
      mujoco.mj_forward(model, data)
      ground = terrain.Terrain(
        *(np.tile(f[world], (8, 1)) for f in self.worlds.core.terrain)
      )
      for i, side in enumerate(mini_biped.SIDES):
        foot = data.geom(f'walker/{side}_foot')
        half_sizes = model.geom(foot.id).size[:, None]
        offsets = foot.xmat.reshape(3, 3) @ (_CORNERS * half_sizes)
        x, _, z = foot.xpos[:, None] + offsets
        self.gaps[world, i] = z - terrain.support_height(ground, x)
        mujoco.mj_objectVelocity(
          model,
          data,
          mujoco.mjtObj.mjOBJ_GEOM,
          foot.id,
          self.speeds[world, i],
          0,
        )


class ReferenceStartTest(parameterized.TestCase):
  starts: _Starts

  @classmethod
  def setUpClass(cls) -> None:
    super().setUpClass()
    cls.starts = _Starts(reference_starts=1.0)

  def test_many_phases_are_tried(self) -> None:
    phases = self.starts.tracker.state.phase.reshape(len(_MOTIONS), _PHASES)
    self.assertLess(phases.min(axis=1).max(), 0.15)
    self.assertGreater(phases.max(axis=1).min(), 0.85)
    aloft = self.starts.tracker.airborne(np.arange(len(phases.ravel())))
    names = {_MOTIONS[mode].name for mode in self.starts.modes[aloft]}
    leaps = {f'leap_{d}' for d in ('forward', 'backward', 'left', 'right')}
    self.assertEqual(names, {'hop_forward', 'launch'} | leaps)

  def test_no_foot_is_in_the_ground_or_in_a_block(self) -> None:
    depth = -self.starts.gaps.min(axis=(1, 2))
    worst = depth.argmax()
    self.assertLess(
      depth[worst],
      1e-3,
      f'{_MOTIONS[self.starts.modes[worst]].name} at phase '
      f'{self.starts.tracker.state.phase[worst]}',
    )

  def _within_reach(self) -> np.ndarray:
    """Where the reference has a foot on the ground, as legs can have it."""
    every = np.arange(len(self.starts.modes))
    height = self.starts.reference.position[
      :, 2
    ] - self.starts.worlds.core.support(self.starts.reference.position[:, 0])
    reach = (height >= legs.LOWEST) & (height <= legs.HIGHEST)
    return ~self.starts.tracker.airborne(every) & reach

  def _standing_feet(self) -> np.ndarray:
    """Which feet stand, [B, 2]."""
    every = np.arange(len(self.starts.modes))
    swinging, _, _ = self.starts.tracker.steps(every)
    return self._within_reach()[:, None] & ~swinging

  def test_feet_stand_where_the_reference_stands(self) -> None:
    stance = self._standing_feet()
    standing = stance.any(axis=1)
    self.assertLen(np.unique(self.starts.modes[standing]), len(_MOTIONS))
    # The soles, flat, on the ground.
    lowest = np.sort(self.starts.gaps[stance], axis=1)[:, :4]
    np.testing.assert_allclose(lowest, 0.0, atol=1e-3)
    heights = self.starts.worlds.qpos[standing, 2]
    self.assertGreater(np.ptp(heights), 0.1)  # Not all at the crouch.

  def test_standing_feet_do_not_rise_or_sink(self) -> None:
    stance = self._standing_feet()
    speeds = self.starts.speeds[stance]
    np.testing.assert_allclose(speeds[:, 5], 0.0, atol=1e-4)  # Upwards.
    np.testing.assert_allclose(speeds[:, :3], 0.0, atol=1e-4)  # Turning.
    climbs = self.starts.worlds.qvel[stance.all(axis=1), 2]
    self.assertGreater(climbs.max(), 0.5)
    self.assertLess(climbs.min(), -0.2)

  def test_one_foot_swings_where_the_reference_s_does(self) -> None:
    """Up to 6 cm high, and past the foot that stands as the trunk is."""
    starts = self.starts
    every = np.arange(len(starts.modes))
    swinging, time, length = starts.tracker.steps(every)
    walking = swinging.sum(axis=1) > 0
    names = {_MOTIONS[mode].name for mode in starts.modes[walking]}
    directions = ('forward', 'backward', 'left', 'right')
    self.assertEqual(names, {f'walk_{d}' for d in directions})
    np.testing.assert_array_equal(swinging.sum(axis=1), walking)
    np.testing.assert_array_equal(
      swinging, walking[:, None] & (starts.reference.contact == 0)
    )
    height = starts.gaps[swinging].min(axis=1)
    share = time[walking] / length[walking]
    expected = 0.06 * np.cos(np.pi * share)
    np.testing.assert_allclose(height, expected, atol=1e-3)
    self.assertGreater(height.max(), 0.05)
    # The foot that stands is at rest along the way.
    walking &= starts.reference.position[:, 1] == 0  # Not sideways.
    stance = ~swinging & walking[:, None]
    np.testing.assert_allclose(starts.speeds[stance][:, 3], 0.0, atol=1e-4)
    flown = starts.speeds[swinging & walking[:, None]][:, 3]
    trunk = starts.worlds.qvel[walking, 0]
    np.testing.assert_allclose(flown, 2 * trunk, atol=1e-4)

  def test_trunk_is_on_its_reference(self) -> None:
    """But where legs that are drawn up would be in the block."""
    starts = self.starts
    position, wanted = starts.worlds.qpos[:, :3], starts.reference.position
    np.testing.assert_array_equal(position[:, :2], wanted[:, :2])
    self.assertTrue(np.all(position[:, 2] >= wanted[:, 2]))
    lifted = position[:, 2] > wanted[:, 2]
    names = {_MOTIONS[mode].name for mode in starts.modes[lifted]}
    self.assertEqual(names, {'launch'})
    top = starts.worlds.core.terrain.tops[lifted, 1]
    np.testing.assert_allclose(position[lifted, 2], top + legs.CROUCH_HEIGHT)

  def test_velocity_is_the_reference_s_or_slower(self) -> None:
    starts = self.starts
    every = np.arange(len(starts.modes))
    _, _, velocity = starts.tracker.start_pose(every)
    moved = starts.worlds.qvel[:, :3]
    swinging, _, _ = starts.tracker.steps(every)
    velocity = velocity[~swinging.any(axis=1)]  # The others sway.
    moved = moved[~swinging.any(axis=1)]
    moving = np.linalg.norm(velocity, axis=1) > 0
    pace = np.sum(moved * velocity, axis=1)[moving]
    pace /= np.sum(velocity**2, axis=1)[moving]
    self.assertBetween(pace.min(), 0.5, 0.6)
    self.assertBetween(pace.max(), 0.9, 1.0)
    np.testing.assert_allclose(moved[moving], pace[:, None] * velocity[moving])
    np.testing.assert_array_equal(moved[~moving], 0.0)
    np.testing.assert_array_equal(starts.worlds.qvel[:, 3:6], 0.0)

  def test_legs_are_drawn_up_in_flight(self) -> None:
    aloft = self.starts.tracker.airborne(np.arange(len(self.starts.modes)))
    legs_then = self.starts.worlds.qpos[aloft, 7:]
    np.testing.assert_allclose(legs_then, 0.0, atol=1e-12)
    np.testing.assert_array_equal(self.starts.worlds.qvel[aloft, 6:], 0.0)


class StartFromRestTest(parameterized.TestCase):
  def test_every_mode_begins_in_the_crouch_at_rest(self) -> None:
    starts = _Starts(reference_starts=0.0)
    expected = np.zeros((len(starts.modes), 17))
    expected[:, 2], expected[:, 3] = library.STAND_HEIGHT, 1.0
    np.testing.assert_allclose(starts.worlds.qpos, expected, atol=1e-12)
    np.testing.assert_array_equal(
      starts.worlds.qvel, np.zeros((len(starts.modes), 16))
    )
    np.testing.assert_array_equal(starts.tracker.state.phase, 0.0)
    lowest = starts.gaps.min(axis=2)
    np.testing.assert_allclose(lowest, 0.0, atol=1e-3)


if __name__ == '__main__':
  absltest.main()
