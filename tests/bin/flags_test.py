"""Tests of dmc_multimode.bin.flags."""

import dataclasses
from typing import Any, Iterator, NamedTuple

from absl import flags
import pytest

from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import mode_sampler


class _Gains(NamedTuple):
  weight: float = 0.5
  signs: tuple[int, ...] = (1,)


@dataclasses.dataclass(frozen=True)
class _Config:
  gains: _Gains = _Gains()
  sizes: tuple[int, ...] = (256, 128)
  kind: str = 'none'
  count: int = 4
  rate: float = 0.1
  learn: bool = True

  def __post_init__(self) -> None:
    if self.count < 0:
      raise ValueError(f'count must not be negative, got {self.count}.')


_NAMES = ['gains_weight', 'gains_signs', 'sizes', 'kind', 'count', 'rate']
_NAMES = [f'x_{name}' for name in (*_NAMES, 'learn')]


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
  """Parses flags that are not those of the process."""
  own = flags.FlagValues()
  monkeypatch.setattr(config_flags, 'FLAGS', own)
  for kind in ('bool', 'integer', 'float', 'string', 'list'):
    name = f'DEFINE_{kind}'
    define = getattr(flags, name)
    monkeypatch.setattr(
      flags,
      name,
      lambda *args, define=define: define(*args, flag_values=own),
    )
  yield lambda *args: own(['binary', *args])


def test_flags_of_the_fields(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse()
  found = [name for name in config_flags.FLAGS if name.startswith('x_')]
  assert sorted(found) == sorted(_NAMES)
  assert config_flags.read(_Config(), 'x') == _Config()
  assert config_flags.overrides(_Config(), 'x') == []


def test_values_given(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse(
    '--x_gains_weight=0.7',
    '--x_gains_signs=1,-1',
    '--x_sizes=32, 16',
    '--x_kind=augment',
    '--x_count=5',
    '--x_rate=3',
    '--nox_learn',
  )
  expected = _Config(_Gains(0.7, (1, -1)), (32, 16), 'augment', 5, 3.0, False)
  assert config_flags.read(_Config(), 'x') == expected
  assert config_flags.overrides(_Config(), 'x') == _NAMES


def test_defaults_come_from_the_object(parse: Any) -> None:
  config = _Config(count=7, gains=_Gains(0.1))
  config_flags.define(config, 'x')
  parse('--x_rate=0.2')
  found = config_flags.read(config, 'x')
  assert found == dataclasses.replace(config, rate=0.2)
  assert config_flags.overrides(config, 'x') == ['x_rate']


def test_other_values_than_the_defaults_stay(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse('--x_gains_weight=0.5', '--x_kind=augment')
  config = _Config(gains=_Gains(0.1, (1, 2)), count=7, sizes=(3,), learn=False)
  assert config_flags.read(config, 'x') == dataclasses.replace(
    config, gains=_Gains(0.5, (1, 2)), kind='augment'
  )


def test_empty_list(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse('--x_sizes=')
  assert config_flags.read(_Config(), 'x').sizes == ()


@pytest.mark.parametrize(
  ('flag', 'message'),
  [
    ('--x_sizes=16,wide', '--x_sizes needs integers.*wide'),
    ('--x_sizes=1.5', '--x_sizes needs integers'),
    ('--x_count=-1', 'count must not be negative'),
  ],
)
def test_values_refused(parse: Any, flag: str, message: str) -> None:
  config_flags.define(_Config(), 'x')
  parse(flag)
  with pytest.raises(ValueError, match=message):
    config_flags.read(_Config(), 'x')


@pytest.mark.parametrize('flag', ['--x_count=two', '--x_rate=', '--x_wings=2'])
def test_values_that_absl_refuses(parse: Any, flag: str) -> None:
  config_flags.define(_Config(), 'x')
  with pytest.raises(flags.Error):
    parse(flag)


def test_field_without_a_kind_of_flag(parse: Any) -> None:
  @dataclasses.dataclass(frozen=True)
  class Odd:
    thing: Any = None

  with pytest.raises(TypeError, match='x_thing'):
    config_flags.define(Odd(), 'x')
  parse()


@pytest.mark.parametrize(
  'config',
  [
    ppo_config.PPOConfig(),
    mode_sampler.SamplingConfig(),
    task_config.ImitationConfig(),
    runner.TrainingConfig(),
  ],
)
def test_every_configuration(parse: Any, config: Any) -> None:
  config_flags.define(config, 'x')
  parse()
  assert config_flags.read(config, 'x') == config


def test_replace() -> None:
  assert config_flags.replace(_Gains(), weight=0.1) == _Gains(0.1)
  assert config_flags.replace(_Config(), count=1) == _Config(count=1)
