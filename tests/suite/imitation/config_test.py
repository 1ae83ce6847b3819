"""Tests of dmc_multimode.suite.config."""

import json
from typing import Any

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np

from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import rewards
from dmc_multimode.suite.imitation import terminations


class ImitationConfigTest(parameterized.TestCase):
  def test_defaults(self) -> None:
    values = task_config.ImitationConfig()
    self.assertEqual(values.substeps, 6)
    self.assertEqual(values.horizon, 150)

  def test_one_millisecond(self) -> None:
    values = task_config.ImitationConfig(physics_timestep=0.001)
    self.assertEqual(values.substeps, 30)

  @parameterized.parameters(
    ({'time_limit': 0.0}, 'time_limit'),
    ({'time_limit': float('inf')}, 'time_limit'),
    ({'control_timestep': -0.03}, 'control_timestep'),
    ({'physics_timestep': float('nan')}, 'physics_timestep'),
    ({'physics_timestep': 0.004}, 'divide'),
    ({'physics_timestep': 0.06}, 'divide'),
    ({'reference_starts': 1.5}, 'share'),
    ({'obstacles': -0.1}, 'obstacles is a share'),
    ({'obstacles': 1.1}, 'obstacles is a share'),
    ({'obstacles': float('nan')}, 'obstacles is a share'),
    ({'obstacles_start': -1}, 'obstacles_start must not be negative'),
    ({'push_speed': -0.1}, 'push_speed must not be negative'),
    ({'push_interval': 0.0}, 'push_interval must be positive'),
    ({'push_start': -1}, 'push_start must not be negative'),
    ({'contact_bonus': -0.1}, 'contact_bonus'),
    ({'late_contact_bonus': float('nan')}, 'late_contact_bonus'),
    ({'contact_bonus_start': -1}, 'contact_bonus_start'),
    ({'contact_bonus_start': 2, 'contact_bonus_end': 1}, 'later than'),
  )
  def test_rejects(self, values: dict[str, float], message: str) -> None:
    with self.assertRaisesRegex(ValueError, message):
      task_config.ImitationConfig(**values)  # type: ignore[arg-type]

  def test_for_evaluation(self) -> None:
    values = task_config.for_evaluation(
      task_config.ImitationConfig(
        time_limit=3.0,
        tighten_steps=100,
        assist_steps=9,
        contact_bonus=0.1,
        late_contact_bonus=0.2,
        contact_bonus_end=10,
        obstacles=0.4,
        obstacles_start=5,
        push_speed=0.5,
        push_start=5,
      )
    )
    self.assertEqual(values.push_speed_after(10**9), 0.0)
    self.assertEqual(values.obstacle_share_after(10**9), 0.0)
    self.assertEqual(values.contact_bonus_after(20), 0.0)
    self.assertEqual((values.assist_steps, values.contact_bonus), (0, 0.0))
    self.assertEqual(values.reference_starts, 0.0)
    self.assertEqual(values.edge_noise, 0.0)
    self.assertEqual(values.distance_after(0), values.limits.distance)
    self.assertEqual(values.time_limit, 3.0)

  @parameterized.parameters((0, 0.8), (50, 0.6), (100, 0.4), (1000, 0.4))
  def test_bound_on_the_distance_tightens(
    self, steps: int, expected: float
  ) -> None:
    values = task_config.ImitationConfig(
      limits=terminations.TerminationLimits(distance=0.4),
      early_distance=0.8,
      tighten_steps=100,
    )
    self.assertAlmostEqual(values.distance_after(steps), expected)

  @parameterized.parameters(
    (0, 0.5), (100, 0.5), (150, 0.4), (300, 0.1), (1000, 0.1)
  )
  def test_bonus_changes(self, steps: int, expected: float) -> None:
    values = task_config.ImitationConfig(
      contact_bonus=0.5,
      late_contact_bonus=0.1,
      contact_bonus_start=100,
      contact_bonus_end=300,
    )
    self.assertAlmostEqual(values.contact_bonus_after(steps), expected)

  def test_bonus_without_a_schedule(self) -> None:
    values = task_config.ImitationConfig(contact_bonus=0.5)
    self.assertEqual(values.contact_bonus_after(10**9), 0.5)

  def test_bonus_may_change_at_once(self) -> None:
    values = task_config.ImitationConfig(
      contact_bonus=0.5, contact_bonus_start=7, contact_bonus_end=7
    )
    self.assertEqual(values.contact_bonus_after(6), 0.5)
    self.assertEqual(values.contact_bonus_after(7), 0.0)

  @parameterized.parameters((0, 0.0), (99, 0.0), (100, 0.3), (10**9, 0.3))
  def test_obstacles_begin(self, steps: int, expected: float) -> None:
    values = task_config.ImitationConfig(obstacles=0.3, obstacles_start=100)
    self.assertEqual(values.obstacle_share_after(steps), expected)

  @parameterized.parameters(0.0, 0.3, 1.0)
  def test_obstacles_without_a_schedule(self, share: float) -> None:
    values = task_config.ImitationConfig(obstacles=share)
    self.assertEqual(values.obstacle_share_after(0), share)

  def test_no_obstacles_by_default(self) -> None:
    values = task_config.ImitationConfig()
    self.assertEqual(values.obstacle_share_after(10**9), 0.0)

  def test_json_round_trip(self) -> None:
    values = task_config.ImitationConfig(
      gains=rewards.RewardGains(0.35, 0.35, 0.3),
      limits=terminations.TerminationLimits(distance=0.25),
      time_limit=3.0,
      joint_noise=0.01,
      obstacles=0.4,
      obstacles_start=7,
    )
    text = json.dumps(task_config.to_dict(values))
    self.assertEqual(task_config.from_dict(json.loads(text)), values)

  def test_old_values_have_no_limit_of_the_angle(self) -> None:
    values = task_config.to_dict(task_config.ImitationConfig())
    del values['limits']['angle']
    self.assertEqual(task_config.from_dict(values).limits.angle, np.pi)

  def test_old_commands_did_not_wait_for_the_ground(self) -> None:
    values = task_config.to_dict(task_config.ImitationConfig())
    del values['commands_from_ground']
    self.assertFalse(task_config.from_dict(values).commands_from_ground)

  @parameterized.parameters(
    {'remove': 'gains'},
    {'unknown': 1.0},
    {'gains': {'weight': 1.0}},
    {'limits': 3},
    {'time_limit': 'long'},
    {'time_limit': -1.0},
    {'obstacles': True},
    {'push_start': 1.5},
    {'servo_inertia': 1},
    {'contact_force': float('nan')},
  )
  def test_from_dict_rejects(self, **changes: Any) -> None:
    values = {**task_config.to_dict(task_config.ImitationConfig()), **changes}
    values.pop(values.pop('remove', ''), None)
    with self.assertRaises(ValueError):
      task_config.from_dict(values)


if __name__ == '__main__':
  absltest.main()
