"""Tests of schedules."""

import json
from typing import Any

import pytest

from dmc_multimode.utils import config
from dmc_multimode.utils import schedule


@pytest.mark.parametrize(
  ('text', 'values'),
  [
    ('0.5', (0.5, 0.5, 0.5, 0.5, 0.5)),
    ('1:2@200', (1.0, 1.0, 1.0, 2.0, 2.0)),
    ('1:3@100:300', (1.0, 1.0, 2.0, 3.0, 3.0)),
    ('3:1@0:4e2', (3.0, 2.5, 2.0, 1.5, 1.0)),
  ],
)
def test_values_by_steps(text: str, values: tuple[float, ...]) -> None:
  found = schedule.parse(text)
  at = tuple(found.at(steps) for steps in (0, 100, 200, 300, 400))
  if text == '1:2@200':
    at = (*at[:2], found.at(199), *at[3:])
  assert at == values
  assert schedule.parse(str(found)) == found
  # And it survives a file.
  values_of = json.loads(json.dumps(config.to_dict(found)))
  assert config.build(schedule.Schedule, values_of) == found


def test_geometric() -> None:
  found = schedule.Schedule(0.4, 0.1, 100, 300, 'geometric')
  assert found.at(200) == pytest.approx(0.2)
  assert [found.at(steps) for steps in (0, 100, 300)] == [0.4, 0.4, 0.1]


@pytest.mark.parametrize(
  'text', ['', 'a', '1:2:3', '1@2:3:4', '1@', 'nan', 'inf:1', '1@0.5', '1@9:8']
)
def test_texts_refused(text: str) -> None:
  with pytest.raises(ValueError) as error:
    schedule.parse(text)
  assert '\n' not in str(error.value)


@pytest.mark.parametrize(
  'values', [(1.0, 2.0, -1), (1.0, 2.0, 5, 4), (0.0, 1.0, 0, 0, 'geometric')]
)
def test_schedules_refused(values: tuple[Any, ...]) -> None:
  with pytest.raises(ValueError):
    schedule.Schedule(*values)


@pytest.mark.parametrize(
  ('text', 'largest', 'last'), [('0:2@5', 2, 2), ('3:1@5:9', 3, 1)]
)
def test_largest_and_last(text: str, largest: float, last: float) -> None:
  found = schedule.parse(text)
  assert found.largest == largest
  assert found.at_end() == schedule.constant(last)
