"""Tests of dmc_multimode.suite.imitation.batched_env.

Composer advances with mj_step2 and mj_step1, the batch with mj_step: in
floating point that is one and the same. Positions and rewards were found equal
bit for bit over every mode and arena, and observations up to their rounding to
float32. The tolerances leave room for other processors' instructions, no more.
"""

import dataclasses
from typing import Any, Callable

from dm_control import composer
import dm_env
import mujoco
import numpy as np
import pytest

from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import terrain
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import composer_task
from dmc_multimode.suite.imitation import config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import schedule as schedules

_MOTIONS = tuple(library.modes().values())
_MODE_SET = mode_set.one_hot(_MOTIONS)
_LAUNCH = _MODE_SET.index('launch')
_TOLERANCE = 1e-9
_FLOAT32 = 1e-6  # Of the float32 observations, of which many are about 1.
_STEPS = 30
_SWITCHES = (0.0, 0.36, 0.66)  # Seconds.
_GAINS = rewards.RewardGains().with_weights(
  position=0.35, orientation=0.35, contact=0.3
)
_ENDLESS = config.ImitationConfig(
  gains=_GAINS,
  limits=terminations.NO_LIMITS,
)
_ENDING = config.ImitationConfig(gains=_GAINS)


def _replace(
  task_config: config.ImitationConfig, **changes: Any
) -> config.ImitationConfig:
  """Returns a configuration with changed fields, those of its events too."""
  names = {field.name for field in dataclasses.fields(events.TrainingEvents)}
  scheduled = {name: changes.pop(name) for name in names & set(changes)}
  return dataclasses.replace(
    task_config,
    events=dataclasses.replace(task_config.events, **scheduled),
    **changes,
  )


def _schedule(first: int) -> schedule.ModeSchedule:
  """A mode and two others: over all `first`, every mode is switched to."""
  modes = (first + np.array([0, 4, 7])) % len(_MOTIONS)
  return schedule.ModeSchedule(
    modes[None], np.array([_SWITCHES]), np.array([1.0 + 0.05 * (first % 3)])
  )


def _task(
  arena: str, task_config: config.ImitationConfig
) -> composer_task.Imitation:
  return multimode_biped.make_task(
    _MODE_SET,
    episodes.ScheduledEpisodes(_schedule(0)),
    arena,
    task_config,
  )


def _flat(time_step: dm_env.TimeStep) -> np.ndarray:
  return np.concatenate(list(time_step.observation.values()))


class TestParity:
  """One action sequence and one mode schedule, driven through both engines."""

  def _drive(
    self, env: composer.Environment, mode: int
  ) -> tuple[int, list[int]]:
    """Compares an episode; returns its length and the modes that ran."""
    env.task.episodes = episodes.ScheduledEpisodes(_schedule(mode))
    env.random_state.seed(mode)
    worlds = batched_env.BatchedImitation(
      env.task, 1, seed=mode, num_threads=1, auto_reset=False
    )
    time_step, observation = env.reset(), worlds.reset()
    np.testing.assert_allclose(observation[0], _flat(time_step), atol=_FLOAT32)
    stand, random = worlds.standing_action(), np.random.RandomState(mode)
    ran = {mode}
    for step in range(1, _STEPS + 1):
      action = stand + random.uniform(-0.4, 0.4, 10)
      time_step, other = env.step(action), worlds.step(action[None])
      message = f'{_MOTIONS[mode].name}, step {step}'
      np.testing.assert_allclose(
        other.observation[0],
        _flat(time_step),
        rtol=_FLOAT32,
        atol=_FLOAT32,
        err_msg=message,
      )
      np.testing.assert_allclose(
        other.reward[0], time_step.reward, atol=_TOLERANCE, err_msg=message
      )
      assert other.discount[0] == time_step.discount, message
      assert other.last[0] == time_step.last(), message
      for mine, theirs in zip(
        env.task.core.terrain, worlds.core.terrain, strict=True
      ):
        np.testing.assert_allclose(mine, theirs, atol=_TOLERANCE)
      for mine, theirs in zip(
        env.task.core.tracker.state, worlds.core.tracker.state, strict=True
      ):
        np.testing.assert_allclose(mine, theirs, atol=_TOLERANCE)
      np.testing.assert_allclose(  # The boxes.
        env.physics.data.mocap_pos,
        worlds.physics.batch.bind('mocap_pos')[0],
        atol=_TOLERANCE,
        err_msg=message,
      )
      ran.add(int(worlds.core.tracker.state.mode[0]))
      if time_step.last():
        cause = terminations.CAUSES[other.results.causes[0]]
        assert cause == env.task.termination_cause
        break
    np.testing.assert_allclose(
      worlds.qpos[0], env.physics.data.qpos, atol=_TOLERANCE
    )
    return step, sorted(ran)

  @pytest.mark.parametrize('arena', layouts.NAMES)
  def test_every_mode(self, arena: str) -> None:
    env = multimode_biped.make_environment(_task(arena, _ENDLESS), 0, None)
    for mode in range(len(_MOTIONS)):
      steps, ran = self._drive(env, mode)
      assert steps == _STEPS
      assert len(ran) == 3

  @pytest.mark.parametrize('arena', ['flat', 'parkour'])
  def test_terminations(self, arena: str) -> None:
    env = multimode_biped.make_environment(_task(arena, _ENDING), 0, None)
    lengths = [self._drive(env, mode)[0] for mode in range(len(_MOTIONS))]
    assert np.median(lengths) < _STEPS  # Most of them end.

  @pytest.mark.parametrize('share', (0.5, 1.0))
  @pytest.mark.parametrize('task_config', (_ENDLESS, _ENDING))
  def test_obstacles(
    self, task_config: config.ImitationConfig, share: float
  ) -> None:
    """Drawn at the start, which may be anywhere in a mode, and at switches."""
    task_config = _replace(task_config, obstacles=share, reference_starts=0.5)
    env = multimode_biped.make_environment(_task('flat', task_config), 0, None)
    met, lengths = [], []
    for mode in range(len(_MOTIONS)):
      lengths.append(self._drive(env, mode)[0])
      ground = env.task.core.terrain
      met.append(
        np.isfinite(ground.starts[0]).sum() > 1
        and not np.isin(ground.tops, (0.0, 0.4)).all()
      )
    assert sum(met) > 1
    if task_config.limits is _ENDLESS.limits:
      assert set(lengths) == ({_STEPS})
    else:
      assert np.median(lengths) < _STEPS

  def test_time_limit(self) -> None:
    task_config = _replace(_ENDLESS, time_limit=0.45)
    env = multimode_biped.make_environment(_task('flat', task_config), 0, None)
    assert self._drive(env, 0)[0] == 15

  def test_first_step_has_all_of_eq_2(self) -> None:
    """dm_control resets without actuation; the damping must not be missing."""
    task_config = _replace(_ENDLESS, velocity_noise=3.0)
    env = multimode_biped.make_environment(_task('flat', task_config), 0, None)
    self._drive(env, 0)


def _transitions(
  task_config: config.ImitationConfig = _ENDING, modes: str = 'pi2'
) -> composer_task.Imitation:
  """Algorithm 1 on flat ground."""
  known = mode_set.one_hot(library.resolve(modes))
  return multimode_biped.make_task(
    known,
    episodes.TransitionEpisodes(known),
    config=task_config,
  )


def _rollout(
  worlds: batched_env.BatchedImitation,
  steps: int,
  seed: int = 0,
  spread: float = 0.4,
) -> list[batched_env.BatchedTimeStep]:
  random, stand = np.random.RandomState(seed), worlds.standing_action()
  shape = (worlds.num_worlds, 10)
  return [
    worlds.step(stand + random.uniform(-spread, spread, shape))
    for _ in range(steps)
  ]


def _assert_same(mine: Any, other: Any) -> None:
  """Compares two lists of steps bit for bit."""
  for one, two in zip(mine, other, strict=True):
    for name in one._fields[:-1]:
      np.testing.assert_array_equal(
        getattr(one, name), getattr(two, name), err_msg=name
      )
    for a, b in zip(one.results, two.results, strict=True):
      np.testing.assert_array_equal(a, b)


def test_threads_change_nothing() -> None:
  rollouts = []
  for threads in (1, 2):
    worlds = batched_env.BatchedImitation(
      _transitions(), 16, seed=3, num_threads=threads
    )
    worlds.reset()
    rollouts.append(_rollout(worlds, 60))
  assert (sum(step.last.sum() for step in rollouts[0])) > 16
  _assert_same(*rollouts)


def test_one_seed_one_batch() -> None:
  observed = [
    batched_env.BatchedImitation(_transitions(), 4, seed, 1).reset()
    for seed in (5, 5, 6)
  ]
  np.testing.assert_array_equal(observed[0], observed[1])
  assert not np.array_equal(observed[0], observed[2])


def test_worlds_do_not_know_of_each_other() -> None:
  """Each of several worlds runs as it would alone."""
  count, steps = 5, 40
  # Steps are placed with noise from a generator that worlds share.
  task = _transitions(_replace(_ENDLESS, edge_noise=0.0))
  kwargs = {'auto_reset': False, 'privileged': True}
  many = batched_env.BatchedImitation(task, count, 0, 2, **kwargs)
  many.reset()
  state = many.state()
  random = np.random.RandomState(1)
  actions = random.uniform(-0.5, 0.5, (steps, count, 10))
  together = [many.step(action) for action in actions]
  alone = batched_env.BatchedImitation(task, 1, 0, 1, **kwargs)
  for world in range(count):
    alone.restore(_one_world(state, world))
    for step, action in zip(together, actions, strict=True):
      single = alone.step(action[None, world])
      np.testing.assert_array_equal(
        single.observation[0], step.observation[world]
      )
      assert single.reward[0] == step.reward[world]


def _one_world(
  state: dict[str, np.ndarray], world: int
) -> dict[str, np.ndarray]:
  """Cuts one world out of a saved state."""
  return {
    name: value
    if name.startswith(('random/', 'episodes/')) or not value.ndim
    else value[world : world + 1]
    for name, value in state.items()
  }


@pytest.mark.parametrize('more', [False, True])
def test_observations_at_the_seam(more: bool) -> None:
  """What is observed after an end is the next episode's beginning."""
  worlds, plain = (
    batched_env.BatchedImitation(
      _transitions(), 8, 0, 2, auto_reset=again, privileged=more
    )
    for again in (True, False)
  )
  np.testing.assert_array_equal(worlds.reset(), plain.reset())
  action = np.tile(worlds.standing_action(), (8, 1))
  while True:
    step, other = worlds.step(action), plain.step(action)
    if step.last.any():
      break
    assert not len(step.final_observation)
  ended = np.flatnonzero(step.last)
  np.testing.assert_array_equal(step.results.worlds, ended)
  np.testing.assert_array_equal(
    step.final_observation, other.observation[ended]
  )
  on = ~step.last
  np.testing.assert_array_equal(step.observation[on], other.observation[on])
  now = worlds.core.observe(worlds.qpos, worlds.qvel)
  if more:
    now |= worlds.core.observe_privileged(worlds.qpos)
  np.testing.assert_array_equal(step.observation, observations.flatten(now))
  np.testing.assert_array_equal(
    worlds.core.tracker.state.step[ended], np.zeros(len(ended))
  )
  assert not np.array_equal(step.observation[ended], step.final_observation)


def test_results() -> None:
  """Returns are sums of rewards over horizon times the weights' sum."""
  gains = rewards.RewardGains().with_weights(
    position=0.2, orientation=0.3, contact=0.1
  )
  task_config = config.ImitationConfig(
    gains=gains,
    time_limit=0.9,
    limits=terminations.TerminationLimits(distance=0.5, reward=0.15),
  )
  worlds = batched_env.BatchedImitation(_transitions(task_config), 8, 0, 2)
  worlds.reset()
  totals, lengths = np.zeros(8), np.zeros(8, dtype=int)
  modes = worlds.core.tracker.state.mode.copy()
  causes: list[int] = []
  random, stand = np.random.RandomState(0), worlds.standing_action()
  for _ in range(100):
    step = worlds.step(stand + random.uniform(-0.1, 0.1, (8, 10)))
    totals += step.reward
    lengths += 1
    ended, results = np.flatnonzero(step.last), step.results
    np.testing.assert_array_equal(results.worlds, ended)
    np.testing.assert_array_equal(results.initial, modes[ended])
    np.testing.assert_array_equal(results.lengths, lengths[ended])
    np.testing.assert_allclose(results.returns, totals[ended] / (30 * 0.6))
    timeout = results.causes == 0
    np.testing.assert_array_equal(results.lengths[timeout], 30)
    np.testing.assert_array_equal(step.discount[ended], timeout)
    totals[ended], lengths[ended] = 0.0, 0
    modes[ended] = worlds.core.tracker.state.mode[ended]
    causes += results.causes.tolist()
  assert 0 in causes
  assert len(set(causes)) > 1


def test_sampler_learns_from_results() -> None:
  worlds = batched_env.BatchedImitation(_transitions(), 8, 0, 2)
  worlds.reset()
  sampler = worlds.episodes.sampler  # type: ignore[attr-defined]
  np.testing.assert_array_equal(sampler.initial_returns, np.zeros(4))
  _rollout(worlds, 60)
  assert sampler.initial_returns.max() > 0.0


def test_without_it_only_the_first_end_counts() -> None:
  worlds = batched_env.BatchedImitation(
    _transitions(_replace(_ENDING, time_limit=0.6)),
    4,
    0,
    1,
    auto_reset=False,
  )
  worlds.reset()
  steps = _rollout(worlds, 30)
  ends = np.sum([step.last for step in steps], axis=0)
  np.testing.assert_array_equal(ends, np.ones(4))


@pytest.mark.parametrize('obstacles', (0.0, 0.7))
@pytest.mark.parametrize('more', (False, True))
def test_restored_worlds_go_on_bit_for_bit(
  more: bool, obstacles: float
) -> None:
  task = _transitions(_replace(_ENDING, obstacles=obstacles))
  worlds = batched_env.BatchedImitation(task, 8, 0, 2, privileged=more)
  worlds.reset()
  seen = _rollout(worlds, 25)[-1].observation
  state = worlds.state()
  copies = {name: value.copy() for name, value in state.items()}
  first = _rollout(worlds, 50, seed=1)
  for name, value in state.items():
    np.testing.assert_array_equal(value, copies[name], err_msg=name)
  # Its episodes are its own.
  task = _transitions(_replace(_ENDING, obstacles=obstacles))
  other = batched_env.BatchedImitation(task, 8, 99, 1, privileged=more)
  other.reset()
  observation = other.restore(state)
  np.testing.assert_array_equal(observation, seen)
  second = _rollout(other, 50, seed=1)
  assert (sum(step.last.sum() for step in first)) > 8
  _assert_same(first, second)
  np.testing.assert_array_equal(worlds.restore(state), observation)
  _assert_same(first, _rollout(worlds, 50, seed=1))


def test_step_that_is_expected_is_in_it() -> None:
  """Without it, references would be elsewhere over blocks."""
  task = _transitions(_replace(_ENDLESS, obstacles=1.0))
  worlds, other = (
    batched_env.BatchedImitation(task, 16, seed, 1, privileged=True)
    for seed in (0, 1)
  )
  worlds.reset()
  _rollout(worlds, 10)
  tracked = worlds.core.tracker.state
  expecting = np.isfinite(tracked.edge)
  assert 1 <= expecting.sum() <= 15
  np.testing.assert_array_equal(tracked.rise, np.where(expecting, 0.4, 0.0))
  other.reset()
  other.restore(worlds.state())
  for x in (0.0, 0.3, 1.0):
    np.testing.assert_array_equal(
      other.core.reference(np.full(16, x)).position,
      worlds.core.reference(np.full(16, x)).position,
    )
  lifted = worlds.core.reference(np.full(16, 1.0)).position[expecting, 2]
  lifted -= worlds.core.tracker.reference().position[expecting, 2]
  assert lifted.min() < -0.01  # Blocks that are too low.


def test_rejects_another_number_of_worlds() -> None:
  state = batched_env.BatchedImitation(_transitions(), 3, 0, 1).state()
  with pytest.raises(ValueError, match='same number of worlds'):
    batched_env.BatchedImitation(_transitions(), 4, 0, 1).restore(state)


class TestCommand:
  """What planners do to worlds."""

  def _worlds(
    self, mode: int, num_worlds: int = 4
  ) -> batched_env.BatchedImitation:
    task = multimode_biped.make_task(
      _MODE_SET,
      episodes.ScheduledEpisodes(schedule.single(np.array([mode]))),
      config=_ENDLESS,
    )
    worlds = batched_env.BatchedImitation(
      task, num_worlds, 0, 1, auto_reset=False
    )
    worlds.reset()
    return worlds

  def _rest(self, worlds: batched_env.BatchedImitation, steps: int) -> Any:
    action = np.tile(worlds.standing_action(), (worlds.num_worlds, 1))
    for _ in range(steps):
      step = worlds.step(action)
    return step.observation

  def test_a_new_mode_begins_here_and_an_old_one_goes_on(self) -> None:
    worlds = self._worlds(0)
    self._rest(worlds, 7)
    before = worlds.measure()
    observation = worlds.command(np.array([0, 1, _LAUNCH, 0]))
    after = worlds.measure()
    np.testing.assert_array_equal(after['mode'], [0, 1, _LAUNCH, 0])
    assert before['phase'][0] > 0.2
    np.testing.assert_array_equal(
      after['phase'], before['phase'] * np.array([1, 0, 0, 1])
    )
    np.testing.assert_array_equal(
      after['reference'][1:3, :2], before['position'][1:3, :2]
    )
    np.testing.assert_array_equal(
      worlds.core.terrain.tops[:, 1], [0.0, 0.0, 0.4, 0.0]
    )
    np.testing.assert_allclose(
      observation[:, 2 : 2 + len(_MOTIONS)],
      _MODE_SET.latents[[0, 1, _LAUNCH, 0]],
    )

  def test_worlds_go_on_from_where_others_are(self) -> None:
    worlds, other = self._worlds(0), self._worlds(0)
    for each in (worlds, other):
      self._rest(each, 3)
      each.command(np.array([0, 1, _LAUNCH, 0]))
      seen = self._rest(each, 5)
    sources = np.array([2, 0, 1, 2])
    np.testing.assert_array_equal(worlds.copy_state(sources), seen[sources])
    # The block comes along: half a second later the robots are as the sources.
    np.testing.assert_array_equal(
      self._rest(worlds, 15), self._rest(other, 15)[sources]
    )
    boxes = worlds.physics.batch.bind('mocap_pos')
    np.testing.assert_array_equal(
      boxes, other.physics.batch.bind('mocap_pos')[sources]
    )


class TestSchedules:
  """What changes in the course of a training."""

  def _worlds(self, **changes: Any) -> batched_env.BatchedImitation:
    """Eight robots that launch themselves from rest."""
    task_config = _replace(_ENDLESS, reference_starts=0.0, **changes)
    task = multimode_biped.make_task(
      _MODE_SET,
      episodes.ScheduledEpisodes(schedule.single(np.array([_LAUNCH]))),
      config=task_config,
    )
    worlds = batched_env.BatchedImitation(task, 8, 0, 1)
    worlds.reset()
    return worlds

  def _step(
    self, worlds: batched_env.BatchedImitation
  ) -> batched_env.BatchedTimeStep:
    return worlds.step(np.tile(worlds.standing_action(), (8, 1)))

  def test_bound_tightens(self) -> None:
    limits = dataclasses.replace(_ENDLESS.limits, distance=1.0)
    worlds = self._worlds(
      limits=limits, distance_slack=schedules.Schedule(1.0, 0.0, 0, 40)
    )
    bounds = []
    for _ in range(6):
      self._step(worlds)
      bounds.append(1.0 + worlds.core.distance_slack)
    # After 8, 16, 24, ... control steps of all worlds.
    np.testing.assert_allclose(bounds, [1.8, 1.6, 1.4, 1.2, 1.0, 1.0])

  def test_obstacles_begin(self) -> None:
    """Episodes of 2 steps begin after 16, 32, ... control steps."""
    worlds = self._worlds(
      obstacles=schedules.Schedule(0.0, 0.5, 40, 40), time_limit=0.06
    )
    shares, low = [worlds.core.terrain_events.obstacle_share], []
    for _ in range(8):
      self._step(worlds)
      shares.append(worlds.core.terrain_events.obstacle_share)
      low.append(bool(np.any(worlds.core.terrain.tops[:, 1] < 0.4)))
    # After 0, 8, 16, ... control steps of all worlds.
    assert shares == ([0.0] * 5 + [0.5] * 4)
    assert low == ([False] * 5 + [True] * 3)
    other = self._worlds(
      obstacles=schedules.Schedule(0.0, 0.5, 40, 40), time_limit=0.06
    )
    assert other.core.terrain_events.obstacle_share == 0.0
    other.restore(worlds.state())
    assert other.core.terrain_events.obstacle_share == 0.5

  def test_obstacles_may_be_there_from_the_start(self) -> None:
    worlds = self._worlds(obstacles=1.0)
    assert np.all(worlds.core.terrain.tops[:, 1] < 0.4)

  def test_no_obstacle_before_their_time(self) -> None:
    """Worlds run as they do without any."""
    rollouts = []
    for share in (0.0, schedules.Schedule(0.0, 1.0, 10**6, 10**6)):
      task = _transitions(_replace(_ENDING, obstacles=share))
      worlds = batched_env.BatchedImitation(task, 8, 0, 1, privileged=True)
      worlds.reset()
      rollouts.append(_rollout(worlds, 40))
    assert (sum(step.last.sum() for step in rollouts[0])) > 8
    _assert_same(*rollouts)

  def test_no_obstacle_in_evaluations(self) -> None:
    evaluated = dataclasses.replace(_ENDING, events=events.NONE)
    worlds = batched_env.BatchedImitation(_transitions(evaluated), 16, 0, 1)
    worlds.reset()
    for _ in range(4):
      _rollout(worlds, 20)
      ground = worlds.core.terrain
      later = np.isfinite(ground.starts[:, 1:])
      assert later.any()
      rises = np.diff(ground.tops, axis=1)[later]
      np.testing.assert_allclose(rises, 0.4, atol=1e-12)  # Launch's own.
      np.testing.assert_array_equal(  # And no gap before it.
        ground.starts[:, 1:][later], ground.ends[:, :-1][later]
      )

  def test_boxes_are_where_the_ground_is(self) -> None:
    task = _transitions(_replace(_ENDLESS, obstacles=0.8))
    worlds = batched_env.BatchedImitation(task, 16, 0, 1, auto_reset=False)
    worlds.reset()
    boxes = worlds.physics.batch.bind('mocap_pos')
    sizes = worlds.physics.batch.expand('geom_size')
    geoms = [
      worlds.physics.model.geom(geom.full_identifier).id
      for geom in task.root_entity.ground_geoms
    ]
    bodies = worlds.physics.model.body_mocapid[
      worlds.physics.model.geom_bodyid[geoms]
    ]
    seen = []
    for _ in range(20):
      centres, halves = terrain.boxes(worlds.core.terrain)
      np.testing.assert_array_equal(boxes[:, bodies], centres)
      np.testing.assert_array_equal(sizes[:, geoms], halves)
      seen.append(centres)
      _rollout(worlds, 4)
    moved = [np.any(a != b) for a, b in zip(seen[:-1], seen[1:], strict=True)]
    assert sum(moved) > 3

  def test_pushes_begin(self) -> None:
    """Of all robots in each step here: the interval is a control step."""
    pushed = self._worlds(
      push_speed=schedules.Schedule(0.0, 0.5, 24, 24), push_interval=0.03
    )
    plain = self._worlds()
    for _ in range(2):  # After 8 and 16 control steps of all worlds.
      self._step(pushed)
      self._step(plain)
      np.testing.assert_array_equal(pushed.qvel, plain.qvel)
    self._step(pushed)
    self._step(plain)
    gain = pushed.qvel - plain.qvel
    np.testing.assert_array_equal(gain[:, 2:], 0.0)
    speeds = np.linalg.norm(gain[:, :2], axis=1)
    assert 1e-3 <= speeds.min() <= 0.3
    assert 0.2 <= speeds.max() <= 0.5
    ways = np.arctan2(gain[:, 1], gain[:, 0])
    assert np.ptp(ways) > (np.pi / 2)

  def test_pushes_come_once_in_an_interval(self) -> None:
    worlds = self._worlds(push_speed=1e-6, push_interval=0.3)
    counts, state = np.zeros(8), worlds.physics.batch.state
    plain = self._worlds()
    for _ in range(200):
      plain.physics.state[:] = state
      self._step(worlds)
      self._step(plain)
      counts += (worlds.qvel[:, :2] != plain.qvel[:, :2]).any(axis=1)
    # 200 steps of 0.03 s are 20 intervals.
    assert 14 <= counts.mean() <= 26

  @pytest.mark.parametrize('share', [1.0, 0.25, 0.0])
  def test_help_at_take_off(self, share: float) -> None:
    """Phases are 0.03 / 1.1 apart: the take-off at 0.42 is in step 16."""
    worlds, alone = self._worlds(assistance_steps=1000), self._worlds()
    worlds.assistance.share = share
    for _ in range(15):
      self._step(worlds)
      self._step(alone)
    np.testing.assert_array_equal(worlds.qvel, alone.qvel)
    self._step(worlds)
    self._step(alone)
    bank = alone.core.tracker.bank
    modes, takeoff = np.array([_LAUNCH]), np.array([0.42])
    wanted = bank.start_velocity(modes, takeoff)[0]
    gain = worlds.qvel - alone.qvel
    np.testing.assert_array_equal(gain[:, 3:], 0.0)
    # They stand, more or less: what they have of it is next to nothing.
    np.testing.assert_allclose(
      gain[:, :3], np.tile(share * wanted, (8, 1)), atol=0.3 * share
    )
    self._step(worlds)  # And that was it.
    assert worlds.qvel[:, 2].max() < (0.3 + share * wanted[2])

  @pytest.mark.parametrize(('height', 'share'), [(-np.inf, 0.0), (np.inf, 1.0)])
  def test_help_fades_when_they_survive(
    self, height: float, share: float
  ) -> None:
    limits = dataclasses.replace(_ENDLESS.limits, height=height)
    worlds = self._worlds(time_limit=0.06, limits=limits, assistance_steps=80)
    for _ in range(60):
      self._step(worlds)
    assert worlds.assistance.share == share

  def test_bonus_on_footing(self) -> None:
    """It is paid on top of Eq. 3, and no return counts it."""
    changes: dict[str, Any] = {'time_limit': 0.66}
    worlds = self._worlds(contact_bonus=0.2, **changes)
    alone = self._worlds(**changes)
    bonuses = []
    for _ in range(22):  # Past the take-off, where feet should be in the air.
      step, other = self._step(worlds), self._step(alone)
      bonuses.append(step.reward - other.reward)
    np.testing.assert_array_equal(step.results.returns, other.results.returns)
    assert len(step.results.worlds) == 8
    # Two feet down: as wanted at first, as wrong as can be in the end.
    np.testing.assert_allclose(bonuses[4], 0.2, rtol=1e-9)
    np.testing.assert_allclose(bonuses[-1], 0.0, atol=0.01)

  @pytest.mark.parametrize('clearance', [0.02, 0.04, 0.2])
  def test_bonus_on_swinging_feet(self, clearance: float) -> None:
    """In flight it grows with the height of the soles, over a block too."""
    worlds = self._worlds(contact_bonus=0.2)
    worlds.core.tracker.state.phase[:] = 0.6
    block = np.arange(8) % 2 == 1
    worlds.qpos[:, 0] = np.where(block, 1.0, -0.5)
    ground = worlds.core.support(worlds.qpos[:, 0])
    np.testing.assert_allclose(ground, np.where(block, 0.4, 0.0))
    # In the crouch at zero angles; what is asked for is a step from now.
    fallen = -0.5 * 9.81 * (worlds.config.control_timestep) ** 2
    worlds.qpos[:, 2] = ground + 0.5 + clearance - fallen
    worlds.qpos[:, 3:] = [1.0] + [0.0] * 13
    worlds.qvel[:] = 0.0
    step = worlds.step(np.zeros((8, 10)))
    assert worlds.outcome is not None
    terms = sum(worlds.outcome.terms.values())
    np.testing.assert_allclose(
      step.reward - terms, 0.2 * min(clearance / 0.05, 1.0) ** 2, atol=0.01
    )

  def test_goes_on_where_it_was(self) -> None:
    limits = dataclasses.replace(_ENDLESS.limits, distance=1.0)
    changes: dict[str, Any] = {
      'limits': limits,
      'distance_slack': schedules.Schedule(1.0, 0.0, 0, 400),
      'assistance_steps': 400,
    }
    worlds, other = self._worlds(**changes), self._worlds(**changes)
    survived = np.ones(500, dtype=bool)
    worlds.assistance.update(np.full(500, _LAUNCH), survived)
    _rollout(worlds, 10)
    other.restore(worlds.state())
    assert other.core.distance_slack == pytest.approx(0.8, abs=1e-7)
    _assert_same(_rollout(worlds, 10), _rollout(other, 10))
    assert worlds.assistance.share == pytest.approx(0.6, abs=1e-7)
    assert other.assistance.share == worlds.assistance.share


def _poison_position(worlds: batched_env.BatchedImitation) -> None:
  worlds.qpos[2, 0] = np.nan


def _poison_velocity(worlds: batched_env.BatchedImitation) -> None:
  worlds.qvel[2, 8] = np.inf


@pytest.mark.parametrize('poison', [_poison_position, _poison_velocity])
def test_diverged_world_begins_anew(
  poison: Callable[[batched_env.BatchedImitation], None],
) -> None:
  task = _transitions()
  task.config = _replace(task.config, contact_bonus=0.2)
  sick, healthy = (
    batched_env.BatchedImitation(task, 5, 0, 2, privileged=True)
    for _ in range(2)
  )
  sick.reset()
  healthy.reset()
  poison(sick)
  action = np.tile(sick.standing_action(), (5, 1))
  step, other = sick.step(action), healthy.step(action)
  assert terminations.CAUSES[step.results.causes[0]] == 'non_finite'
  np.testing.assert_array_equal(step.results.worlds, [2])
  np.testing.assert_array_equal(step.last, [False, False, True, False, False])
  np.testing.assert_array_equal(step.discount, [1, 1, 0, 1, 1])
  assert step.reward[2] == 0.0
  assert np.isfinite(step.observation).all()
  assert np.isfinite(step.final_observation).all()
  others = [0, 1, 3, 4]
  for name in ('reward', 'observation', 'discount'):
    np.testing.assert_array_equal(
      getattr(step, name)[others], getattr(other, name)[others]
    )
  for _ in range(5):  # And it lives.
    step = sick.step(action)
    assert np.isfinite(step.observation).all()
    assert step.reward[2] > 0.0


def _privileged_parts(observation: np.ndarray) -> dict[str, np.ndarray]:
  """Cuts what follows the policy's observation into its parts."""
  size = lambda latents: observations.size(latents, privileged=True)
  latents = next(n for n in range(99) if size(n) == observation.shape[1])
  parts, start = {}, observations.size(latents)
  layout = observations.layout(latents, privileged=True)
  for name, length in layout[len(observations.POLICY_TERMS) :]:
    parts[name] = observation[:, start : start + length]
    start += length
  return parts


def test_specs_privileged() -> None:
  worlds = batched_env.BatchedImitation(
    _transitions(), 3, 0, 1, privileged=True
  )
  latent_dim = worlds.mode_set.latent_dim
  size = observations.size(latent_dim, privileged=True)
  assert worlds.privileged_size == size - observations.size(latent_dim)
  assert worlds.observation_spec().shape == (size,)
  assert worlds.reset().shape == (3, size)


def test_policy_sees_what_it_saw_without() -> None:
  plain, more = (
    batched_env.BatchedImitation(_transitions(), 8, 0, 1, privileged=on)
    for on in (False, True)
  )
  np.testing.assert_array_equal(more.reset()[:, :37], plain.reset())
  steps = _rollout(more, 60)
  cut = [
    step._replace(
      observation=step.observation[:, :37],
      final_observation=step.final_observation[:, :37],
    )
    for step in steps
  ]
  assert (sum(step.last.sum() for step in cut)) > 8
  _assert_same(cut, _rollout(plain, 60))


@pytest.mark.parametrize('obstacles', [0.0, 1.0])
def test_position_error_and_contact(obstacles: float) -> None:
  """In every step and in every world, also right after a reset."""
  task = _transitions(_replace(_ENDING, obstacles=obstacles))
  worlds = batched_env.BatchedImitation(task, 8, 0, 1, privileged=True)
  observation, touched = worlds.reset(), np.zeros((8, 2))
  random, stand = np.random.RandomState(0), worlds.standing_action()
  contacts, ends = [], 0
  for _ in range(60):
    parts, measured = _privileged_parts(observation), worlds.measure()
    error = measured['position'] - measured['reference']
    np.testing.assert_array_equal(
      parts['position_error'], error.astype(np.float32)
    )
    np.testing.assert_array_equal(parts['contact'], touched)
    step = worlds.step(stand + random.uniform(-0.4, 0.4, (8, 10)))
    observation = step.observation
    ended = step.results.worlds
    touched = worlds.feet_contact()
    touched[ended] = 0.0  # Their feet have not touched anything yet.
    contacts.append(touched)
    ends += len(ended)
  assert ends > 8
  assert 0.1 <= np.mean(contacts) <= 0.9


def test_contact_at_the_end_is_that_of_the_last_step() -> None:
  limit = _replace(_ENDLESS, time_limit=0.3)
  worlds = batched_env.BatchedImitation(
    _transitions(limit), 8, 0, 1, privileged=True
  )
  worlds.reset()
  action = np.tile(worlds.standing_action(), (8, 1))
  for _ in range(10):
    step = worlds.step(action)
  assert step.last.all()
  before = _privileged_parts(step.final_observation)['contact']
  assert before.sum() > 8  # Most of them stand.
  after = _privileged_parts(step.observation)['contact']
  np.testing.assert_array_equal(after, np.zeros((8, 2)))


def test_ground_ahead() -> None:
  """Of worlds on a track: before, over and behind a gap, and of its end."""
  task = multimode_biped.make_task(
    _MODE_SET,
    episodes.ScheduledEpisodes(schedule.single(np.array([0]))),
    'gap_block',  # Gap from 0.6 to 1.05 m, ground to 1.65 m, 0.4 m up.
    _ENDLESS,
  )
  worlds = batched_env.BatchedImitation(
    task, 6, 0, 1, auto_reset=False, privileged=True
  )
  worlds.reset()
  worlds.qpos[:, 0] = [0.0, 0.5, 0.8, 1.1, 1.5, 2.0]
  worlds.qvel[:] = 0.0
  step = worlds.step(np.tile(worlds.standing_action(), (6, 1)))
  x = worlds.qpos[:, 0]
  np.testing.assert_allclose(
    _privileged_parts(step.observation)['ground_ahead'],
    [
      [1.0, 0.0, 0.0],
      [1.05 - x[1], 0.0, 0.45],
      [1.05 - x[2], 0.0, 0.45],
      [1.65 - x[3], 0.4, 0.0],
      [1.65 - x[4], 0.4, 0.0],
      [1.0, 0.0, 0.0],
    ],
    atol=_FLOAT32,
  )


def test_countdown_through_switches() -> None:
  """A step of 0.03 s; commands at steps 5 and 65, and none after that."""
  modes = [0, 3, 7]
  plan = schedule.ModeSchedule(
    np.array([modes]), np.array([[0.0, 0.15, 1.95]]), np.ones(1)
  )
  task = multimode_biped.make_task(
    _MODE_SET, episodes.ScheduledEpisodes(plan), config=_ENDLESS
  )
  worlds = batched_env.BatchedImitation(
    task, 1, 0, 1, auto_reset=False, privileged=True
  )
  observation = worlds.reset()
  for step in range(70):
    runs = (step >= 5) + (step >= 65)
    due = (5, 65, np.inf)[runs]
    coming = modes[min(runs + 1, 2)]
    parts, count = _privileged_parts(observation), len(_MOTIONS)
    np.testing.assert_array_equal(
      observation[:, 2 : 2 + count], _MODE_SET.latents[[modes[runs]]]
    )
    np.testing.assert_allclose(
      parts['countdown'], [[min(0.03 * (due - step), 1.5)]], atol=_FLOAT32
    )
    np.testing.assert_array_equal(
      parts['next_command'], _MODE_SET.latents[[coming]]
    )
    observation = worlds.step(worlds.standing_action()[None]).observation


def test_begins_anew_with_the_next_episode() -> None:
  """After an automatic reset the countdown is that of the new schedule."""
  plan = schedule.ModeSchedule(
    np.array([[0, 1], [2, 3]]), np.array([[0.0, 0.9], [0.0, 0.6]]), np.ones(2)
  )
  task = multimode_biped.make_task(
    _MODE_SET,
    episodes.ScheduledEpisodes(plan),
    config=_replace(_ENDLESS, time_limit=0.3),
  )
  worlds = batched_env.BatchedImitation(task, 2, 0, 1, privileged=True)
  first = _privileged_parts(worlds.reset())
  steps = _rollout(worlds, 10, spread=0.0)
  assert steps[-1].last.all()
  last = _privileged_parts(steps[-1].final_observation)
  begun = _privileged_parts(steps[-1].observation)
  np.testing.assert_allclose(first['countdown'], [[0.9], [0.6]], rtol=1e-6)
  np.testing.assert_allclose(last['countdown'], [[0.6], [0.3]], rtol=1e-6)
  np.testing.assert_array_equal(begun['countdown'], first['countdown'])
  np.testing.assert_array_equal(
    begun['next_command'], _MODE_SET.latents[[1, 3]]
  )


class TestModel:
  """What only eyes look at is gone; ParityTest says that the rest stayed."""

  def setup_method(self) -> None:
    task = _transitions()
    root = task.root_entity.mjcf_model
    self.whole = mujoco.MjModel.from_xml_string(
      root.to_xml_string(), root.get_assets()
    )
    self.model = batched_env.BatchedImitation(task, 1, 0, 1).physics.model

  def _colliding(self, model: mujoco.MjModel) -> list[str]:
    collides = model.geom_contype | model.geom_conaffinity
    return [model.geom(i).name for i in np.flatnonzero(collides)]

  def test_nothing_is_there_to_be_looked_at(self) -> None:
    model, whole = self.model, self.whole
    assert whole.ncam * whole.nlight > 0
    assert len(self._colliding(whole)) < whole.ngeom
    assert (model.ncam, model.nlight) == (0, 0)
    assert len(self._colliding(model)) == model.ngeom
    assert (model.nsite, model.nsensor) == (2, 2)

  def test_everything_that_moves_is_there(self) -> None:
    model, whole = self.model, self.whole
    assert self._colliding(model) == self._colliding(whole)
    for name in (
      'body_mass',
      'body_inertia',
      'body_ipos',
      'body_iquat',
      'jnt_range',
      'dof_damping',
      'dof_frictionloss',
      'actuator_gainprm',
      'actuator_forcerange',
    ):
      np.testing.assert_array_equal(
        getattr(model, name), getattr(whole, name), err_msg=name
      )


def test_specs_spec() -> None:
  worlds = batched_env.BatchedImitation(_transitions(), 3, 0, 1)
  assert worlds.observation_spec().shape == (37,)
  assert worlds.privileged_size == 0
  assert worlds.reset().shape == (3, 37)
  assert worlds.action_spec().shape == (10,)
  assert worlds.control_timestep == 0.03


def test_actions_are_clipped_and_left_alone() -> None:
  worlds = batched_env.BatchedImitation(_transitions(), 2, 0, 1)
  worlds.reset()
  actions = np.full((2, 10), 50.0)
  worlds.step(actions)
  np.testing.assert_array_equal(actions, np.full((2, 10), 50.0))
  np.testing.assert_allclose(
    worlds.physics.batch.bind('ctrl'), np.full((2, 10), np.pi), atol=1e-5
  )
