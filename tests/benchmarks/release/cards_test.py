"""Tests of benchmarks.release.cards, and of the shipped cards."""

import copy
import json
import re
import shlex
from typing import Any

from absl import flags
import pytest

from dmc_multimode import pretrained
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import config as run_config
from dmc_multimode.pretrained import folder as folder_lib
from tests.benchmarks import modules

cards = modules.load('release.cards')


def _contents(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
  folder = folder_lib.find(name)
  read = lambda file: json.loads((folder / file).read_text())
  return read('policy.json'), read('metrics.json')


@pytest.mark.parametrize('name', pretrained.names(installed=True))
def test_shipped_cards_are_those_of_their_policies(name: str) -> None:
  shipped = (folder_lib.find(name) / cards.CARD_FILE).read_text()
  assert shipped == cards.read(name), 'run python -m benchmarks.release.cards'
  assert shipped.startswith(f'# {name}\n')


def test_parts() -> None:
  text = cards.read('pi2')
  assert re.findall('^## (.*)', text, re.MULTILINE) == [
    'Scores',
    'Modes',
    'Acceptance criteria',
    'Motion',
    'Training',
    'Selector',
    'Limits of use',
    'Licence',
  ]
  assert '4 locomotion modes' in text and 'the 16 transitions' in text
  assert 'Apache 2.0' in text and 'version 0.1.0' not in text
  for row in re.findall(r'((?:^\|.*\n)+)', text, re.MULTILINE):
    assert len({line.count('|') for line in row.splitlines()}) == 1


def test_scores_are_those_of_the_metrics() -> None:
  description, metrics = _contents('pi2')
  metrics['mra_modes']['mean'] = 0.123
  metrics['survival_modes'] = 0.75
  metrics['transitions']['idle->launch']['mra'] = 0.111
  metrics['acceptance']['idle']['drift']['passed'] = False
  text = cards.card('mine', description, metrics)
  assert '| modes (4) | 0.123 |' in text
  assert '25.0 % of the episodes of modes end early.' in text
  assert 'lowest MRA: idle->launch (0.111, survival' in text
  assert 'does not pass these criteria: idle drift.' in text
  assert '6 of 7 passed' in text and '**no**' in text


def test_without_motion() -> None:
  description, metrics = _contents('unimodal_idle')
  del metrics['motion']
  text = cards.card('mine', description, metrics)
  assert '## Motion' not in text and 'transitions between' not in text
  assert '1 locomotion mode of' in text


def test_what_it_was_trained_on() -> None:
  assert 'within the ranges above of action delay, friction' in cards.read(
    'pi2'
  )
  text = cards.read('pi2_one_hot')
  assert 'trained on the nominal robot alone' in text
  assert 'one-hot commands' in text
  assert 'trained by version 0.1.0, on a robot with softer contacts' in text


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Any:
  """Parses the flags of a training, and returns its configuration."""
  own = flags.FlagValues()
  monkeypatch.setattr(config_flags, 'FLAGS', own)
  default = run_config.RunConfig()
  for part in ('ppo', 'sampling', 'task'):
    config_flags.define(getattr(default, part), part)
  for name in ('modes', 'run_dir', 'init_from', 'robot'):
    flags.DEFINE_string(name, '', '', flag_values=own)
  for name in ('steps', 'seed', 'num_worlds', 'threads'):
    flags.DEFINE_integer(name, getattr(default, name), '', flag_values=own)
  flags.DEFINE_bool('one_hot', False, '', flag_values=own)

  def read(text: str) -> run_config.RunConfig:
    own(shlex.split(text.replace('python -m', '').replace('\\\n', '')))
    changes = {
      name: own[name].value
      for name in (
        *('modes', 'steps', 'seed', 'num_worlds', 'threads', 'one_hot'),
        'init_from',
      )
      if own[name].present
    }
    for part in ('ppo', 'sampling', 'task'):
      changes |= config_flags.given(getattr(default, part), part)
    return run_config.overridden(default, changes)

  return read


@pytest.mark.parametrize('name', pretrained.names(installed=True))
def test_the_command_is_that_of_the_training(name: str, parse: Any) -> None:
  (text,) = re.findall(r'```sh\n(.*?)```', cards.read(name), re.DOTALL)
  description, _ = _contents(name)
  provenance = description['provenance']
  expected = run_config.from_dict(provenance['run'])
  found = parse(text)
  different = {
    key: (one, other)
    for key, one, other in run_config.differences(found, expected)
    # A sum of two numbers may differ in its last digit.
    if str(one) != str(other)
  }
  steps = different.pop('steps', None)
  if found.init_from:  # That policy tells its modes; there is no flag for them.
    _, known = different.pop('init_modes')
    assert known == ','.join(pretrained.load(found.init_from).mode_set.names)
  assert not different
  if 'steps' in provenance['run']:
    assert found.steps == min(expected.steps, provenance['steps'])
  else:
    assert steps is None or found.steps == provenance['steps']


def test_a_policy_that_the_run_kept_on_its_way() -> None:
  description, metrics = _contents('pi2')
  kept = copy.deepcopy(description)
  kept['provenance']['steps'] = 9_000_000
  text = cards.card('early', kept, metrics)
  assert '--run_dir=runs/early \\\n  --steps=9000000' in text


def test_no_metrics_no_card() -> None:
  description, metrics = _contents('pi2')
  del metrics['modes']
  with pytest.raises(KeyError):
    cards.card('mine', description, metrics)
