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
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import obstacles
from dmc_multimode.utils import constants
from dmc_multimode.utils import schedule as schedules
from dmc_multimode.walkers import kinematics
from dmc_multimode.walkers import mini_biped

_MOTIONS = library.resolve('pi_all')
_NAMES = [motion.name for motion in _MOTIONS]
_PHASES = 60  # Of each mode, drawn.
_CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)


def test_the_scan_is_of_a_moment_ago() -> None:
  task = multimode_biped.make_task(
    'walk_forward',
    episodes.ScheduledEpisodes(schedule.single(np.zeros(1, dtype=np.int64))),
    'gap',
    config.ImitationConfig(extra_observations=('ground_scan',)),
  )
  worlds = batched_env.BatchedImitation(task, 1, 0, 1)
  worlds.reset()
  qpos, qvel = worlds.qpos.copy(), worlds.qvel.copy()
  qpos[:, 0], qvel[:, 0] = 0.41, 2.0  # The gap begins at 0.8 m.
  scan = worlds.core.observe(qpos, qvel)['ground_scan'][0]
  ahead = np.array(observations.SCAN) + 0.41 - 2.0 * 0.03
  np.testing.assert_array_equal(scan < -0.1, (0.8 < ahead) & (ahead < 1.25))
  qvel[:, 0] = 0.0
  assert (worlds.core.observe(qpos, qvel)['ground_scan'][0] != scan).any()


# --- Starts.


class _Starts:
  """Every mode of the library, begun many times over, without noise.

  Attributes:
    modes: index of the mode of each world, [B].
    qpos, qvel: of the worlds, [B, 17] and [B, 16].
    reference: at the start; its swing: which feet swing, [B, 2].
    aloft: whose reference is in the air, [B].
    lifted: who is over an edge, and higher than its reference, [B].
    stance: which feet stand as the reference does, as legs can, [B, 2].
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
    every = np.arange(len(self.modes))
    worlds = batched_env.BatchedImitation(
      task, len(every), 0, 1, auto_reset=False
    )
    worlds.reset()
    self.core, self.tracker = worlds.core, worlds.core.tracker
    self.terrain, self.phase = self.core.terrain, self.tracker.state.phase
    self.qpos, self.qvel = worlds.qpos, worlds.qvel
    self.reference = self.core.reference(self.qpos[:, 0])
    wanted = self.reference.position
    self.swinging, self.time, self.length = self.tracker.swing_timing(every)
    self.aloft = self.tracker.airborne(every)
    self.lifted = self.qpos[:, 2] > wanted[:, 2]
    height = wanted[:, 2] - self.core.support(wanted[:, 0])
    reach = (height >= kinematics.LOWEST) & (height <= kinematics.HIGHEST)
    reach &= ~self.lifted & ~self.aloft
    self.stance = reach[:, None] & ~self.swinging
    self._measure_feet(worlds.physics.model)

  def _measure_feet(self, model: mujoco.MjModel) -> None:
    data, shape = mujoco.MjData(model), self.swinging.shape
    self.gaps, self.speeds = np.zeros((*shape, 8)), np.zeros((*shape, 6))
    for world, i in np.ndindex(shape):
      data.qpos[:], data.qvel[:] = self.qpos[world], self.qvel[world]
      mujoco.mj_forward(model, data)
      ground = terrain.Terrain(
        *(np.tile(f[world], (8, 1)) for f in self.terrain)
      )
      foot = data.geom(f'walker/{mini_biped.SIDES[i]}_foot')
      half_sizes = model.geom(foot.id).size[:, None]
      offsets = foot.xmat.reshape(3, 3) @ (_CORNERS * half_sizes)
      x, _, z = foot.xpos[:, None] + offsets
      self.gaps[world, i] = z - terrain.support_height(ground, x)
      kind, speed = mujoco.mjtObj.mjOBJ_GEOM, self.speeds[world, i]
      mujoco.mj_objectVelocity(model, data, kind, foot.id, speed, 0)

  def names(self, rows: np.ndarray) -> set[str]:
    """Of the modes of these worlds."""
    return {_NAMES[mode] for mode in self.modes[rows]}


@pytest.fixture(scope='module', params=[0.0, 1.0], ids=['level', 'obstacles'])
def starts(request: pytest.FixtureRequest) -> _Starts:
  """On the reference, on level ground or with obstacles ahead and below."""
  return _Starts(1.0, request.param)


def test_feet_stand_where_the_reference_stands(starts: _Starts) -> None:
  # No foot is in the ground or in a block.
  depth = -starts.gaps.min(axis=(1, 2))
  worst = depth.argmax()
  name = _NAMES[starts.modes[worst]]
  assert depth[worst] < 1e-3, f'{name} at phase {starts.phase[worst]}'
  stance = starts.stance.copy()
  standing = stance.any(axis=1)
  assert len(np.unique(starts.modes[standing])) == len(_MOTIONS)
  assert np.ptp(starts.qpos[standing, 2]) > 0.1  # Not all at the crouch.
  # They neither turn nor rise nor sink, though trunks do.
  speeds = starts.speeds[stance]
  np.testing.assert_allclose(speeds[:, [0, 1, 2, 5]], 0.0, atol=1e-4)
  climbs = starts.qvel[stance.all(axis=1), 2]
  assert climbs.max() > 0.5
  assert climbs.min() < -0.2
  # The soles, flat, on the ground; toes may reach over an edge.
  lowest = starts.gaps[stance].min(axis=1)
  np.testing.assert_allclose(lowest, 0.0, atol=1e-3)
  stance[starts.modes == _NAMES.index('step_down')] = False
  lowest = np.sort(starts.gaps[stance], axis=1)[:, :4]
  np.testing.assert_allclose(lowest, 0.0, atol=1e-3)


def test_one_foot_swings_where_the_reference_s_does(starts: _Starts) -> None:
  """Up to 6 cm high, and past the foot that stands as the trunk is."""
  swinging = starts.swinging
  walking = np.asarray(swinging.any(axis=1))
  walks = {f'walk_{d}' for d in ('forward', 'backward', 'left', 'right')}
  assert starts.names(walking) == walks | {'turn_left', 'turn_right'}
  np.testing.assert_array_equal(swinging.sum(axis=1), walking)
  np.testing.assert_array_equal(
    swinging, walking[:, None] & (starts.reference.contact == 0)
  )
  height = starts.gaps[swinging].min(axis=1)
  share = starts.time[walking] / starts.length[walking]
  np.testing.assert_allclose(height, 0.06 * np.cos(np.pi * share), atol=1e-3)
  assert height.max() > 0.05
  # The foot that stands is at rest along the way.
  walking &= starts.reference.position[:, 1] == 0  # Not sideways.
  stance = ~swinging & walking[:, None]
  np.testing.assert_allclose(starts.speeds[stance][:, 3], 0.0, atol=1e-4)
  flown = starts.speeds[swinging & walking[:, None]][:, 3]
  np.testing.assert_allclose(flown, 2 * starts.qvel[walking, 0], atol=1e-4)


def test_trunk_is_on_its_reference(starts: _Starts) -> None:
  """But where legs would be in the block, or in the edge behind them."""
  position, wanted = starts.qpos[:, :3], starts.reference.position
  np.testing.assert_array_equal(position[:, :2], wanted[:, :2])
  assert np.all(position[:, 2] >= wanted[:, 2])
  assert starts.names(starts.lifted) == {'launch', 'step_down'}
  top = starts.terrain.tops[:, :2].max(axis=1)
  lifted = starts.lifted & starts.aloft
  np.testing.assert_allclose(
    position[lifted, 2], top[lifted] + constants.STAND_HEIGHT
  )


def test_velocity_is_the_reference_s_or_slower(starts: _Starts) -> None:
  _, _, velocity = starts.tracker.start_pose(np.arange(len(starts.modes)))
  calm = ~starts.swinging.any(axis=1)  # The others sway.
  velocity, moved = velocity[calm], starts.qvel[calm, :3]
  moving = np.linalg.norm(velocity, axis=1) > 0
  pace = np.sum(moved * velocity, axis=1)[moving]
  pace /= np.sum(velocity**2, axis=1)[moving]
  assert 0.5 <= pace.min() <= 0.6
  assert 0.9 <= pace.max() <= 1.0
  np.testing.assert_allclose(moved[moving], pace[:, None] * velocity[moving])
  np.testing.assert_array_equal(moved[~moving], 0.0)
  np.testing.assert_array_equal(starts.qvel[:, 3:6], 0.0)
  # Legs are drawn up in flight.
  leaps = {f'leap_{d}' for d in ('forward', 'backward', 'left', 'right')}
  jumps = {'hop_forward', 'launch', 'step_down'}
  assert starts.names(starts.aloft) == jumps | leaps
  legs_then = starts.qpos[starts.aloft, 7:]
  np.testing.assert_allclose(legs_then, 0.0, atol=1e-12)
  np.testing.assert_array_equal(starts.qvel[starts.aloft, 6:], 0.0)


@pytest.mark.parametrize('starts', [1.0], indirect=True)
def test_obstacles_are_ahead_and_below(starts: _Starts) -> None:
  names = {'walk_forward', 'leap_forward', 'hop_forward', 'launch', 'step_down'}
  edges = starts.terrain.starts[:, 1]
  meeting = np.isfinite(edges)
  assert starts.names(meeting) == names
  assert meeting.sum() == len(names) * _PHASES
  # Some begin over gaps, and some on blocks that are too low.
  x = starts.qpos[:, 0]
  assert np.sum((x > starts.terrain.ends[:, 0]) & (x < edges)) > 0
  assert np.sum((x > edges) & (starts.terrain.tops[:, 1] < 0.3)) > 3
  # Gaits have them ahead of where they are.
  walking = starts.modes == _NAMES.index('walk_forward')
  assert x[walking].max() > 0.3
  distance = (edges - x)[walking]
  assert 0.15 <= distance.min() <= 0.25
  assert 1.1 <= distance.max() <= 1.2


@pytest.mark.parametrize('obstacle_share', [0.0, 1.0])
def test_every_mode_begins_in_the_crouch_at_rest(obstacle_share: float) -> None:
  starts = _Starts(0.0, obstacle_share)
  expected = np.zeros((len(starts.modes), 17))
  expected[:, 2], expected[:, 3] = constants.STAND_HEIGHT, 1.0
  np.testing.assert_allclose(starts.qpos, expected, atol=1e-12)
  np.testing.assert_array_equal(starts.qvel, 0.0)
  np.testing.assert_array_equal(starts.phase, 0.0)
  np.testing.assert_allclose(starts.gaps.min(axis=2), 0.0, atol=1e-3)


# --- Commands on adaptive terrain.

_Segment = tuple[float, float, float]  # Start, end, top; metres.
_GROUND_END = 40.0  # Metres.
_LEVEL: tuple[_Segment, ...] = ((-20.0, _GROUND_END, 0.0),)
_NONE = np.inf


def _ground(num_worlds: int, *segments: _Segment) -> terrain.Terrain:
  """The same in every world."""
  result = terrain.empty(num_worlds, 6)
  for i, segment in enumerate(segments):
    for field, value in zip(result, segment, strict=True):
      field[:, i] = value
  return result


def _modes(*names: str) -> np.ndarray:
  return np.array([_NAMES.index(name) for name in names])


def _begun(
  names: Sequence[str],
  segments: Sequence[_Segment] = _LEVEL,
  adaptive: bool = True,
  seed: int = 0,
  **changes: Any,
) -> tuple[imitation_core.ImitationCore, np.random.RandomState]:
  """Worlds that begin with these modes, and what they draw from.

  On adaptive terrain they begin on level ground, which the segments replace.
  """
  task_config = config.ImitationConfig(
    events=dataclasses.replace(events.NONE, **changes),
    commands_from_ground=False,
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


def _command(
  core: imitation_core.ImitationCore,
  names: Sequence[str],
  x: Sequence[float] | np.ndarray,
  random_state: np.random.RandomState,
) -> np.ndarray:
  """Commands modes in all worlds, where their robots are at `x`."""
  return core.command(
    np.arange(len(names)),
    _modes(*names),
    _qpos(x),
    np.zeros((len(names), 16)),
    random_state,
  )


def _qpos(x: Sequence[float] | np.ndarray) -> np.ndarray:
  result = np.zeros((len(x), 17))
  result[:, 0], result[:, 2], result[:, 3] = x, 0.5, 1.0
  return result


def _assert_segments(
  core: imitation_core.ImitationCore, world: int, *segments: _Segment
) -> None:
  expected = _ground(1, *segments)
  for mine, wanted in zip(core.terrain, expected, strict=True):
    np.testing.assert_allclose(mine[world], wanted[0], atol=1e-12)


def _drawing(
  edge: Sequence[float], height: Sequence[float], gap: Sequence[float]
) -> Any:
  """Makes the obstacle source return these."""
  return mock.patch.object(
    obstacles.ObstacleSource,
    'draw',
    return_value=obstacles.Obstacles(*map(np.array, (edge, height, gap))),
  )


def test_commands_meet_what_is_drawn() -> None:
  """At 0 m, and at 1, 2, and 3 m on a ledge of 0.2 m that begins at 0.5 m."""
  ledge = behind, _ = (-20.0, 0.5, 0.0), (0.5, _GROUND_END, 0.2)
  core, random_state = _begun(
    ['idle'] * 3 + ['hop_forward'], ledge, obstacles=1.0
  )
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
  _assert_segments(core, 1, behind, (0.5, 1.3, 0.2), (1.6, _GROUND_END, 0.25))
  _assert_segments(core, 2, behind, (0.5, 2.2, 0.2), (2.3, _GROUND_END, 0.4))
  _assert_segments(core, 3, *ledge)


def test_some_commands_do() -> None:
  """The others find level ground, and launch the block it is made for."""
  names = ['walk_forward', 'leap_forward', 'launch'] * 3000
  core, random_state = _begun(['idle'] * len(names), obstacles=0.25)
  changed = _command(core, names, np.zeros(len(names)), random_state)
  edges, tops = core.terrain.starts[:, 1], core.terrain.tops[:, 1]
  own = (edges[2::3] == 0.27) & (tops[2::3] == 0.4)
  shares = [np.isfinite(edges[i::3]).mean() for i in range(2)]
  np.testing.assert_allclose(
    [*shares, own.mean()], [0.25, 0.25, 0.75], atol=0.03
  )
  assert set(np.flatnonzero(np.isfinite(edges))) <= set(changed)


@pytest.mark.parametrize(
  ('distance', 'rise', 'gap', 'levelled'),
  [
    (0.46, 0.1, 0.0, True),
    (0.46, -0.1, 0.0, True),
    (0.46, 0.1, 0.3, True),
    # A foot may be on it already.
    (0.44, 0.1, 0.0, False),
    (0.44, -0.1, 0.0, False),
    (0.01, 0.1, 0.0, False),
    (0.44, 0.1, 0.3, False),
    # It is as high as the ground here.
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
  expected = ((-20.0, _GROUND_END, 0.1),) if levelled else ground
  for world in range(3):
    _assert_segments(core, world, *expected)
  assert changed.tolist() == ([0, 1, 2] if levelled else [])


def test_ledge_that_is_near_keeps_obstacles_away() -> None:
  """But for the block of a launch, which must be where it is needed."""
  ground = (-20.0, 0.44, 0.0), (0.44, _GROUND_END, -0.1)
  core, random_state = _begun(['idle'] * 3, ground, obstacles=1.0)
  names = ['walk_forward', 'leap_forward', 'launch']
  with _drawing([0.3], [0.2], [0.05]) as draw:
    changed = _command(core, names, [0.0] * 3, random_state)
  np.testing.assert_array_equal(draw.call_args.args[0], _modes('launch'))
  _assert_segments(core, 0, *ground)
  _assert_segments(core, 1, *ground)
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
  'share', [0.0, schedules.Schedule(0.0, 1.0, 1, 1)], ids=['none', 'later']
)
def test_without_obstacles_only_edges_are_drawn(share: Any) -> None:
  """The stream of random numbers by hand, as it was before there were any."""
  core, random_state = _begun(
    ['idle', 'launch', 'launch'], seed=3, edge_noise=0.04, obstacles=share
  )
  by_hand = np.random.RandomState(3)
  by_hand.uniform(size=(2, 3))  # Who starts on the reference, and where.
  noise = 0.04 * by_hand.uniform(-1, 1, 2)
  by_hand.uniform(size=3)  # Their pace.
  for size in (2, 10, 16):  # Tilts, joints, velocities.
    by_hand.standard_normal((3, size))
  _assert_segments(core, 0, *_LEVEL)
  for i, edge in enumerate(0.27 + noise):
    _assert_segments(core, 1 + i, (-20, edge, 0), (edge, _GROUND_END, 0.4))
  names = ['launch', 'walk_forward', 'idle']
  changed = _command(core, names, [2.0, 0.0, 0.0], random_state)
  edge = 2.27 + 0.04 * by_hand.uniform(-1, 1)
  _assert_segments(core, 0, (-20, edge, 0), (edge, _GROUND_END, 0.4))
  assert changed.tolist() == [0]
  assert random_state.uniform() == by_hand.uniform()


# --- References follow the ground under the trunk.


def _heights(core: imitation_core.ImitationCore, *x: float) -> list[float]:
  """Of the first world's reference, where its trunk may be."""
  return [
    float(core.reference(np.array([where])).position[0, 2]) for where in x
  ]


def test_walk_over_a_ledge_down() -> None:
  down = (-20.0, 0.5, 0.25), (0.5, _GROUND_END, 0.15)
  core, random_state = _begun(['walk_forward'], down, adaptive=False)
  np.testing.assert_allclose(
    _heights(core, -1.0, 0.49, 0.5, 3.0), [0.75, 0.75, 0.65, 0.65]
  )
  along = core.reference(np.array([3.0])).position
  np.testing.assert_array_equal(
    along[:, :2], core.tracker.reference().position[:, :2]
  )
  # Once commanded down there, it is at home there.
  _command(core, ['walk_backward'], [0.7], random_state)
  np.testing.assert_allclose(_heights(core, 0.7, 0.4), [0.65, 0.75])


def test_reward_is_for_the_reference_on_the_ground() -> None:
  """A trunk 0.1 m higher than the ground lets it be is 0.1 m off."""
  down = (-20.0, 0.25, 0.0), (0.25, _GROUND_END, -0.1)
  core, _ = _begun(['idle'] * 3, down, adaptive=False)
  qpos = _qpos([0.2, 0.3, 0.3])
  qpos[:, 2] = [0.5, 0.5, 0.4]
  outcome = core.advance(qpos, np.zeros((3, 16)), np.ones((3, 2)))
  np.testing.assert_allclose(outcome.reference.position[:, 2], [0.5, 0.4, 0.4])
  expected = np.hypot([0.2, 0.3, 0.3], [0.0, 0.1, 0.0])
  np.testing.assert_allclose(outcome.errors['position'], expected)


@pytest.mark.parametrize('obstacle_share', (0.0, 0.2))
def test_launch_onto_its_own_block(obstacle_share: float) -> None:
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


@pytest.mark.parametrize(
  ('segments', 'x', 'expected'),
  [
    # Half the block, with and without a gap before it.
    (((-20.0, 0.5, 0.1), (0.5, 40.0, 0.3)), (0.0, 0.49, 0.5), (1.0, 1.0, 0.8)),
    (((-20.0, 0.2, 0.1), (0.5, 40.0, 0.3)), (0.0, 0.49, 0.5), (1.0, 1.0, 0.8)),
    # None.
    (_LEVEL, (0.0, 0.3, 5.0), (0.9, 0.9, 0.9)),
    # Onto ground as high as before the gap: all of the block is missing.
    (((-20.0, 0.2, 0.0), (0.5, 40.0, 0.0)), (0.4, 0.5), (0.9, 0.5)),
  ],
)
def test_launch_onto_another_block(
  segments: Sequence[_Segment], x: Sequence[float], expected: Sequence[float]
) -> None:
  core, _ = _begun(['launch'], segments, adaptive=False)
  for _ in range(40):
    core.tracker.advance()
  np.testing.assert_allclose(_heights(core, *x), expected)


def test_next_command_knows_nothing_of_the_block() -> None:
  core, random_state = _begun(['launch'])
  edge = core.terrain.starts[0, 1]
  _command(core, ['walk_forward'], [0.6], random_state)
  # Up on the block; back on the ground it would be lower by all of it.
  np.testing.assert_allclose(_heights(core, 0.6, edge), [0.9, 0.9])
  np.testing.assert_allclose(_heights(core, edge - 0.01), [0.5])
  # From it onto the next.
  _command(core, ['launch'], [0.6], random_state)
  for _ in range(40):
    core.tracker.advance()
  np.testing.assert_allclose(
    _heights(core, 0.1, 0.6, 0.86, 0.88), [0.9, 1.3, 1.3, 1.3]
  )


def test_whoever_goes_back_finds_level_ground() -> None:
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
  assert not len(_command(core, ['walk_backward'], [0.5], random_state))
