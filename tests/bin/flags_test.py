"""Tests of dmc_multimode.bin.flags."""

import dataclasses
import re
from typing import Any, Iterator

from absl import flags
import pytest

from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import schedule


@config_lib.dataclass
class _Gains:
  """Gains.

  Attributes:
    weight: of a term,
      from 0.
  """

  weight: config_lib.NonNegative = 0.5


@config_lib.dataclass
class _Config:
  """Test configuration.

  Attributes:
    gains: of Eq. 3.
    sizes, kind: of the network.
    count: how many.
    rate: schedule of the rate.
    learn: learns.
  """

  gains: _Gains = _Gains()
  sizes: tuple[config_lib.PositiveInt, ...] = (256, 128)
  kind: str = 'none'
  count: config_lib.Count = 4
  rate: schedule.ScheduleField = schedule.constant(0.1)
  learn: bool = True

  def __post_init__(self) -> None:
    if self.count > len(self.kind):
      raise ValueError(f'count {self.count} is more than the kind has')


_NAMES = ['x_gains_weight']
_NAMES += [f'x_{name}' for name in ('sizes', 'kind', 'count', 'rate', 'learn')]


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
  """Parses flags that are not those of the process."""
  own = flags.FlagValues()
  monkeypatch.setattr(config_flags, 'FLAGS', own)
  yield lambda *args: own(['binary', *args])


def test_values_given(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse(
    '--x_gains_weight=0.7',
    '--x_sizes=32, 16',
    '--x_kind=augment',
    '--x_count=5',
    '--x_rate=0:3@1e3:2e3',
    '--nox_learn',
  )
  rate = schedule.Schedule(0.0, 3.0, 1000, 2000)
  expected = _Config(_Gains(0.7), (32, 16), 'augment', 5, rate, False)
  assert config_flags.read(_Config(), 'x') == expected
  assert list(config_flags.given(_Config(), 'x')) == _NAMES


def test_what_is_not_given_stays(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse('--x_kind=augment')
  config = _Config(gains=_Gains(0.1), count=2, sizes=(3,), learn=False)
  assert config_flags.read(config, 'x') == dataclasses.replace(
    config, kind='augment'
  )
  assert config_flags.given(config, 'x') == {'x_kind': 'augment'}


@pytest.mark.parametrize(
  'flag',
  [
    '--x_sizes=16,wide',
    '--x_sizes=',
    '--x_count=-1',
    '--x_gains_weight=inf',
    '--x_rate=',
    '--x_rate=1:2:3',
    '--x_wings=2',
  ],
)
def test_values_refused(parse: Any, flag: str) -> None:
  config_flags.define(_Config(), 'x')
  with pytest.raises(flags.Error, match=flag.lstrip('-').partition('=')[0]):
    parse(flag)


def test_a_combination_refused(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse('--x_count=9')
  with pytest.raises(ValueError, match=r'^--x_\*: count 9 is more than'):
    config_flags.read(_Config(), 'x')


def test_help_is_what_the_class_says(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  texts = {name: config_flags.FLAGS[name].help for name in _NAMES}
  assert texts['x_gains_weight'] == 'of a term, from 0.'
  assert texts['x_sizes'].startswith('of the network.')
  assert "default: '256,128'" in config_flags.FLAGS.get_help()
  parse()


@pytest.mark.parametrize(
  ('kind', 'words'),
  [
    (config_lib.NonNegative, 'a number at least 0'),
    (config_lib.Share, 'a number from 0 to 1'),
    (config_lib.PositiveInt, 'a whole number above 0'),
    (
      ppo_config.PPOConfig.__annotations__['discount'],
      'a number from 0 to below 1',
    ),
    (float, 'a number'),
    (str, ''),
    (
      tuple[config_lib.PositiveInt, ...],
      'whole numbers above 0, comma-separated',
    ),
    (tuple[str, ...], 'names, comma-separated'),
    (disturbances.Range, 'two numbers, LOW,HIGH'),
    (
      schedule.ShareField,
      'a schedule over environment steps, FIRST[:LAST][@START[:END]]',
    ),
  ],
)
def test_types_and_bounds_in_words(parse: Any, kind: Any, words: str) -> None:
  @dataclasses.dataclass
  class Config:
    field: kind = schedule.constant(0.5) if 'schedule' in words else None

  config_flags.define(Config(), 'x')
  parse()
  assert config_flags.FLAGS['x_field'].parser.syntactic_help == words


def test_groups_of_the_help(parse: Any) -> None:
  config_flags.define(_Config(), 'x')
  parse()
  one, inner = config_flags.help_texts()
  assert one.splitlines()[1] == '--x_*: Test configuration:'
  assert one.count('(default: ') == len(_NAMES) - 1
  assert inner == (
    '\n--x_gains_*: Gains:\n  --x_gains_weight: of a term, from 0.\n'
    "    (default: '0.5')\n    (a number at least 0)"
  )


def test_whatever_has_a_dimension_has_a_unit(parse: Any) -> None:
  config = run_config.RunConfig()
  for part in ('ppo', 'sampling', 'task'):
    config_flags.define(getattr(config, part), part)
  parse()
  dimensional = re.compile(
    r'.*_(angle|centre_of_mass|delay|distance|distance_slack|end|force|height'
    r'|interval|limit|noise|payload|slope|speed|std|std_floor|steps|timestep)'
  )
  unit = re.compile(
    r'\b(metres|seconds|radians|degrees|kg|newtons|m/s|steps|factor)\b'
  )
  found = [
    name
    for name in config_flags.FLAGS
    if dimensional.fullmatch(name) and not config_flags.FLAGS[name].boolean
  ]
  assert len(found) > 20
  for name in found:
    assert unit.search(config_flags.FLAGS[name].help), name


def test_every_configuration(parse: Any) -> None:
  config = run_config.RunConfig()
  for part in ('ppo', 'sampling', 'task'):
    config_flags.define(getattr(config, part), part)
  parse()
  for part in ('ppo', 'sampling', 'task'):
    assert config_flags.read(getattr(config, part), part) == getattr(
      config, part
    )
  assert not set(config_flags.RENAMED) & set(config_flags.FLAGS)
  for now in config_flags.RENAMED.values():
    assert now.partition('=')[0] in config_flags.FLAGS, now
  # Nothing is without a word on what it is.
  missing = [n for n in config_flags.FLAGS if not config_flags.FLAGS[n].help]
  assert not [name for name in missing if '_gains_' not in name]


def test_every_disturbance_has_a_flag() -> None:
  expected = {*disturbances.nominal(1), 'push_speed', 'sensor_noise'}
  assert set(config_flags.DISTURBANCES) == expected
