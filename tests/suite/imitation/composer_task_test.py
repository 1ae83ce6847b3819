"""Tests of dmc_multimode.suite.imitation.composer_task."""

from typing import Any, Callable
from unittest import mock

from dm_control import composer
import dm_env
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
from dmc_multimode.walkers import mini_biped

_MODES = tuple(library.modes())
_CALM = config.ImitationConfig(
  events=events.NONE, joint_noise=0.0, velocity_noise=0.0, tilt_noise=0.0
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


def _hold_upright(env: composer.Environment) -> None:
  """Keeps the trunk where the episode began, whatever the robot does."""
  held = np.zeros(7)

  def remember(physics: Any, _: Any) -> None:
    held[:] = physics.data.qpos[:7]

  def hold(physics: Any, _: Any) -> None:
    physics.data.qpos[:7] = held
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


def _stand(env: composer.Environment) -> dm_env.TimeStep:
  return env.step(mini_biped.standing_action(env.physics.model.ptr))


# Standing still must not pay: this is what early termination is for.
@pytest.mark.parametrize('upright', (False, True))
@pytest.mark.parametrize('mode', _MODES)
def test_standing_still_pays_in_idle_alone(mode: str, upright: bool) -> None:
  env, steps = _env([mode]), 0
  if upright:
    _hold_upright(env)
  time_step = env.reset()
  while not time_step.last():
    time_step = _stand(env)
    steps += 1
  if mode == 'idle':
    assert not upright or env.task.termination_cause == 'none'
    assert not upright or (steps, time_step.discount) == (_CALM.horizon, 1.0)
  else:
    assert env.task.termination_cause != 'none'
    assert time_step.discount == 0.0
    assert steps < 0.6 * _CALM.horizon
  if mode == 'walk_forward' and upright:
    assert env.task.termination_cause == 'position_error'
    # 0.18 m in the first cycle of 0.6 s, the rest of 0.35 m at 0.6 m/s in
    # steps of 0.03 s: 29.4.
    assert steps == 30


@pytest.mark.parametrize(
  ('mode', 'speed'), [('idle', 0.0), ('walk_forward', 0.6)]
)
def test_reward_by_hand(mode: str, speed: float) -> None:
  """Held at its start, a robot falls behind, at so many metres per second."""
  env = _env([mode])
  _hold_upright(env)
  env.reset()
  for step in range(1, 11):
    # From rest the reference speeds up over its first cycle of 0.6 s.
    behind = speed * (0.03 * step) ** 2 / (2 * 0.6)
    reward = 0.5 * np.exp(-5 * behind) + 0.5
    assert _stand(env).reward == pytest.approx(reward, abs=0.5e-6)


def test_launch_in_mid_episode_finds_it_ahead_of_the_robot() -> None:
  env = _env(['walk_forward', 'launch'], [0.0, 0.3])
  env.reset()
  for step in range(10):
    assert env.task.mode == 'walk_forward'
    assert _ground_height(env, 2.0) == pytest.approx(0.0, abs=0.5e-6)
    # Carried along on the reference.
    env.physics.data.qpos[0] = 0.018 * step
    _stand(env)
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
  """And the height is over what supports the robot."""
  env = _env(['launch'], arena='block')
  observed = env.reset().observation['height'][0]
  assert observed == pytest.approx(0.5, abs=1e-7)
  assert _ground_height(env, 0.7) == pytest.approx(0.0, abs=0.5e-6)
  assert _ground_height(env, 0.9) == pytest.approx(0.4, abs=0.5e-6)
  env.physics.data.qpos[[0, 2]] = [1.5, 0.9]
  height = _stand(env).observation['height'][0]
  assert height == pytest.approx(0.5, abs=0.02)


def test_returns_are_reported_to_the_sampler() -> None:
  env = _env(['walk_forward'])
  _hold_upright(env)
  reported: list[episodes.EpisodeBatch] = []
  initialiser = env.task.episodes
  with mock.patch.object(initialiser, 'update', side_effect=reported.append):
    time_step, total = env.reset(), 0.0
    while not time_step.last():
      time_step = _stand(env)
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
  _stand(env)
  eye = env.physics.bind(env.task.walker.mjcf_model.find('material', 'eye'))
  np.testing.assert_allclose(eye.rgba, [0.2, 0.7, 0.3, 1.0], atol=1e-3)


def _clock(step: int) -> np.ndarray:
  """Returns the clock of walk_forward after so many physics steps, by hand."""
  duration = library.modes()['walk_forward'].duration
  angle = 2 * np.pi * step * _CALM.physics_timestep / duration
  return np.array([np.sin(angle), np.cos(angle)])


@pytest.mark.parametrize(
  ('settings', 'expected'),
  [
    ({}, lambda seen: seen[-1]),
    ({'delay': 1}, lambda seen: seen[-2]),
    ({'delay': 8}, lambda seen: seen[-9]),
    ({'update_interval': 4}, lambda seen: seen[(len(seen) - 1) // 4 * 4]),
    ({'buffer_size': 3}, lambda seen: seen[-3:]),
    (
      {'buffer_size': 9, 'aggregator': 'mean'},
      lambda seen: np.mean(seen[-9:], axis=0),
    ),
  ],
)
def test_delays_and_intervals_are_of_physics_steps(
  settings: dict[str, Any], expected: Callable[[list[np.ndarray]], np.ndarray]
) -> None:
  env = _env(['walk_forward'])
  for name in ('joints_pos', 'clock'):
    env.task.task_observables[name].configure(**settings)
  joints: list[np.ndarray] = []
  look = lambda physics, _: joints.append(physics.data.qpos[7:].copy())
  env.add_extra_hook('initialize_episode', look)
  env.add_extra_hook('after_substep', look)
  env.reset()
  for _ in range(3):
    step = _stand(env)
  clocks = [_clock(i) for i in range(len(joints))]
  for name, seen in (('joints_pos', joints), ('clock', clocks)):
    np.testing.assert_allclose(
      step.observation[name], expected(seen), atol=1e-12
    )


@pytest.mark.parametrize('hook', ['initialize_episode', 'after_step'])
def test_observations_are_those_after_the_last_hook(hook: str) -> None:
  env = _env(['idle'])

  def lift(physics: Any, _: Any) -> None:
    physics.data.qpos[2] = 0.6

  env.add_extra_hook(hook, lift)
  step = env.reset()
  if hook == 'after_step':
    step = _stand(env)
  assert step.observation['height'][0] == pytest.approx(0.6, abs=1e-12)
