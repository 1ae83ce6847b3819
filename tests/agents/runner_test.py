"""Tests of dmc_multimode.agents.runner."""

import dataclasses
import itertools
import pathlib
import time
from typing import Any, Mapping
from unittest import mock

import numpy as np
import pytest
import torch

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import schedule
from tests.agents import toy

pytestmark = pytest.mark.usefixtures('one_thread')

_PPO = ppo_config.PPOConfig(hidden_sizes=(16,), rollout_length=4, minibatches=2)
# Terrain that moves (launch), mirror images, and episodes short enough to end
# by all causes within the test.
_RUN = run_config.RunConfig(
  modes='idle,walk_left,walk_right,launch',
  num_worlds=8,
  threads=1,
  one_hot=True,
  ppo=dataclasses.replace(
    _PPO,
    symmetry='augment',
    initial_std=0.2,
    std_floor=schedule.Schedule(0.25, 0.1, 2 * 32, 10 * 32),
  ),
  task=task_config.ImitationConfig(time_limit=0.45),
)
_ITERATION = _RUN.num_worlds * _PPO.rollout_length  # Control steps.


class Recorder:
  """A logger that keeps its rows."""

  def __init__(self) -> None:
    self.rows: list[Mapping[str, float]] = []

  def write(self, values: Mapping[str, float]) -> None:
    self.rows.append(values)

  def close(self) -> None:
    pass


def _biped() -> setup.Run:
  motions = library.resolve(_RUN.modes)
  return setup.build(_RUN, mode_set.one_hot(motions))


def _train(run: setup.Run, iterations: int) -> list[Mapping[str, float]]:
  """Trains on to `iterations` in all; returns the rows, without the speed."""
  logger = Recorder()
  config = runner.TrainingConfig(steps=iterations * _ITERATION, log_every=1)
  run.loop.run(config, logger, lambda: None)
  return [{**row, 'steps_per_second': 0.0} for row in logger.rows]


def _state(run: setup.Run) -> dict[str, torch.Tensor]:
  tensors, values = run.loop.state()
  assert values['steps'] == values['iterations'] * _ITERATION
  return {key: torch.as_tensor(value) for key, value in tensors.items()}


def test_resumed_run_goes_on_bit_for_bit(tmp_path: pathlib.Path) -> None:
  before, after = 6, 12
  whole = _biped()
  rows = _train(whole, after)

  first = _biped()
  np.testing.assert_equal(_train(first, before), rows[:before])  # NaN too.
  checkpointer = checkpointing.Checkpointer(tmp_path)
  checkpointer.save(*first.loop.state())
  _train(first, after)  # What follows does not reach into the checkpoint.

  second = _biped()
  _train(second, 1)  # Nor does what came before.
  tensors, values, note = checkpointer.load()
  second.loop.restore(tensors, values)
  assert not note and second.loop.steps == before * _ITERATION
  np.testing.assert_equal(_train(second, after), rows[before:])

  expected, found = _state(whole), _state(second)
  assert expected.keys() == found.keys()
  for part in ('learner/network', 'learner/optimiser', 'actor', 'tracker'):
    assert any(key.startswith(part) for key in expected), part
  for key, value in expected.items():
    assert torch.equal(value, found[key]), key
  # Otherwise the test would prove little.
  assert expected['tracker/seen'].sum() > 16
  moved = expected['environment/physics'] != tensors['environment/physics']
  assert moved.any(dim=1).all()


def test_state_of_another_run() -> None:
  tensors, values = _biped().loop.state()
  tensors = {key: torch.as_tensor(value) for key, value in tensors.items()}
  motions = library.resolve(_RUN.modes)
  for change in ({'num_worlds': 4}, {'modes': 'idle,launch'}):
    config = dataclasses.replace(_RUN, **change)
    motions = library.resolve(config.modes)
    other = setup.build(config, mode_set.one_hot(motions))
    with pytest.raises(ValueError):
      other.loop.restore(tensors, values)
  del tensors['actor/generator']
  with pytest.raises(ValueError, match='generator'):
    _biped().loop.restore(tensors, values)


def test_rows_of_the_log() -> None:
  (row,) = _train(_biped(), 1)
  names = _RUN.modes.split(',')
  for kind, name in itertools.product(
    ('return', 'survival', 'seconds', 'p'), names
  ):
    assert f'{kind}/{name}' in row
  for kind, one, other in itertools.product(('return', 'p'), names, names):
    assert one == other or f'{kind}/{one}->{other}' in row
  assert sum(row[f'p/{name}'] for name in names) == pytest.approx(1.0)
  shown = {'steps', 'mra_modes', 'mra_transitions', 'survival', 'kl', 'std'}
  assert shown <= row.keys() and row['steps'] == _ITERATION


# The loop.


def _toy_loop() -> runner.TrainingLoop:
  """16 environment steps an iteration."""
  environment = toy.TargetEnvironment(
    4, lambda seen: seen[:, :1], lambda rng, count: rng.uniform(size=(count, 2))
  )
  return toy.loop(environment, _PPO)


def _run(
  loop: runner.TrainingLoop, should_stop: Any = lambda: False, **config: Any
) -> tuple[Recorder, mock.Mock]:
  logger, save = Recorder(), mock.Mock()
  loop.run(runner.TrainingConfig(**config), logger, save, should_stop)
  return logger, save


def test_stops_at_its_steps_and_saves() -> None:
  loop = _toy_loop()
  logger, save = _run(loop, steps=70, log_every=2)
  assert (loop.steps, loop.iterations) == (80, 5)
  assert [row['steps'] for row in logger.rows] == [32, 64]
  assert logger.rows[0]['p/reach'] == 1.0
  assert save.call_count == 1
  # Nothing is left to do; it is saved nevertheless.
  _, save = _run(loop, steps=70)
  assert loop.steps == 80 and save.call_count == 1


def test_stops_when_asked_or_when_its_time_is_up() -> None:
  loop, answers = _toy_loop(), iter([False, False, True])
  _, save = _run(loop, lambda: next(answers))
  assert loop.iterations == 3 and save.call_count == 1
  # A second passes at every look.
  with mock.patch.object(time, 'monotonic', side_effect=itertools.count()):
    loop = _toy_loop()
    _run(loop, minutes=0.05)
  assert loop.iterations == 4


def test_saves_in_between() -> None:
  with mock.patch.object(time, 'monotonic', side_effect=itertools.count()):
    loop = _toy_loop()
    _, save = _run(loop, steps=160, checkpoint_seconds=3.0)
  assert loop.iterations == 10
  # Every fourth look, one of which is that after saving; and at the end.
  assert save.call_count == 2 + 1
  # No moment is saved twice.
  _, save = _run(_toy_loop(), steps=64, checkpoint_seconds=1e-9)
  assert save.call_count == 4


@pytest.mark.parametrize(
  ('every', 'kept'),
  [
    (0, []),
    (24, [32, 48, 80]),  # 24, 48 and 72 were passed by then.
    (10, [16, 32, 48, 64, 80]),  # Once, however many multiples are passed.
    (80, [80]),
  ],
)
def test_keeps_policies(every: int, kept: list[int]) -> None:
  loop, found, saved = _toy_loop(), [], []
  loop.run(
    runner.TrainingConfig(steps=80, keep_every=every),
    Recorder(),
    lambda: saved.append(loop.steps),
    keep=lambda: found.append((loop.steps, loop.iterations)),
  )
  assert found == [(steps, steps // 16) for steps in kept]
  assert saved == [80]  # That is another thing.
