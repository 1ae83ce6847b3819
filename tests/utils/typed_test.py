"""Tests for typed."""

import dataclasses
import math
from typing import Any, NamedTuple

from absl.testing import absltest
from absl.testing import parameterized

from dmc_multimode.utils import typed


@dataclasses.dataclass(frozen=True)
class _Config:
  rate: float
  count: int = 1
  quiet: bool = False
  name: str = ''
  sizes: tuple[int, ...] = ()

  def __post_init__(self) -> None:
    if self.count < 1:
      raise ValueError('count must be positive.')


class _Gains(NamedTuple):
  weight: float = 0.5


class BuildTest(parameterized.TestCase):
  def test_what_fits(self) -> None:
    values = {'rate': 1, 'count': 3, 'quiet': True, 'name': 'a', 'sizes': (2,)}
    self.assertEqual(
      typed.build(_Config, values), _Config(1, 3, True, 'a', (2,))
    )
    self.assertEqual(typed.build(_Gains, {'weight': 0.1}), _Gains(0.1))
    self.assertEqual(typed.build(_Gains, {}), _Gains())

  @parameterized.parameters(
    ({'rate': '1'}, "rate must be a finite number, got '1'"),
    ({'rate': True}, 'rate must be a finite number'),
    ({'rate': math.nan}, 'rate must be a finite number'),
    ({'rate': math.inf}, 'rate must be a finite number'),
    ({'rate': 10**400}, 'rate must be a finite number'),
    ({'rate': 1.0, 'count': 1.0}, 'count must be a whole number, got 1.0'),
    ({'rate': 1.0, 'count': False}, 'count must be a whole number'),
    ({'rate': 1.0, 'quiet': 1}, 'quiet must be true or false'),
    ({'rate': 1.0, 'name': None}, 'name must be text'),
    ({'rate': 1.0, 'speed': 2.0}, 'speed is unknown'),
    ({'rate': 1.0, 'count': 0}, 'count must be positive'),
    ({}, "'rate'"),
    ([], '_Config must be a table, got list'),
    (None, '_Config must be a table'),
  )
  def test_what_does_not(self, values: Any, message: str) -> None:
    with self.assertRaisesRegex(ValueError, message):
      typed.build(_Config, values)


if __name__ == '__main__':
  absltest.main()
