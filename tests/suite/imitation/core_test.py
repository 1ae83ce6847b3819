"""Tests of dmc_multimode.suite.imitation.core.

Where episodes begin, what stands in the way of modes, and how references ride
on the ground.
"""

import copy
import dataclasses
from typing import Any, Sequence
from unittest import mock

import mujoco
import numpy as np
import pytest

from dmc_multimode.arenas import terrain
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config
from dmc_multimode.suite.imitation import core as imitation_core
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import obstacles
from dmc_multimode.utils import constants
from dmc_multimode.utils import schedule as schedules
from dmc_multimode.walkers import kinematics
from dmc_multimode.walkers import mini_biped

_MOTIONS = tuple(library.modes().values())
_NAMES = [motion.name for motion in _MOTIONS]
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

  def __init__(self, reference_starts: float, obstacle_share: float):
    task_config = config.ImitationConfig(
      events=events.TrainingEvents(
        reference_starts=reference_starts,
        obstacles=schedules.constant(obstacle_share),
      ),
      joint_noise=0.0,
      velocity_noise=0.0,
      tilt_noise=0.0,
    )
    self.modes = np.repeat(np.arange(len(_MOTIONS)), _PHASES)
    task = multimode_biped.make_task(
      mode_set.one_hot(_MOTIONS),
      episodes.ScheduledEpisodes(schedule.single(self.modes)),
      config=task_config,
    )
    self.worlds = batched_env.BatchedImitation(
      task, len(self.modes), 0, 1, auto_reset=False
    )
    self.worlds.reset()
    self.tracker = self.worlds.core.tracker
    self.reference = self.worlds.core.reference(self.worlds.qpos[:, 0])
    self._measure_feet()

  def _measure_feet(self) -> None:
    model = self.worlds.physics.model
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


class TestReferenceStart:
  starts: _Starts
  obstacle_share = 0.0

  @classmethod
  def setup_class(cls) -> None:
    cls.starts = _Starts(1.0, cls.obstacle_share)

  def test_many_phases_are_tried(self) -> None:
    phases = self.starts.tracker.state.phase.reshape(len(_MOTIONS), _PHASES)
    assert (phases.min(axis=1).max()) < 0.15
    assert (phases.max(axis=1).min()) > 0.85
    aloft = self.starts.tracker.airborne(np.arange(len(phases.ravel())))
    names = {_MOTIONS[mode].name for mode in self.starts.modes[aloft]}
    leaps = {f'leap_{d}' for d in ('forward', 'backward', 'left', 'right')}
    assert names == ({'hop_forward', 'launch', 'step_down'} | leaps)

  def test_no_foot_is_in_the_ground_or_in_a_block(self) -> None:
    depth = -self.starts.gaps.min(axis=(1, 2))
    worst = depth.argmax()
    assert depth[worst] < 1e-3, (
      f'{_MOTIONS[self.starts.modes[worst]].name} at phase '
      f'{self.starts.tracker.state.phase[worst]}'
    )

  def _within_reach(self) -> np.ndarray:
    """Where the reference has a foot on the ground, as legs can have it."""
    every = np.arange(len(self.starts.modes))
    height = self.starts.reference.position[
      :, 2
    ] - self.starts.worlds.core.support(self.starts.reference.position[:, 0])
    reach = (height >= kinematics.LOWEST) & (height <= kinematics.HIGHEST)
    reach &= ~self._lifted()
    return ~self.starts.tracker.airborne(every) & reach

  def _lifted(self) -> np.ndarray:
    """Who is over an edge, and higher than its reference, [B]."""
    position = self.starts.worlds.qpos[:, 2]
    return position > self.starts.reference.position[:, 2]

  def _standing_feet(self) -> np.ndarray:
    """Which feet stand, [B, 2]."""
    every = np.arange(len(self.starts.modes))
    swinging, _, _ = self.starts.tracker.swing_timing(every)
    return self._within_reach()[:, None] & ~swinging

  def test_feet_stand_where_the_reference_stands(self) -> None:
    stance = self._standing_feet()
    standing = stance.any(axis=1)
    assert len(np.unique(self.starts.modes[standing])) == len(_MOTIONS)
    # The soles, flat, on the ground; toes may reach over an edge.
    lowest = self.starts.gaps[stance].min(axis=1)
    np.testing.assert_allclose(lowest, 0.0, atol=1e-3)
    stance[self.starts.modes == _NAMES.index('step_down')] = False
    lowest = np.sort(self.starts.gaps[stance], axis=1)[:, :4]
    np.testing.assert_allclose(lowest, 0.0, atol=1e-3)
    heights = self.starts.worlds.qpos[standing, 2]
    assert np.ptp(heights) > 0.1  # Not all at the crouch.

  def test_standing_feet_do_not_rise_or_sink(self) -> None:
    stance = self._standing_feet()
    speeds = self.starts.speeds[stance]
    np.testing.assert_allclose(speeds[:, 5], 0.0, atol=1e-4)  # Upwards.
    np.testing.assert_allclose(speeds[:, :3], 0.0, atol=1e-4)  # Turning.
    climbs = self.starts.worlds.qvel[stance.all(axis=1), 2]
    assert climbs.max() > 0.5
    assert climbs.min() < -0.2

  def test_one_foot_swings_where_the_reference_s_does(self) -> None:
    """Up to 6 cm high, and past the foot that stands as the trunk is."""
    starts = self.starts
    every = np.arange(len(starts.modes))
    swinging, time, length = starts.tracker.swing_timing(every)
    walking = swinging.sum(axis=1) > 0
    names = {_MOTIONS[mode].name for mode in starts.modes[walking]}
    directions = ('forward', 'backward', 'left', 'right')
    turns = {'turn_left', 'turn_right'}
    assert names == ({f'walk_{d}' for d in directions} | turns)
    np.testing.assert_array_equal(swinging.sum(axis=1), walking)
    np.testing.assert_array_equal(
      swinging, walking[:, None] & (starts.reference.contact == 0)
    )
    height = starts.gaps[swinging].min(axis=1)
    share = time[walking] / length[walking]
    expected = 0.06 * np.cos(np.pi * share)
    np.testing.assert_allclose(height, expected, atol=1e-3)
    assert height.max() > 0.05
    # The foot that stands is at rest along the way.
    walking &= starts.reference.position[:, 1] == 0  # Not sideways.
    stance = ~swinging & walking[:, None]
    np.testing.assert_allclose(starts.speeds[stance][:, 3], 0.0, atol=1e-4)
    flown = starts.speeds[swinging & walking[:, None]][:, 3]
    trunk = starts.worlds.qvel[walking, 0]
    np.testing.assert_allclose(flown, 2 * trunk, atol=1e-4)

  def test_trunk_is_on_its_reference(self) -> None:
    """But where legs would be in the block, or in the edge behind them."""
    starts = self.starts
    position, wanted = starts.worlds.qpos[:, :3], starts.reference.position
    np.testing.assert_array_equal(position[:, :2], wanted[:, :2])
    assert np.all(position[:, 2] >= wanted[:, 2])
    lifted = self._lifted()
    names = {_MOTIONS[mode].name for mode in starts.modes[lifted]}
    assert names == ({'launch', 'step_down'})
    top = starts.worlds.core.terrain.tops[:, :2].max(axis=1)
    lifted &= starts.tracker.airborne(np.arange(len(lifted)))
    np.testing.assert_allclose(
      position[lifted, 2], top[lifted] + constants.STAND_HEIGHT
    )

  def test_velocity_is_the_reference_s_or_slower(self) -> None:
    starts = self.starts
    every = np.arange(len(starts.modes))
    _, _, velocity = starts.tracker.start_pose(every)
    moved = starts.worlds.qvel[:, :3]
    swinging, _, _ = starts.tracker.swing_timing(every)
    velocity = velocity[~swinging.any(axis=1)]  # The others sway.
    moved = moved[~swinging.any(axis=1)]
    moving = np.linalg.norm(velocity, axis=1) > 0
    pace = np.sum(moved * velocity, axis=1)[moving]
    pace /= np.sum(velocity**2, axis=1)[moving]
    assert 0.5 <= pace.min() <= 0.6
    assert 0.9 <= pace.max() <= 1.0
    np.testing.assert_allclose(moved[moving], pace[:, None] * velocity[moving])
    np.testing.assert_array_equal(moved[~moving], 0.0)
    np.testing.assert_array_equal(starts.worlds.qvel[:, 3:6], 0.0)

  def test_legs_are_drawn_up_in_flight(self) -> None:
    aloft = self.starts.tracker.airborne(np.arange(len(self.starts.modes)))
    legs_then = self.starts.worlds.qpos[aloft, 7:]
    np.testing.assert_allclose(legs_then, 0.0, atol=1e-12)
    np.testing.assert_array_equal(self.starts.worlds.qvel[aloft, 6:], 0.0)


class TestObstacleStart(TestReferenceStart):
  """The same holds where obstacles are ahead, and below."""

  obstacle_share = 1.0

  def test_they_are_there(self) -> None:
    names = {
      'walk_forward',
      'leap_forward',
      'hop_forward',
      'launch',
      'step_down',
    }
    core = self.starts.worlds.core
    meeting = np.isfinite(core.terrain.starts[:, 1])
    found = {_MOTIONS[mode].name for mode in self.starts.modes[meeting]}
    assert found == names
    assert meeting.sum() == len(names) * _PHASES
    # Some begin over gaps, and some on blocks that are too low.
    x = self.starts.worlds.qpos[:, 0]
    over = (x > core.terrain.ends[:, 0]) & (x < core.terrain.starts[:, 1])
    assert over.sum() > 0
    on = x > core.terrain.starts[:, 1]
    assert (np.sum(on & (core.terrain.tops[:, 1] < 0.3))) > 3

  def test_gaits_have_them_ahead_of_where_they_are(self) -> None:
    starts = self.starts
    walking = starts.modes == _NAMES.index('walk_forward')
    x = starts.worlds.qpos[walking, 0]
    assert x.max() > 0.3
    distance = starts.worlds.core.terrain.starts[walking, 1] - x
    assert 0.15 <= distance.min() <= 0.25
    assert 1.1 <= distance.max() <= 1.2


@pytest.mark.parametrize('obstacle_share', [0.0, 1.0])
def test_every_mode_begins_in_the_crouch_at_rest(obstacle_share: float) -> None:
  starts = _Starts(0.0, obstacle_share)
  expected = np.zeros((len(starts.modes), 17))
  expected[:, 2], expected[:, 3] = constants.STAND_HEIGHT, 1.0
  np.testing.assert_allclose(starts.worlds.qpos, expected, atol=1e-12)
  np.testing.assert_array_equal(
    starts.worlds.qvel, np.zeros((len(starts.modes), 16))
  )
  np.testing.assert_array_equal(starts.tracker.state.phase, 0.0)
  lowest = starts.gaps.min(axis=2)
  np.testing.assert_allclose(lowest, 0.0, atol=1e-3)


_GROUND_END = 40.0  # Metres.
_LEVEL = ((-20.0, _GROUND_END, 0.0),)
_NONE = np.inf


def _ground(
  num_worlds: int, *segments: tuple[float, float, float]
) -> terrain.Terrain:
  """The same (start, end, top) triples in every world."""
  result = terrain.empty(num_worlds, 6)
  for i, segment in enumerate(segments):
    for field, value in zip(result, segment, strict=True):
      field[:, i] = value
  return result


def _modes(*names: str) -> np.ndarray:
  return np.array([_NAMES.index(name) for name in names])


def _begun(
  names: Sequence[str],
  segments: Sequence[tuple[float, float, float]] = _LEVEL,
  adaptive: bool = True,
  seed: int = 0,
  **changes: Any,
) -> tuple[imitation_core.ImitationCore, np.random.RandomState]:
  """Worlds that begin with these modes, and what they draw from.

  On adaptive terrain they begin on level ground, which the segments replace.
  """
  task_config = config.ImitationConfig(
    events=dataclasses.replace(events.NONE, **changes)
  )
  count = len(names)
  core = imitation_core.ImitationCore(
    mode_set.one_hot(_MOTIONS), task_config, count, 6, adaptive, 1
  )
  modes, random_state = _modes(*names), np.random.RandomState(seed)
  ids = np.arange(count)
  start = _ground(count, *(_LEVEL if adaptive else segments))
  plan = episodes.Episodes(schedule.single(modes), modes, modes)
  core.start(ids, plan, start, random_state)
  if adaptive and segments is not _LEVEL:
    core.terrain.write(ids, _ground(count, *segments))
  return core, random_state


def _qpos(x: np.ndarray) -> np.ndarray:
  result = np.zeros((len(x), 17))
  result[:, 0], result[:, 2], result[:, 3] = x, 0.5, 1.0
  return result


def _command(
  core: imitation_core.ImitationCore,
  names: Sequence[str],
  x: Sequence[float] | np.ndarray,
  random_state: np.random.RandomState,
) -> np.ndarray:
  """Commands modes in all worlds, where their robots are at `x`."""
  return core.command(
    np.arange(len(names)), _modes(*names), _qpos(np.array(x)), random_state
  )


def _assert_segments(
  core: imitation_core.ImitationCore,
  world: int,
  *segments: tuple[float, float, float],
) -> None:
  expected = _ground(1, *segments)
  for mine, wanted in zip(core.terrain, expected, strict=True):
    np.testing.assert_allclose(mine[world], wanted[0], atol=1e-12)


def _drawing(
  edge: Sequence[float], height: Sequence[float], gap: Sequence[float]
) -> Any:
  """Lets the source draw these."""
  return mock.patch.object(
    obstacles.ObstacleSource,
    'draw',
    return_value=obstacles.Obstacles(*map(np.array, (edge, height, gap))),
  )


def test_commands_meet_what_is_drawn() -> None:
  """At 0 m, and at 1, 2, and 3 m on a step of 0.2 m that begins at 0.5 m."""
  step = (-20.0, 0.5, 0.0), (0.5, _GROUND_END, 0.2)
  core, random_state = _begun(['idle'] * 4, step, obstacles=1.0)
  names = ['walk_forward', 'leap_forward', 'launch', 'idle']
  with _drawing(
    [0.8, 0.6, 0.3, _NONE], [-0.1, 0.05, 0.2, 0.0], [0.0, 0.3, 0.1, 0.0]
  ) as draw:
    changed = _command(core, names, [0, 1, 2, 3], random_state)
  modes, ahead, _ = draw.call_args.args
  np.testing.assert_array_equal(modes, _modes(*names))
  np.testing.assert_array_equal(ahead, np.zeros(4))
  assert {0, 1, 2} <= set(changed)
  _assert_segments(core, 0, (-20, 0.8, 0), (0.8, _GROUND_END, -0.1))
  behind = (-20.0, 0.5, 0.0)
  _assert_segments(core, 1, behind, (0.5, 1.3, 0.2), (1.6, _GROUND_END, 0.25))
  _assert_segments(core, 2, behind, (0.5, 2.2, 0.2), (2.3, _GROUND_END, 0.4))
  _assert_segments(core, 3, *step)


def test_some_commands_do() -> None:
  """The others find level ground, and launch the block it is made for."""
  count = 3000
  names = ['walk_forward', 'leap_forward', 'launch'] * count
  core, random_state = _begun(['idle'] * len(names), obstacles=0.25)
  changed = _command(core, names, np.zeros(len(names)), random_state)
  edges, tops = core.terrain.starts[:, 1], core.terrain.tops[:, 1]
  for i in range(2):
    share = float(np.mean(np.isfinite(edges[i::3])))
    assert share == pytest.approx(0.25, abs=0.03)
  own = (edges[2::3] == 0.27) & (tops[2::3] == 0.4)
  assert float(np.mean(own)) == pytest.approx(0.75, abs=0.03)
  assert set(np.flatnonzero(np.isfinite(edges))) <= set(changed)


@pytest.mark.parametrize(
  ('distance', 'rise', 'gap', 'levelled'),
  [
    (0.46, 0.1, 0.0, True),
    (0.46, -0.1, 0.0, True),
    (0.46, 0.1, 0.3, True),
    (0.44, 0.1, 0.0, False),
    (0.44, -0.1, 0.0, False),
    (0.01, 0.1, 0.0, False),
    (0.44, 0.1, 0.3, False),
    (0.44, 0.0, 0.3, True),
    (0.01, 0.0, 0.0, True),
  ],
)
def test_mode_without_obstacle_finds_level_ground(
  distance: float, rise: float, gap: float, levelled: bool
) -> None:
  ground = (
    (-20.0, 1.0 + distance - gap, 0.1),
    (1.0 + distance, _GROUND_END, 0.1 + rise),
  )
  names = ['idle', 'walk_backward', 'leap_left']
  core, random_state = _begun(['walk_left'] * 3, ground, obstacles=1.0)
  changed = _command(core, names, [1.0] * 3, random_state)
  for world in range(3):
    if levelled:
      _assert_segments(core, world, (-20, _GROUND_END, 0.1))
    else:
      _assert_segments(core, world, *ground)
  assert changed.tolist() == ([0, 1, 2] if levelled else [])


def test_step_that_is_near_keeps_obstacles_away() -> None:
  """But for the block of a launch, which must be where it is needed."""
  ground = (-20.0, 0.44, 0.0), (0.44, _GROUND_END, -0.1)
  core, random_state = _begun(['idle'] * 3, ground, obstacles=1.0)
  names = ['walk_forward', 'leap_forward', 'launch']
  with _drawing([0.3], [0.2], [0.05]) as draw:
    changed = _command(core, names, [0.0] * 3, random_state)
  np.testing.assert_array_equal(draw.call_args.args[0], _modes('launch'))
  for world in range(2):
    _assert_segments(core, world, *ground)
  _assert_segments(core, 2, (-20, 0.25, 0), (0.3, _GROUND_END, 0.2))
  assert changed.tolist() == [2]


@pytest.mark.parametrize('changes', [{'adaptive': False}, {'obstacles': 0.0}])
def test_without_obstacles_nothing_is_levelled(changes: dict[str, Any]) -> None:
  ground = (-20.0, 0.5, 0.0), (0.8, _GROUND_END, -0.1)
  core, random_state = _begun(
    ['idle'] * 3, ground, **{'obstacles': 1.0, **changes}
  )
  before = copy.deepcopy(random_state)
  names = ['walk_forward', 'leap_forward', 'walk_left']
  assert not len(_command(core, names, [0.0] * 3, random_state))
  for world in range(3):
    _assert_segments(core, world, *ground)
  # Nor is anything drawn.
  assert random_state.uniform() == before.uniform()


@pytest.mark.parametrize(
  'changes',
  [{'obstacles': 0.0}, {'obstacles': schedules.Schedule(0.0, 1.0, 1, 1)}],
)
def test_without_obstacles_only_edges_are_drawn(
  changes: dict[str, Any],
) -> None:
  """The stream of random numbers by hand, as it was before there were any."""
  core, random_state = _begun(
    ['idle', 'launch', 'launch'], seed=3, edge_noise=0.04, **changes
  )
  by_hand = np.random.RandomState(3)
  by_hand.uniform(size=(2, 3))  # Who starts on the reference, and where.
  noise = 0.04 * by_hand.uniform(-1, 1, 2)
  by_hand.uniform(size=3)  # Their pace.
  for size in (2, 10, 16):  # Tilts, joints, velocities.
    by_hand.standard_normal((3, size))
  _assert_segments(core, 0, *_LEVEL)
  for i in range(2):
    edge = 0.27 + noise[i]
    _assert_segments(core, 1 + i, (-20, edge, 0), (edge, _GROUND_END, 0.4))
  names = ['launch', 'walk_forward', 'idle']
  changed = _command(core, names, [2.0, 0.0, 0.0], random_state)
  edge = 2.27 + 0.04 * by_hand.uniform(-1, 1)
  _assert_segments(core, 0, (-20, edge, 0), (edge, _GROUND_END, 0.4))
  assert changed.tolist() == [0]
  assert random_state.uniform() == by_hand.uniform()


def test_whatever_changes_is_told() -> None:
  """The engines move only these worlds' boxes."""
  names = _NAMES * 20
  count = len(names)
  core, random_state = _begun(['idle'] * count, obstacles=0.5)
  random, x = np.random.RandomState(1), np.zeros(count)
  for _ in range(4):
    before = core.terrain.rows(np.arange(count))
    order = random.permutation(count)
    x += random.uniform(0.0, 0.3, count)
    changed = _command(core, [names[i] for i in order], x, random_state)
    differs = np.zeros(count, dtype=bool)
    for mine, theirs in zip(core.terrain, before, strict=True):
      differs |= (mine != theirs).any(axis=1)
    assert differs.sum() > (count / 5)
    assert set(np.flatnonzero(differs)) <= set(changed)
    assert len(np.unique(changed)) == len(changed)


class TestRiding:
  """References follow the ground under the trunk."""

  def _heights(
    self, core: imitation_core.ImitationCore, *x: float
  ) -> list[float]:
    """Of the first world's reference, where its trunk may be."""
    first = np.array([0])
    return [
      float(core.reference(np.array([where]), first).position[0, 2])
      for where in x
    ]

  def test_walk_over_a_step_down(self) -> None:
    down = (-20.0, 0.5, 0.25), (0.5, _GROUND_END, 0.15)
    core, random_state = _begun(['walk_forward'], down, adaptive=False)
    np.testing.assert_allclose(
      self._heights(core, -1.0, 0.49, 0.5, 3.0), [0.75, 0.75, 0.65, 0.65]
    )
    along = core.reference(np.array([3.0])).position
    np.testing.assert_array_equal(
      along[:, :2], core.tracker.reference().position[:, :2]
    )
    # Once commanded down there, it is at home there.
    _command(core, ['walk_backward'], [0.7], random_state)
    np.testing.assert_allclose(self._heights(core, 0.7, 0.4), [0.65, 0.75])

  def test_reward_is_for_the_reference_on_the_ground(self) -> None:
    """A trunk 0.1 m higher than the ground lets it be is 0.1 m off."""
    down = (-20.0, 0.25, 0.0), (0.25, _GROUND_END, -0.1)
    core, _ = _begun(['idle'] * 3, down, adaptive=False)
    qpos = _qpos(np.array([0.2, 0.3, 0.3]))
    qpos[:, 2] = [0.5, 0.5, 0.4]
    outcome = core.advance(qpos, np.zeros((3, 16)), np.ones((3, 2)))
    np.testing.assert_allclose(
      outcome.reference.position[:, 2], [0.5, 0.4, 0.4]
    )
    expected = np.hypot([0.2, 0.3, 0.3], [0.0, 0.1, 0.0])
    np.testing.assert_allclose(outcome.errors['position'], expected)

  @pytest.mark.parametrize('obstacle_share', [0.0, 0.2])
  def test_launch_onto_its_own_block(self, obstacle_share: float) -> None:
    core, random_state = _begun(['idle'] * 50, obstacles=obstacle_share)
    x = np.linspace(-0.5, 3.0, 50)
    _command(core, ['launch'] * 50, np.full(50, 0.3), random_state)
    own = core.terrain.tops[:, 1] == 0.4
    assert own.sum() > 30
    for _ in range(40):  # Through all of its phases.
      core.tracker.advance()
      np.testing.assert_array_equal(
        core.reference(x).position[own], core.tracker.reference().position[own]
      )

  @pytest.mark.parametrize('gap', [0.0, 0.3])
  def test_launch_onto_half_its_block(self, gap: float) -> None:
    half = (-20.0, 0.5 - gap, 0.1), (0.5, _GROUND_END, 0.3)
    core, _ = _begun(['launch'], half, adaptive=False)
    for _ in range(40):
      core.tracker.advance()
    np.testing.assert_allclose(
      self._heights(core, 0.0, 0.49, 0.5, 2.0), [1.0, 1.0, 0.8, 0.8]
    )

  def test_launch_without_a_block(self) -> None:
    core, _ = _begun(['launch'], adaptive=False)
    for _ in range(40):
      core.tracker.advance()
    assert self._heights(core, 0.0, 0.3, 5.0) == [0.9] * 3

  def test_launch_over_a_gap(self) -> None:
    """Onto ground as high as before it: all of the block is missing."""
    gap = (-20.0, 0.2, 0.0), (0.5, _GROUND_END, 0.0)
    core, _ = _begun(['launch'], gap, adaptive=False)
    np.testing.assert_allclose(self._heights(core, 0.4, 0.5), [0.5, 0.1])

  def test_next_command_knows_nothing_of_the_block(self) -> None:
    core, random_state = _begun(['launch'])
    edge = core.terrain.starts[0, 1]
    _command(core, ['walk_forward'], [0.6], random_state)
    # Up on the block; back on the ground it would be lower by all of it.
    np.testing.assert_allclose(self._heights(core, 0.6, edge), [0.9, 0.9])
    np.testing.assert_allclose(self._heights(core, edge - 0.01), [0.5])

  def test_whoever_goes_back_finds_level_ground(self) -> None:
    """Once past the edge, with both feet: none may be where a box grows."""
    names = ['walk_backward', 'leap_backward', 'walk_left', 'walk_backward']
    core, random_state = _begun(['launch'] * 4)
    edge = core.terrain.starts[0, 1]
    x = edge + np.array([0.3, 0.25, 0.3, 0.15])
    changed = _command(core, names, x, random_state)
    np.testing.assert_array_equal(changed, [0, 1])
    for world in range(4):
      up = (-20, _GROUND_END, 0.4), (-20, edge, 0), (edge, _GROUND_END, 0.4)
      _assert_segments(core, world, *(up[:1] if world < 2 else up[1:]))
    # And who is on the ground from the start stays there.
    core, random_state = _begun(['idle'])
    changed = _command(core, ['walk_backward'], [0.5], random_state)
    assert not len(changed)

  def test_launch_from_a_block_onto_the_next(self) -> None:
    core, random_state = _begun(['launch'])
    _command(core, ['launch'], [0.6], random_state)
    for _ in range(40):
      core.tracker.advance()
    np.testing.assert_allclose(
      self._heights(core, 0.1, 0.6, 0.86, 0.88), [0.9, 1.3, 1.3, 1.3]
    )

  def test_rows_of_some_worlds(self) -> None:
    core, random_state = _begun(_NAMES * 3, obstacles=1.0)
    count = len(_NAMES) * 3
    _command(core, (_NAMES * 3)[::-1], np.zeros(count), random_state)
    x = np.random.RandomState(0).uniform(0.0, 1.2, count)
    every = core.reference(x)
    lifted = every.position[:, 2] - core.tracker.reference().position[:, 2]
    assert np.ptp(lifted) > 0.1
    for ids in (np.array([7, 2, 9]), np.zeros(0, dtype=np.int64), slice(3, 5)):
      for mine, wanted in zip(core.reference(x[ids], ids), every, strict=True):
        np.testing.assert_array_equal(mine, wanted[ids])

  def test_start_on_a_block_that_is_too_low(self) -> None:
    """Who begins when the launch is over stands on what is there."""
    count = 100
    core, random_state = _begun(
      ['launch'] * count, obstacles=1.0, reference_starts=1.0
    )
    modes = _modes('launch').repeat(count)
    plan = episodes.Episodes(schedule.single(modes), modes, modes)
    ground = _ground(count, (-20, _GROUND_END, 0.2))
    with _drawing([0.3] * count, [0.1] * count, [0.0] * count):
      qpos, _ = core.start(np.arange(count), plan, ground, random_state)
    _assert_segments(core, 0, (-20, 0.3, 0.2), (0.3, _GROUND_END, 0.3))
    over = core.tracker.state.phase > 0.83
    assert over.sum() > 5
    np.testing.assert_allclose(
      qpos[over, 2], core.tracker.reference().position[over, 2] - 0.3
    )
