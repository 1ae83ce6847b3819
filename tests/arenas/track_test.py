"""Tests of dmc_multimode.arenas.track."""

from typing import Any, Callable

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.variation import distributions
from dm_control.locomotion import walkers
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.walkers import cmu_humanoid
import mujoco
import numpy as np
import pytest

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain as terrain_lib
from dmc_multimode.arenas import track
from dmc_multimode.walkers import mini_biped

_NUM_TRACKS = 200
_RADIUS = 0.05  # Metres.
_DROP = 0.01  # Metres.
_SETTLED = 60  # Physics steps of 5 ms.
_FROM_END = 0.06  # Metres: the ball's middle is still over its segment.
_BALLS_A_SEGMENT = 3  # Near the start, in the middle, near the end.


def _add_balls(arena: track.Track) -> list[mjcf.Element]:
  """Adds balls that touch the ground and nothing else; returns the joints."""
  joints = []
  for i in range(arena.num_segments * _BALLS_A_SEGMENT):
    body = arena.mjcf_model.worldbody.add('body', name=f'ball_{i}')
    body.add(
      'geom', type='sphere', size=[_RADIUS], contype=1, conaffinity=0, mass=1
    )
    # Inside it: the trees of bounding volumes are only looked at where a body
    # has two geoms that may collide.
    body.add(
      'geom', type='sphere', size=[0.01], contype=1, conaffinity=0, mass=0
    )
    joints.append(body.add('freejoint', name=f'ball_{i}'))
  arena.mjcf_model.option.timestep = 0.005
  return joints


def _starts_and_heights(
  terrain: terrain_lib.Terrain,
) -> tuple[np.ndarray, np.ndarray]:
  """Returns drop positions on a track and expected heights at rest.

  Balls of unused segments go where the first segment's go.

  Returns:
    Free joints' positions [S * 3, 7], and heights of their rest [S * 3].
  """
  used = np.isfinite(terrain.starts[0])
  starts, ends, tops = (np.where(used, f[0], f[0, 0]) for f in terrain)
  x = np.stack([starts + _FROM_END, (starts + ends) / 2, ends - _FROM_END], -1)
  rest = np.repeat(tops, _BALLS_A_SEGMENT) + _RADIUS
  qpos = np.zeros((x.size, 7))
  qpos[:, 0], qpos[:, 2], qpos[:, 3] = x.ravel(), rest + _DROP, 1.0
  qpos[:, 1] = np.linspace(-3, 3, x.size)
  return qpos, rest


@pytest.mark.parametrize('name', [*layouts.NAMES])
def test_every_layout_generates(name: str) -> None:
  drawn = track.make(name).generate(np.random.RandomState(0))
  used = np.isfinite(drawn.starts[0])
  starts, ends = drawn.starts[0, used], drawn.ends[0, used]
  assert used[0]
  assert np.all(ends > starts)
  assert np.all(starts[1:] >= ends[:-1])
  assert starts[0] < -5.0  # Ground to walk backward on.
  assert ends[-1] > 10.0
  assert drawn.tops[0, 0] == 0.0
  assert track.make(name).adaptive == (name == 'flat')


@pytest.mark.parametrize(
  ('name', 'expected'),
  [
    ('gap', [(-20, 0.8, 0), (1.25, 41.25, 0)]),
    ('plateau', [(-20, 0.7, 0), (0.7, 1.3, 0.2), (1.3, 41.3, 0)]),
    ('block', [(-20, 0.8, 0), (0.8, 40.8, 0.4)]),
    ('gap_block', [(-20, 0.6, 0), (1.05, 1.65, 0), (1.65, 41.65, 0.4)]),
    ('block_down', [(-20, 0.8, 0), (0.8, 40.8, -0.4)]),
    (
      'stairs',
      [
        *((-20, 0.7, 0), (0.7, 0.95, 0.1), (0.95, 1.2, 0.2), (1.2, 1.6, 0.3)),
        *((1.6, 1.85, 0.2), (1.85, 2.1, 0.1), (2.1, 42.1, 0)),
      ],
    ),
    (
      'stepping_stones',
      [
        *((-20, 0.8, 0), (1.0, 1.3, 0), (1.5, 1.8, 0), (2.0, 2.3, 0)),
        (2.5, 42.5, 0),
      ],
    ),
  ],
)
def test_by_hand(name: str, expected: list[tuple[float, float, float]]) -> None:
  arena = track.make(name)
  assert arena.size == (expected[0][1], 4.0)
  drawn = arena.generate(np.random.RandomState(0))
  found = np.stack([field[0, : len(expected)] for field in drawn], axis=-1)
  np.testing.assert_allclose(found, expected)
  assert np.isinf(drawn.starts[0, len(expected) :]).all()
  assert arena.num_segments == max(6, len(expected))


def test_parkour_has_every_obstacle() -> None:
  arena = track.make('parkour')
  random_state = np.random.RandomState(0)
  for _ in range(20):
    drawn = arena.generate(random_state)
    used = np.isfinite(drawn.starts[0])
    gaps = drawn.starts[0, used][1:] - drawn.ends[0, used][:-1]
    assert 0.2 <= gaps.max() <= 0.45
    assert np.sum(gaps > 1e-9) == 1
    rises = np.diff(drawn.tops[0, used])
    assert np.sum(rises > 1e-9) == 2  # A plateau and a block.
    assert rises.max() <= 0.4


def test_pool_is_as_large_as_the_layout_may_need() -> None:
  sizes = {'difficulty': 1.0, 'length': 9.0}
  assert track.make('obstacle_course').num_segments == 19
  assert track.make('obstacle_course', sizes=sizes).num_segments == 41
  assert track.make('flat').num_segments == 6
  assert track.make('obstacle_course', 32).num_segments == 32


def _varied() -> track.Track:
  return track.Track(
    layouts.gap(
      distance=distributions.Uniform(0.5, 1.0),
      width=distributions.Uniform(0.2, 0.4),
    ),
    3,
  )


@pytest.mark.parametrize(
  'make',
  [
    lambda: track.make('parkour'),
    lambda: track.make('obstacle_course'),
    _varied,
  ],
)
def test_one_seed_one_track(make: Callable[[], track.Track]) -> None:
  drawn: list[list[terrain_lib.Terrain]] = []
  for _ in range(2):
    np.random.seed(len(drawn))  # Module-level state must not matter.
    before = np.random.get_state()[1].copy()  # type: ignore[index]
    arena, random_state = make(), np.random.RandomState(7)
    drawn.append([arena.generate(random_state) for _ in range(3)])
    after = np.random.get_state()[1]  # type: ignore[index]
    np.testing.assert_array_equal(before, after)
  for first, second in zip(*drawn, strict=True):
    for mine, other in zip(first, second, strict=True):
      np.testing.assert_array_equal(mine, other)
  assert drawn[0][0].ends[0, 0] != drawn[0][1].ends[0, 0]


@pytest.mark.parametrize(
  'sizes',
  [
    {'length': 0.0},
    {'length': float('nan')},
    {'gap': -0.1},
    {'gap': float('nan')},
    {'height': float('inf')},
  ],
)
def test_impossible_piece(sizes: dict[str, float]) -> None:
  piece = layouts.Piece(**{'length': 1.0, **sizes})
  with pytest.raises(ValueError, match='Piece 1 needs'):
    track.Track((layouts.Piece(1.0), piece), 2).generate(
      np.random.RandomState(0)
    )


def test_rejects() -> None:
  random_state = np.random.RandomState(0)
  with pytest.raises(ValueError, match="'moat'.*flat, gap"):
    track.make('moat')
  with pytest.raises(ValueError, match='num_segments'):
    track.make('flat', 0)
  with pytest.raises(ValueError, match='3 pieces does not fit 2'):
    track.make('plateau', 2).generate(random_state)
  with pytest.raises(ValueError, match='0 pieces'):
    track.Track((), 2).generate(random_state)


def test_composer_balls_rest_on_every_segment() -> None:
  arena, random_state = track.make('parkour'), np.random.RandomState(0)
  joints = _add_balls(arena)
  physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
  for _ in range(_NUM_TRACKS):
    with physics.reset_context():
      arena.apply(physics, arena.generate(random_state))
      qpos, rest = _starts_and_heights(arena.terrain)
      physics.bind(joints).qpos = qpos.ravel()
    centres, halves = terrain_lib.boxes(arena.terrain)
    geoms = physics.bind(arena.ground_geoms)
    np.testing.assert_allclose(geoms.xpos, centres[0])
    np.testing.assert_allclose(geoms.size, halves[0])
    mujoco.mj_step(physics.model.ptr, physics.data.ptr, nstep=_SETTLED)
    heights = np.asarray(physics.bind(joints).qpos).reshape(-1, 7)[:, 2]
    np.testing.assert_allclose(heights, rest, atol=3e-3)


@pytest.mark.parametrize(
  ('make', 'name'),
  [
    (mini_biped.MiniBiped, 'parkour'),
    (cmu_humanoid.CMUHumanoid, 'gap_block'),
    (walkers.Rat, 'plateau'),
    (walkers.Ant, 'flat'),
  ],
)
def test_robots_and_a_task_of_dm_control(
  make: Callable[[], Any], name: str
) -> None:
  """A robot falls as on dm_control's floor; every episode draws a track."""
  heights: list[float] = []
  edges: list[float] = []
  for arena in (track.make(name), floors.Floor(), track.make(name)):
    robot = make()
    task = go_to_target.GoToTarget(robot, arena, walker_spawn_position=(0, 0))
    env = composer.Environment(task, random_state=len(heights))
    env.reset()
    contacts = 0
    for _ in range(8):
      step = env.step(np.zeros(env.action_spec().shape))
      assert all(np.isfinite(v).all() for v in step.observation.values())
      contacts += env.physics.data.ncon
    assert contacts
    heights.append(env.physics.bind(robot.root_body).xpos[2])
    edges.append(env.physics.bind(arena.ground_geoms[0]).size[0])
    assert abs(env.task.target_position(env.physics)[0]) < arena.size[0]
  np.testing.assert_allclose(heights, heights[1], rtol=0.05)
  assert (edges[0] != edges[2]) == (name == 'parkour')


def test_endless_track_grows_ahead_and_stays_where_it_is_seen() -> None:
  arena, random_state = track.endless(1.0), np.random.RandomState(0)
  terrain, grown = arena.generate(random_state), 0
  for x in np.arange(0.0, 60.0, 0.5):
    new = arena.extended(terrain, x, random_state)
    if new is not None:
      grown += 1
      near = x + np.arange(-2.5, 3.9, 0.01)[None]
      np.testing.assert_array_equal(
        terrain_lib.profile(new, near), terrain_lib.profile(terrain, near)
      )
      terrain = new
    starts, ends = (field[0] for field in (terrain.starts, terrain.ends))
    used = np.isfinite(starts)
    assert (np.diff(starts[used]) > 0).all() and (ends > starts)[used].all()
    assert (ends[used][:-1] <= starts[used][1:] + 1e-9).all()
    assert starts[used][-1] > x + 3.9 and starts[0] < x - 15
  assert grown > 6
