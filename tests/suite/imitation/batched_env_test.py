"""Tests of dmc_multimode.suite.imitation.batched_env: it is the same task.

Composer advances with mj_step2 and mj_step1, the batch with mj_step: in
floating point that is one and the same. Positions and rewards were found equal
bit for bit over every mode and arena, and observations up to their rounding to
float32. The tolerances leave room for other processors' instructions, no more.
"""

import dataclasses
from typing import Any

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
from dmc_multimode.suite.imitation import motion_costs
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
_SIZE = 37 + 29  # The paper's observation of four modes, and the other terms.
_GAINS = rewards.RewardGains().with_weights(
  position=0.35, orientation=0.35, contact=0.3
)
_ENDING = config.ImitationConfig(
  gains=_GAINS,
  commands_from_ground=False,
  extra_observations=observations.EXTRA_NAMES,
)
_ENDLESS = dataclasses.replace(_ENDING, limits=terminations.NO_LIMITS)


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


def _scheduled(
  plan: schedule.ModeSchedule,
  task_config: config.ImitationConfig = _ENDLESS,
  arena: str = 'flat',
) -> composer_task.Imitation:
  return multimode_biped.make_task(
    _MODE_SET, episodes.ScheduledEpisodes(plan), arena, task_config
  )


def _transitions(**changes: Any) -> composer_task.Imitation:
  """Algorithm 1 on flat ground, with early termination."""
  known = mode_set.one_hot(library.resolve('pi2'))
  task_config = _replace(changes.pop('task_config', _ENDING), **changes)
  return multimode_biped.make_task(
    known, episodes.TransitionEpisodes(known), config=task_config
  )


def _begin(
  task: composer_task.Imitation,
  num_worlds: int = 8,
  seed: int = 0,
  num_threads: int = 1,
  **kwargs: Any,
) -> batched_env.BatchedImitation:
  """Worlds that have been reset."""
  worlds = batched_env.BatchedImitation(
    task, num_worlds, seed, num_threads, **kwargs
  )
  worlds.reset()
  return worlds


def _stand(
  worlds: batched_env.BatchedImitation, steps: int = 1
) -> batched_env.BatchedTimeStep:
  """Holds the crouch; returns the last step."""
  action = np.tile(worlds.standing_action(), (worlds.num_worlds, 1))
  return [worlds.step(action) for _ in range(steps)][-1]


def _rollout(
  worlds: batched_env.BatchedImitation, steps: int, seed: int = 0
) -> list[batched_env.BatchedTimeStep]:
  random, stand = np.random.RandomState(seed), worlds.standing_action()
  shape = (worlds.num_worlds, 10)
  return [
    worlds.step(stand + random.uniform(-0.4, 0.4, shape)) for _ in range(steps)
  ]


def _ends(steps: list[batched_env.BatchedTimeStep]) -> int:
  return int(sum(step.last.sum() for step in steps))


def _assert_same(mine: Any, other: Any) -> None:
  """Compares two lists of steps bit for bit."""
  for one, two in zip(mine, other, strict=True):
    for name in one._fields[:-2]:
      np.testing.assert_array_equal(
        getattr(one, name), getattr(two, name), err_msg=name
      )
    for batch in ('results', 'transitions'):
      for a, b in zip(getattr(one, batch), getattr(two, batch), strict=True):
        np.testing.assert_array_equal(a, b)


# --- One action sequence and one mode schedule, driven through both engines.


def _compare(
  env: composer.Environment,
  time_step: dm_env.TimeStep,
  worlds: batched_env.BatchedImitation,
  other: batched_env.BatchedTimeStep,
) -> None:
  seen = np.concatenate(list(time_step.observation.values()))
  np.testing.assert_allclose(other.observation[0], seen, _FLOAT32, _FLOAT32)
  assert other.discount[0] == time_step.discount
  assert other.last[0] == time_step.last()
  core = env.task.core
  for mine, theirs in (
    (time_step.reward, other.reward[0]),
    (env.physics.data.qpos, worlds.qpos[0]),
    (env.physics.data.mocap_pos, worlds.physics.batch.bind('mocap_pos')[0]),
    *zip(core.terrain, worlds.core.terrain, strict=True),
    *zip(core.tracker.state, worlds.core.tracker.state, strict=True),
  ):
    np.testing.assert_allclose(mine, theirs, atol=_TOLERANCE)
  if time_step.last():
    cause = terminations.CAUSES[other.results.causes[0]]
    assert cause == env.task.termination_cause


def _plan(mode: int) -> schedule.ModeSchedule:
  """A mode and two others: over all first ones, every mode is switched to."""
  return schedule.ModeSchedule(
    (mode + np.array([[0, 4, 7]])) % len(_MOTIONS),
    np.array([[0.0, 0.36, 0.66]]),  # Seconds.
    np.array([1.0 + 0.05 * (mode % 3)]),
  )


def _drive(env: composer.Environment, mode: int) -> tuple[int, int]:
  """Compares an episode; returns its length and how many modes ran."""
  env.task.episodes = episodes.ScheduledEpisodes(_plan(mode))
  env.random_state.seed(mode)
  worlds = batched_env.BatchedImitation(env.task, 1, mode, 1, auto_reset=False)
  time_step, observation = env.reset(), worlds.reset()
  seen = np.concatenate(list(time_step.observation.values()))
  np.testing.assert_allclose(observation[0], seen, atol=_FLOAT32)
  stand, random = worlds.standing_action(), np.random.RandomState(mode)
  ran, steps = {mode}, 0
  while steps < _STEPS and not time_step.last():
    action = stand + random.uniform(-0.4, 0.4, 10)
    time_step = env.step(action)
    _compare(env, time_step, worlds, worlds.step(action[None]))
    ran.add(int(worlds.core.tracker.state.mode[0]))
    steps += 1
  return steps, len(ran)


def _environment(
  arena: str, task_config: config.ImitationConfig
) -> composer.Environment:
  task = _scheduled(_plan(0), task_config, arena)
  return multimode_biped.make_environment(task, 0, None)


@pytest.mark.parametrize(
  'arena',
  [
    name if name == 'flat' else pytest.param(name, marks=pytest.mark.slow)
    for name in layouts.NAMES
  ],
)
def test_parity_in_every_mode(arena: str) -> None:
  env = _environment(arena, _ENDLESS)
  for mode in range(len(_MOTIONS)):
    assert _drive(env, mode) == (_STEPS, 3)


@pytest.mark.parametrize('arena', ('flat', 'parkour'))
def test_parity_at_terminations(arena: str) -> None:
  env = _environment(arena, _ENDING)
  lengths = [_drive(env, mode)[0] for mode in range(len(_MOTIONS))]
  assert np.median(lengths) < _STEPS  # Most of them end.


@pytest.mark.slow
@pytest.mark.parametrize(
  ('task_config', 'share'), [(_ENDLESS, 1.0), (_ENDING, 0.5)]
)
def test_parity_over_obstacles(
  task_config: config.ImitationConfig, share: float
) -> None:
  """Drawn at the start, which may be anywhere in a mode, and at switches."""
  task_config = _replace(task_config, obstacles=share, reference_starts=0.5)
  env = _environment('flat', task_config)
  met = 0
  for mode in range(len(_MOTIONS)):
    _drive(env, mode)
    ground = env.task.core.terrain
    met += int(
      np.isfinite(ground.starts[0]).sum() > 1
      and not np.isin(ground.tops, (0.0, 0.4)).all()
    )
  assert met > 1


def test_parity_at_the_time_limit_and_from_high_speeds() -> None:
  """dm_control resets without actuation; Eq. 2's damping must not be missing.

  It shows in the first step, where joints are fast.
  """
  task_config = _replace(_ENDLESS, velocity_noise=3.0, time_limit=0.45)
  assert _drive(_environment('flat', task_config), 0)[0] == 15


# --- Many worlds.


def test_seed_alone_decides() -> None:
  """Threads change nothing."""
  one, two = (
    _begin(_transitions(), 16, 3, num_threads=threads) for threads in (1, 2)
  )
  first = _rollout(one, 60)
  assert _ends(first) > 16
  _assert_same(first, _rollout(two, 60))
  other = batched_env.BatchedImitation(_transitions(), 16, 4, 1).reset()
  assert not np.array_equal(other, one.reset())


def test_worlds_do_not_know_of_each_other() -> None:
  """Each of several worlds runs as it would alone."""
  # Ledges are placed with noise from a generator that worlds share.
  task = _transitions(task_config=_ENDLESS, edge_noise=0.0)
  kwargs = {'auto_reset': False, 'privileged': True}
  many = _begin(task, 5, num_threads=2, **kwargs)
  state = many.state()
  actions = np.random.RandomState(1).uniform(-0.5, 0.5, (40, 5, 10))
  together = [many.step(action) for action in actions]
  alone = _begin(task, 1, **kwargs)
  for world in range(5):
    alone.restore(
      {
        name: value
        if name.startswith(('random/', 'episodes/')) or not value.ndim
        else value[world : world + 1]
        for name, value in state.items()
      }
    )
    for step, action in zip(together, actions, strict=True):
      single = alone.step(action[None, world])
      np.testing.assert_array_equal(
        single.observation[0], step.observation[world]
      )
      assert single.reward[0] == step.reward[world]


def test_records_of_every_physics_step() -> None:
  """Recording changes nothing, and is what single physics steps show."""
  plain, fine, worlds = (_begin(_transitions(), 3) for _ in range(3))
  worlds.physics.record(['qpos', 'actuator_force'])
  for moving in ([True, True, True], [True, False, True]):
    plain.moving[:] = worlds.moving[:] = moving
    action = worlds.standing_action() + np.array([[0.1], [0.2], [0.3]])
    _assert_same([worlds.step(action)], [plain.step(action)])
    records = worlds.physics.records
    for k in range(worlds.config.substeps):
      fine.physics.step(action, np.array(moving), 1)
      expected = np.where(np.array(moving)[:, None], fine.qpos, 0)
      np.testing.assert_array_equal(records['qpos'][:, k], expected)
  assert records['actuator_force'].shape == (3, worlds.config.substeps, 10)
  worlds.qvel[0, 8] = np.inf
  assert worlds.step(action).results.causes == [worlds.invalid_cause]
  assert np.isfinite(worlds.physics.records['qpos'][2]).all()


# --- Ends of episodes.


@pytest.mark.parametrize('privileged', (False, True))
def test_observations_at_the_seam(privileged: bool) -> None:
  """After an end, observations are of the next episode's start."""
  worlds, plain = (
    _begin(_transitions(), privileged=privileged, auto_reset=again)
    for again in (True, False)
  )
  step, other = _stand(worlds), _stand(plain)
  while not step.last.any():
    assert not len(step.final_observation)
    step, other = _stand(worlds), _stand(plain)
  ended, on = np.flatnonzero(step.last), ~step.last
  np.testing.assert_array_equal(step.results.worlds, ended)
  np.testing.assert_array_equal(
    step.final_observation, other.observation[ended]
  )
  np.testing.assert_array_equal(step.observation[on], other.observation[on])
  now = worlds.core.observe(worlds.qpos, worlds.qvel, privileged=privileged)
  np.testing.assert_array_equal(step.observation, observations.flatten(now))
  np.testing.assert_array_equal(worlds.core.tracker.state.step[ended], 0)
  assert not np.array_equal(step.observation[ended], step.final_observation)


def test_results() -> None:
  """Returns are sums of rewards over horizon times the weights' sum."""
  task = _transitions(
    gains=rewards.RewardGains().with_weights(
      position=0.2, orientation=0.3, contact=0.1
    ),
    time_limit=0.9,
    limits=terminations.TerminationLimits(distance=0.5, reward=0.15),
  )
  worlds = _begin(task, num_threads=2)
  sampler = worlds.episodes.sampler  # type: ignore[attr-defined]
  np.testing.assert_array_equal(sampler.initial_returns, np.zeros(4))
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
  assert sampler.initial_returns.max() > 0.0  # It has learnt from them.


def test_without_automatic_resets_only_the_first_end_counts() -> None:
  worlds = _begin(_transitions(time_limit=0.6), 4, auto_reset=False)
  steps = _rollout(worlds, 30)
  ends = np.sum([step.last for step in steps], axis=0)
  np.testing.assert_array_equal(ends, np.ones(4))


@pytest.mark.parametrize(
  ('array', 'column', 'value'), [('qpos', 0, np.nan), ('qvel', 8, np.inf)]
)
def test_diverged_world_begins_anew_and_harms_no_other(
  array: str, column: int, value: float
) -> None:
  sick, healthy = (
    _begin(_transitions(contact_bonus=0.2), 5, privileged=True)
    for _ in range(2)
  )
  getattr(sick, array)[2, column] = value
  step, other = _stand(sick), _stand(healthy)
  assert terminations.CAUSES[step.results.causes[0]] == 'non_finite'
  np.testing.assert_array_equal(step.results.worlds, [2])
  np.testing.assert_array_equal(step.last, [False, False, True, False, False])
  np.testing.assert_array_equal(step.discount, [1, 1, 0, 1, 1])
  assert step.reward[2] == 0.0
  assert np.isfinite(step.final_observation).all()
  others = [0, 1, 3, 4]
  for name in ('reward', 'observation', 'discount'):
    np.testing.assert_array_equal(
      getattr(step, name)[others], getattr(other, name)[others]
    )
  for _ in range(5):
    assert np.isfinite(step.observation).all()
    step = _stand(sick)
    assert step.reward[2] > 0.0


# --- States.


@pytest.mark.parametrize(
  ('privileged', 'obstacles'), [(False, 0.0), (True, 0.7)]
)
def test_restored_worlds_go_on_bit_for_bit(
  privileged: bool, obstacles: float
) -> None:
  task, other_task = (_transitions(obstacles=obstacles) for _ in range(2))
  worlds = _begin(task, num_threads=2, privileged=privileged)
  seen = _rollout(worlds, 25)[-1].observation
  state = worlds.state()
  copies = {name: value.copy() for name, value in state.items()}
  first = _rollout(worlds, 50, seed=1)
  assert _ends(first) > 8
  for name, value in state.items():
    np.testing.assert_array_equal(value, copies[name], err_msg=name)
  # Its episodes are its own.
  other = _begin(other_task, seed=99, privileged=privileged)
  for each in (other, worlds):
    np.testing.assert_array_equal(each.restore(state), seen)
    _assert_same(first, _rollout(each, 50, seed=1))
  with pytest.raises(ValueError, match='same number of worlds'):
    batched_env.BatchedImitation(task, 4, 0, 1).restore(state)


def test_command() -> None:
  """A new mode begins here, and an old one goes on."""
  worlds = _begin(_scheduled(schedule.single(np.array([0]))), 4)
  _stand(worlds, 7)
  before = worlds.measure()
  modes = np.array([0, 1, _LAUNCH, 0])
  observation, after = worlds.command(modes), worlds.measure()
  np.testing.assert_array_equal(after['mode'], modes)
  assert before['phase'][0] > 0.2
  np.testing.assert_array_equal(after['phase'], before['phase'] * [1, 0, 0, 1])
  np.testing.assert_array_equal(
    after['reference'][1:3, :2], before['position'][1:3, :2]
  )
  np.testing.assert_array_equal(worlds.core.terrain.tops[:, 1], [0, 0, 0.4, 0])
  np.testing.assert_allclose(
    observation[:, 2 : 2 + len(_MOTIONS)], _MODE_SET.latents[modes]
  )


def test_worlds_go_on_from_where_others_are() -> None:
  """The block comes along: half a second later they are as their sources."""
  task = _scheduled(schedule.single(np.array([0])))
  worlds, other = (_begin(task, 4, auto_reset=False) for _ in range(2))
  for each in (worlds, other):
    _stand(each, 3)
    each.command(np.array([0, 1, _LAUNCH, 0]))
    seen = _stand(each, 5).observation
  sources = np.array([2, 0, 1, 2])
  np.testing.assert_array_equal(worlds.copy_state(sources), seen[sources])
  np.testing.assert_array_equal(
    _stand(worlds, 15).observation, _stand(other, 15).observation[sources]
  )
  boxes, theirs = (
    each.physics.batch.bind('mocap_pos') for each in (worlds, other)
  )
  np.testing.assert_array_equal(boxes, theirs[sources])


# --- What changes in the course of a training.


def _launching(**changes: Any) -> batched_env.BatchedImitation:
  """Eight robots that launch themselves from rest."""
  task_config = _replace(_ENDLESS, reference_starts=0.0, **changes)
  return _begin(_scheduled(schedule.single(np.array([_LAUNCH])), task_config))


def test_limit_tightens_and_assistance_fades_where_they_were() -> None:
  """With 8 environment steps a step; a restored environment goes on."""
  changes: dict[str, Any] = {
    'distance_slack': schedules.Schedule(1.0, 0.0, 0, 400),
    'assistance_steps': 400,
  }
  worlds, other = _launching(**changes), _launching(**changes)
  worlds.assistance.update(np.full(500, _LAUNCH), np.ones(500, dtype=bool))
  for slack in (0.98, 0.96, 0.94):
    _rollout(worlds, 1)
    assert worlds.core.distance_slack == pytest.approx(slack)
  other.restore(worlds.state())
  assert other.core.distance_slack == pytest.approx(0.94)
  _assert_same(_rollout(worlds, 17), _rollout(other, 17))
  assert worlds.assistance.share == pytest.approx(0.6)
  assert other.assistance.share == worlds.assistance.share


def test_obstacles_begin() -> None:
  """Episodes of 2 steps begin after 16, 32, ... environment steps."""
  changes: dict[str, Any] = {
    'obstacles': schedules.Schedule(0.0, 0.5, 40, 40),
    'time_limit': 0.06,
  }
  worlds, other = _launching(**changes), _launching(**changes)
  shares, low = [worlds.core.terrain_events.obstacle_share], []
  for _ in range(8):
    _stand(worlds)
    shares.append(worlds.core.terrain_events.obstacle_share)
    low.append(bool(np.any(worlds.core.terrain.tops[:, 1] < 0.4)))
  # After 0, 8, 16, ... environment steps.
  assert shares == [0.0] * 5 + [0.5] * 4
  assert low == [False] * 5 + [True] * 3
  other.restore(worlds.state())
  assert other.core.terrain_events.obstacle_share == 0.5


def test_boxes_are_where_the_ground_is() -> None:
  task = _transitions(task_config=_ENDLESS, obstacles=0.8)
  worlds = _begin(task, 16, auto_reset=False)
  model, batch = worlds.physics.model, worlds.physics.batch
  boxes, sizes = batch.bind('mocap_pos'), batch.expand('geom_size')
  geoms = [
    model.geom(geom.full_identifier).id
    for geom in task.root_entity.ground_geoms
  ]
  bodies = model.body_mocapid[model.geom_bodyid[geoms]]
  seen = []
  for _ in range(20):
    centres, halves = terrain.boxes(worlds.core.terrain)
    np.testing.assert_array_equal(boxes[:, bodies], centres)
    np.testing.assert_array_equal(sizes[:, geoms], halves)
    seen.append(centres)
    _rollout(worlds, 4)
  moved = [np.any(a != b) for a, b in zip(seen[:-1], seen[1:], strict=True)]
  assert sum(moved) > 3


def test_pushes_begin() -> None:
  """Of all robots in each step here: the interval is a control step."""
  pushed = _launching(
    push_speed=schedules.Schedule(0.0, 0.5, 24, 24), push_interval=0.03
  )
  plain = _launching()
  gains = []
  for _ in range(3):  # After 8, 16 and 24 environment steps.
    _stand(pushed)
    _stand(plain)
    gains.append(pushed.qvel - plain.qvel)
  np.testing.assert_array_equal(gains[:2], 0.0)
  np.testing.assert_array_equal(gains[2][:, 2:], 0.0)
  speeds = np.linalg.norm(gains[2][:, :2], axis=1)
  assert 1e-3 <= speeds.min() <= 0.3
  assert 0.2 <= speeds.max() <= 0.5
  assert np.ptp(np.arctan2(gains[2][:, 1], gains[2][:, 0])) > np.pi / 2


def test_pushed_robots_may_stray_for_two_seconds() -> None:
  worlds = _launching(
    push_speed=schedules.Schedule(0.5, 0.0, 16, 16),
    push_interval=0.03,
    push_slack=0.2,
  )
  slack = []
  for _ in range(70):  # All are pushed in the first step, none after it.
    _stand(worlds)
    slack.append(worlds.core.push_slack.copy())
  steps = np.array(slack).any(axis=1)
  assert (slack[0] == 0.2).all() and (slack[-1] == 0).all()
  assert steps.sum() == pytest.approx(2.0 / 0.03, abs=1.5)
  other = _launching(
    push_speed=schedules.Schedule(0.5, 0.0, 16, 16),
    push_interval=0.03,
    push_slack=0.2,
  )
  worlds.reset()
  _stand(worlds)
  worlds.core.recovering[3] = 1.0
  other.restore(worlds.state())
  np.testing.assert_array_equal(np.flatnonzero(other.core.push_slack), [3])


def test_a_share_of_the_episodes_has_pushes() -> None:
  worlds = _launching(
    push_speed=schedules.constant(0.5), push_interval=0.03, push_fraction=0.3
  )
  plain = _launching(push_fraction=0.3)
  pushed = worlds.core.pushed.copy()
  _stand(worlds)
  _stand(plain)
  np.testing.assert_array_equal(plain.core.pushed, pushed)
  assert pushed.any() and not pushed.all()
  moved = (worlds.qvel != plain.qvel).any(axis=1)
  np.testing.assert_array_equal(moved, pushed)
  worlds.reset()
  assert (worlds.core.pushed != pushed).any()


def test_recovering_robots_pay_their_share_of_the_costs() -> None:
  gained = []
  for share in (1.0, 0.25, 0.0):
    worlds = _launching(
      costs=motion_costs.CostWeights(action_change=1.0),
      push_speed=schedules.constant(0.1),
      push_interval=0.03,
      push_cost_share=share,
    )
    _stand(worlds)  # All are pushed at its end.
    actions = np.zeros((worlds.num_worlds, 10))
    gained.append(worlds.step(actions).reward)
  whole, quarter, none = gained
  assert (none > whole).all()
  np.testing.assert_allclose(none - quarter, (none - whole) / 4)


@pytest.mark.parametrize('share', (1.0, 0.25, 0.0))
def test_assistance_at_take_off(share: float) -> None:
  """Phases are 0.03 / 1.1 apart: the take-off at 0.42 is in step 16."""
  worlds, alone = _launching(assistance_steps=1000), _launching()
  worlds.assistance.share = share
  _stand(worlds, 15)
  _stand(alone, 15)
  np.testing.assert_array_equal(worlds.qvel, alone.qvel)
  _stand(worlds)
  _stand(alone)
  wanted = alone.core.tracker.bank.start_velocity(
    np.array([_LAUNCH]), np.array([0.42])
  )[0]
  gain = worlds.qvel - alone.qvel
  np.testing.assert_array_equal(gain[:, 3:], 0.0)
  # They stand, more or less: what they have of it is next to nothing.
  np.testing.assert_allclose(
    gain[:, :3], np.tile(share * wanted, (8, 1)), atol=0.3 * share
  )
  _stand(worlds)  # And that was it.
  assert worlds.qvel[:, 2].max() < 0.3 + share * wanted[2]


@pytest.mark.parametrize(('height', 'share'), [(-np.inf, 0.0), (np.inf, 1.0)])
def test_assistance_fades_when_they_survive(
  height: float, share: float
) -> None:
  limits = dataclasses.replace(_ENDLESS.limits, height=height)
  worlds = _launching(time_limit=0.06, limits=limits, assistance_steps=80)
  _stand(worlds, 60)
  assert worlds.assistance.share == share


def test_contact_bonus() -> None:
  """It is paid on top of Eq. 3, and no return counts it."""
  worlds = _launching(contact_bonus=0.2, time_limit=0.66)
  alone = _launching(time_limit=0.66)
  bonuses = []
  for _ in range(22):  # Past the take-off, where feet should be in the air.
    step, other = _stand(worlds), _stand(alone)
    bonuses.append(step.reward - other.reward)
  np.testing.assert_array_equal(step.results.returns, other.results.returns)
  assert len(step.results.worlds) == 8
  # Two feet down: as wanted at first, as wrong as can be in the end.
  np.testing.assert_allclose(bonuses[4], 0.2, rtol=1e-9)
  np.testing.assert_allclose(bonuses[-1], 0.0, atol=0.01)


def test_pushed_robots_may_step() -> None:
  """A foot that is up agrees where both should stand, and only there."""
  worlds = _launching()
  reference = worlds.core.tracker.reference()
  worlds.core.contact[:] = [1.0, 0.0]
  worlds.core.recovering[:4] = 1.0
  for wanted, expected in (((1.0, 1.0), 1.0), ((0.0, 1.0), 0.0)):
    agreement = worlds.core.contact_schedule_agreement(
      reference._replace(contact=np.tile(wanted, (8, 1))),
      worlds.physics.soles(),
    )
    np.testing.assert_array_equal(agreement, [expected] * 4 + [0.0] * 4)


def test_precision_bonus() -> None:
  """It is paid on top of Eq. 3, from a step on, and no return counts it."""
  weight = schedules.Schedule(0.0, 0.2, 16, 16)
  worlds = _launching(precision_bonus=weight, time_limit=0.09)
  alone = _launching(time_limit=0.09)
  for steps in (8, 16, 24):
    step, other = _stand(worlds), _stand(alone)
    assert worlds.outcome
    errors = worlds.outcome.errors
    expected = 0.2 * np.exp(-25 * (errors['position'] + errors['orientation']))
    bonus = step.reward - other.reward
    np.testing.assert_allclose(bonus, expected * (steps >= 16), atol=1e-9)
  np.testing.assert_array_equal(step.results.returns, other.results.returns)
  assert len(step.results.worlds) == 8


# --- Privileged critic observations.


def _parts(observation: np.ndarray, latents: int) -> dict[str, np.ndarray]:
  """Cuts an observation into its terms."""
  parts, start = {}, 0
  for name, length in observations.layout(
    latents, privileged=True, extra=observations.EXTRA_NAMES
  ):
    parts[name] = observation[:, start : start + length]
    start += length
  assert start == observation.shape[1]
  return parts


def test_policy_sees_what_it_sees_without() -> None:
  plain, more = (_begin(_transitions(), privileged=on) for on in (False, True))
  steps = _rollout(more, 60)
  cut = [
    step._replace(
      observation=step.observation[:, :_SIZE],
      final_observation=step.final_observation[:, :_SIZE],
    )
    for step in steps
  ]
  assert _ends(cut) > 8
  _assert_same(cut, _rollout(plain, 60))


def test_position_error_and_contact() -> None:
  """In every step and in every world, also right after a reset."""
  worlds = _begin(_transitions(obstacles=1.0), privileged=True)
  observation, touched = worlds.reset(), np.zeros((8, 2))
  contacts, ends = [], 0
  for seed in range(60):
    parts, measured = _parts(observation, 4), worlds.measure()
    error = measured['position'] - measured['reference']
    np.testing.assert_array_equal(
      parts['position_error'], error.astype(np.float32)
    )
    np.testing.assert_array_equal(parts['contact'], touched)
    step = _rollout(worlds, 1, seed)[0]
    observation, ended = step.observation, step.results.worlds
    touched = worlds.feet_contact()
    touched[ended] = 0.0  # Their feet have not touched anything yet.
    contacts.append(touched)
    ends += len(ended)
  assert ends > 8
  assert 0.1 <= np.mean(contacts) <= 0.9


def test_ground_ahead() -> None:
  """Of worlds on a track: before, over and behind a gap, and of its end."""
  task = _scheduled(
    schedule.single(np.array([0])),
    arena='gap_block',  # Gap from 0.6 to 1.05 m, ground to 1.65 m, 0.4 m up.
  )
  worlds = _begin(task, 6, auto_reset=False, privileged=True)
  worlds.qpos[:, 0] = [0.0, 0.5, 0.8, 1.1, 1.5, 2.0]
  worlds.qvel[:] = 0.0
  step, x = _stand(worlds), worlds.qpos[:, 0]
  np.testing.assert_allclose(
    _parts(step.observation, len(_MOTIONS))['ground_ahead'],
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


def test_countdown_through_switches_and_resets() -> None:
  """A step of 0.03 s; commands at steps 5 and 65, and the end at 70."""
  modes = [0, 3, 7]
  plan = schedule.ModeSchedule(
    np.array([modes]), np.array([[0.0, 0.15, 1.95]]), np.ones(1)
  )
  task = _scheduled(plan, _replace(_ENDLESS, time_limit=2.1))
  worlds = _begin(task, 1, privileged=True)
  observation = worlds.reset()
  for step in (*range(70), 0):
    runs = (step >= 5) + (step >= 65)
    seconds = 0.03 * ((5, 65, np.inf)[runs] - step)
    parts = _parts(observation, len(_MOTIONS))
    for name, expected in (
      ('command', _MODE_SET.latents[modes[runs]]),
      ('next_command', _MODE_SET.latents[modes[min(runs + 1, 2)]]),
      ('countdown', [min(seconds, 1.5)]),
    ):
      np.testing.assert_allclose(parts[name], [expected], atol=_FLOAT32)
    observation = _stand(worlds).observation


# --- Its outside.


def test_model_has_all_that_moves_and_nothing_to_look_at() -> None:
  task = _transitions()
  root = task.root_entity.mjcf_model
  whole = mujoco.MjModel.from_xml_string(
    root.to_xml_string(), root.get_assets()
  )
  model = batched_env.BatchedImitation(task, 1, 0, 1).physics.model
  collides = np.flatnonzero(whole.geom_contype | whole.geom_conaffinity)
  assert whole.ncam * whole.nlight > 0
  assert len(collides) < whole.ngeom
  assert (model.ncam, model.nlight) == (0, 0)
  assert (model.nsite, model.nsensor) == (2, 2)
  names = [model.geom(i).name for i in range(model.ngeom)]
  assert names == [whole.geom(i).name for i in collides]
  for name in (
    *('body_mass', 'body_inertia', 'body_ipos', 'body_iquat', 'jnt_range'),
    *('dof_damping', 'dof_frictionloss'),
    *('actuator_gainprm', 'actuator_forcerange'),
  ):
    np.testing.assert_array_equal(
      getattr(model, name), getattr(whole, name), err_msg=name
    )


@pytest.mark.parametrize(
  ('privileged', 'size'), [(False, _SIZE), (True, _SIZE + 13)]
)
def test_specs(privileged: bool, size: int) -> None:
  worlds = _begin(_transitions(), 3, privileged=privileged)
  assert worlds.observation_spec().shape == (size,)
  assert worlds.privileged_size == size - _SIZE
  assert worlds.reset().shape == (3, size)
  assert worlds.control_timestep == 0.03
  assert worlds.action_spec().shape == (10,)
  # Actions are clipped, and left alone.
  actions = np.full((3, 10), 50.0)
  worlds.step(actions)
  np.testing.assert_array_equal(actions, 50.0)
  np.testing.assert_allclose(
    worlds.physics.batch.bind('ctrl'), np.full((3, 10), np.pi), atol=1e-5
  )
