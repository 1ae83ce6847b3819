"""Tests of dmc_multimode.suite.imitation.composer_task."""

import dataclasses
from typing import Any
from unittest import mock

from dm_control import composer
import mujoco
import numpy as np
import pytest

from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes import schedule
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.walkers import mini_biped

_MODES = tuple(library.modes())
_MOVING = tuple(name for name in _MODES if name != 'idle')
_CALM = dataclasses.replace(
  config.ImitationConfig(),
  events=events.NONE,
  joint_noise=0.0,
  velocity_noise=0.0,
  tilt_noise=0.0,
)


def _env(
  names: list[str],
  starts: list[float] | None = None,
  task_config: config.ImitationConfig = _CALM,
  arena: str = 'flat',
) -> composer.Environment:
  """Commands the modes `names` at the times `starts`, in seconds."""
  motions = tuple(library.modes()[name] for name in dict.fromkeys(names))
  order = [motion.name for motion in motions]
  plan = schedule.ModeSchedule(
    np.array([[order.index(name) for name in names]]),
    np.array([starts or [0.0]]),
    np.ones(1),
  )
  task = multimode_biped.make_task(
    mode_set.one_hot(motions),
    episodes.ScheduledEpisodes(plan),
    arena,
    task_config,
  )
  return multimode_biped.make_environment(task, 0, None)


def _standing_action(env: composer.Environment) -> np.ndarray:
  return mini_biped.standing_action(env.physics.model.ptr)


def _hold_upright(env: composer.Environment) -> None:
  """Keeps the trunk where the episode began, whatever the robot does."""
  held: dict[str, np.ndarray] = {}

  def remember(physics: Any, random_state: Any) -> None:
    del random_state
    held['pose'] = physics.data.qpos[:7].copy()

  def hold(physics: Any, random_state: Any) -> None:
    del random_state
    physics.data.qpos[:7] = held['pose']
    physics.data.qvel[:6] = 0.0

  env.add_extra_hook('initialize_episode', remember)
  env.add_extra_hook('after_substep', hold)


def _ground_height(env: composer.Environment, x: float) -> float:
  """Casts a ray down; returns where it meets a segment's visible group."""
  model, data = env.physics.model.ptr, env.physics.data.ptr
  above, down = np.array([x, 1.0, 5.0]), np.array([0.0, 0.0, -1.0])
  geom = np.zeros(1, dtype=np.int32)
  distance = mujoco.mj_ray(model, data, above, down, None, 1, -1, geom)
  return 5.0 - distance


class TestStandingStill:
  """What early termination is for: standing still must not pay."""

  def _run(self, mode: str, upright: bool) -> tuple[int, str]:
    """Returns how many steps a constant action lasted, and what ended it."""
    env = _env([mode])
    if upright:
      _hold_upright(env)
    action = _standing_action(env)
    time_step, steps = env.reset(), 0
    while not time_step.last():
      time_step = env.step(action)
      steps += 1
    return steps, env.task.termination_cause

  @pytest.mark.parametrize('upright', (False, True))
  @pytest.mark.parametrize('mode', _MOVING)
  def test_is_terminated_in_a_moving_mode(
    self, mode: str, upright: bool
  ) -> None:
    steps, cause = self._run(mode, upright)
    assert cause != 'none'
    assert steps < 0.6 * _CALM.horizon

  def test_held_upright_goes_on_when_idle(self) -> None:
    steps, cause = self._run('idle', upright=True)
    assert cause == 'none'
    assert steps == _CALM.horizon


def test_is_between_zero_and_one() -> None:
  env = _env(
    ['walk_forward', 'launch', 'leap_left'],
    [0.0, 0.3, 0.9],
    dataclasses.replace(
      config.ImitationConfig(), limits=terminations.NO_LIMITS
    ),
  )
  random, spec = np.random.RandomState(0), env.action_spec()
  env.reset()
  for _ in range(60):
    time_step = env.step(random.uniform(spec.minimum, spec.maximum))
    assert 0.0 <= time_step.reward <= 1.0


def test_on_the_reference_it_is_the_highest() -> None:
  env = _env(['idle'])
  _hold_upright(env)
  env.reset()
  time_step = env.step(_standing_action(env))
  assert time_step.reward == pytest.approx(1.0, abs=0.5e-6)


def test_by_hand() -> None:
  """Held at its start, a robot falls behind a walk of 0.6 m/s."""
  env = _env(['walk_forward'])
  _hold_upright(env)
  env.reset()
  for step in range(1, 11):
    time_step = env.step(_standing_action(env))
    behind = 0.6 * 0.03 * step
    assert time_step.reward == pytest.approx(
      0.5 * np.exp(-5 * behind) + 0.5, abs=0.5e-6
    )


def test_termination_has_discount_zero() -> None:
  env = _env(['walk_forward'])
  _hold_upright(env)
  time_step = env.reset()
  while not time_step.last():
    assert time_step.discount in (None, 1.0)
    time_step = env.step(_standing_action(env))
  assert time_step.discount == 0.0
  assert env.task.termination_cause == 'position_error'
  # 0.35 m at 0.6 m/s in steps of 0.03 s: 19.4.
  assert env.task.core.tracker.state.step[0] == 20


def test_time_limit_has_discount_one() -> None:
  env = _env(['idle'], task_config=dataclasses.replace(_CALM, time_limit=0.3))
  _hold_upright(env)
  time_step, steps = env.reset(), 0
  while not time_step.last():
    time_step = env.step(_standing_action(env))
    steps += 1
  assert steps == 10
  assert time_step.discount == 1.0
  assert env.task.termination_cause == 'none'


def test_fall_is_named() -> None:
  env = _env(
    ['idle'],
    task_config=dataclasses.replace(
      _CALM,
      limits=terminations.TerminationLimits(np.inf, 0.0, angle=np.pi),
    ),
  )
  time_step = env.reset()
  while not time_step.last():
    time_step = env.step(np.full(10, -1.5))
  assert env.task.termination_cause == 'base_height'
  assert time_step.discount == 0.0


@pytest.mark.parametrize('noise', [0.0, 0.04])
def test_launch_finds_its_block(noise: float) -> None:
  env = _env(
    ['launch'],
    task_config=dataclasses.replace(
      _CALM,
      events=dataclasses.replace(events.NONE, edge_noise=noise),
    ),
  )
  edges = []
  for _ in range(6):
    env.reset()
    assert _ground_height(env, 0.2) == pytest.approx(0.0, abs=0.5e-6)
    assert _ground_height(env, 0.35) == pytest.approx(0.4, abs=0.5e-6)
    edges.append(env.task.core.terrain.starts[0, 1])
  np.testing.assert_allclose(edges, 0.27, atol=noise + 1e-9)
  assert (len(set(edges)) > 1) == (noise > 0)


def test_launch_in_mid_episode_finds_it_ahead_of_the_robot() -> None:
  env = _env(['walk_forward', 'launch'], [0.0, 0.3])
  env.reset()
  action = _standing_action(env)
  for step in range(10):
    assert env.task.mode == 'walk_forward'
    assert _ground_height(env, 2.0) == pytest.approx(0.0, abs=0.5e-6)
    # Carried along on the reference.
    env.physics.data.qpos[0] = 0.018 * step
    env.step(action)
  assert env.task.mode == 'launch'
  x = env.physics.data.qpos[0]
  assert x > 0.1
  assert (_ground_height(env, x + 0.26)) == pytest.approx(0.0, abs=0.5e-6)
  assert (_ground_height(env, x + 0.28)) == pytest.approx(0.4, abs=0.5e-6)
  # The reference ends on top of it.
  end = env.task.core.tracker.state.anchor[0] + [0.6, 0.0, 0.9]
  assert end[0] > (x + 0.27)
  assert end[2] - 0.4 == pytest.approx(0.5, abs=1e-7)


def test_fixed_arena_keeps_its_terrain() -> None:
  env = _env(['launch'], arena='block')
  env.reset()
  assert _ground_height(env, 0.7) == pytest.approx(0.0, abs=0.5e-6)
  assert _ground_height(env, 0.9) == pytest.approx(0.4, abs=0.5e-6)


def test_height_is_over_the_support() -> None:
  env = _env(['idle'], arena='block')
  observed = env.reset().observation['height'][0]
  assert observed == pytest.approx(0.5, abs=1e-7)
  env.physics.data.qpos[[0, 2]] = [1.5, 0.9]
  time_step = env.step(_standing_action(env))
  assert time_step.observation['height'][0] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize('mode', _MODES)
def test_start_on_the_reference_is_free_of_the_ground(mode: str) -> None:
  """Whatever the phase, no foot begins deep inside a block."""
  env = _env(
    [mode],
    task_config=dataclasses.replace(
      _CALM,
      events=dataclasses.replace(events.NONE, reference_starts=1.0),
    ),
  )
  for _ in range(20):
    time_step = env.reset()
    contacts = env.physics.data.contact
    assert min([0.0, *contacts.dist]) > -0.02
    assert time_step.observation['height'][0] >= 0.39


def test_returns_are_reported_to_the_sampler() -> None:
  env = _env(['walk_forward'])
  _hold_upright(env)
  reported: list[episodes.EpisodeBatch] = []
  initialiser = env.task.episodes
  with mock.patch.object(initialiser, 'update', side_effect=reported.append):
    time_step, total = env.reset(), 0.0
    while not time_step.last():
      time_step = env.step(_standing_action(env))
      total += time_step.reward
    env.reset()
  (batch,) = reported
  assert (batch.initial[0], batch.final[0], batch.causes[0]) == (0, 0, 1)
  # Steps after the termination count as zero.
  assert batch.returns[0] == pytest.approx(total / _CALM.horizon, abs=1e-7)


def test_visualize_reward_colours_the_eye() -> None:
  env = _env(['idle'])
  env.task.visualize_reward = True
  _hold_upright(env)
  env.reset()
  env.step(_standing_action(env))
  eye = env.physics.bind(env.task.walker.mjcf_model.find('material', 'eye'))
  np.testing.assert_allclose(eye.rgba, [0.2, 0.7, 0.3, 1.0], atol=1e-3)
