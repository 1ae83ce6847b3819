"""Tests of selectors: training, files, and plans that they command."""

import dataclasses
import pathlib
from typing import Any

import numpy as np
import pytest
import torch

from dmc_multimode import planner
from dmc_multimode.experiments import selector_training
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.suite.reaching import worlds as worlds_lib

pytestmark = pytest.mark.usefixtures('one_thread')

_SMALL: dict[str, Any] = {
  'policy': 'quickstart',
  'arena': 'plateau',
  'num_worlds': 8,
  'threads': 1,
  'learning_rollout_length': 4,
  'learning_hidden_sizes': (8,),
}


def _weights(folder: pathlib.Path) -> dict[str, np.ndarray]:
  network = selector_lib.load(folder / 'selector').network
  return {k: v.numpy() for k, v in network.state_dict().items()}


def test_resumes_bit_for_bit_and_refuses_other_settings(
  tmp_path: pathlib.Path,
) -> None:
  train = selector_training.train
  train(tmp_path / 'whole', decisions=96, **_SMALL)
  train(tmp_path / 'parts', decisions=32, **_SMALL)
  with pytest.raises(ValueError, match='already holds a run.* resume=True'):
    train(tmp_path / 'parts', decisions=96, **_SMALL)
  with pytest.raises(ValueError, match='learning_discount=0.97, not 0.9'):
    train(tmp_path / 'parts', resume=True, learning_discount=0.9)
  train(tmp_path / 'parts', resume=True, decisions=96)
  whole, parts = _weights(tmp_path / 'whole'), _weights(tmp_path / 'parts')
  for name, value in whole.items():
    np.testing.assert_array_equal(value, parts[name], name)


def test_rewards_by_hand() -> None:
  config = selector_training.SelectorConfig(
    policy='quickstart', arena='plateau', num_worlds=3, threads=1
  )
  run = selector_training.SelectorTraining(config)
  goal = run.worlds.part('goal')
  before = np.zeros((3, run.worlds.observation_spec().shape[0]), np.float32)
  after = before.copy()
  before[:, goal], after[:, goal] = [3.0, 4.0, 9.0], [[0.0, 4.0, 0.0]] * 3
  run._observation = before
  made = worlds_lib.ReachingStep(
    reward=np.zeros(3),
    discount=np.array([1.0, 1.0, 0.0]),
    last=np.array([False, False, True]),
    observation=after,
    final_observation=after[2:],
    reached=np.array([False, True, False]),
  )
  # From 5 m to 4 m along the ground; standing there; fallen.
  np.testing.assert_allclose(run._reward(made, after), [1.0, 1.1, -1.0])
  assert np.isnan(run.means['fell'])
  run._count(made)
  assert run.means['fell'] == 1.0 and run.means['reached'] == 0.0


def test_network_sees_no_knots_and_chooses_what_is_obeyed() -> None:
  layout = (('goal', 3), ('knots_left', 1), ('ground', 2))
  network = selector_lib.SelectorNetwork(layout, 3, (4,))
  seen = torch.tensor([[9.0, 0.0, -9.0, 0.5, 1.0, 2.0]])
  assert network.prepare(seen).tolist() == [[2.0, 0.0, -2.0, 0.0, 1.0, 2.0]]
  obeyed = torch.tensor([[False, True, False]])
  assert network(seen, obeyed).exp().tolist() == [[0.0, 1.0, 0.0]]


@pytest.fixture(name='trained', scope='module')
def _trained(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  folder = tmp_path_factory.mktemp('run')
  selector_training.train(folder, decisions=32, **_SMALL)
  return folder / 'selector'


def test_goes_on_from_a_selector(trained: pathlib.Path) -> None:
  config = selector_training.SelectorConfig(
    policy='quickstart',
    arena='gap',
    num_worlds=1,
    threads=1,
    init_from=str(trained),
    learning=selector_training.LearningConfig(hidden_sizes=(8,)),
  )
  found = selector_training.SelectorTraining(config).selector()
  expected = selector_lib.load(trained).network.state_dict()
  for name, value in found.network.state_dict().items():
    np.testing.assert_array_equal(value, expected[name], name)
  for changes, message in (
    ({'learning': selector_training.LearningConfig()}, r'\(8,\), not \(128,'),
    ({'policy': 'unimodal_walk'}, 'made for the policy quickstart'),
  ):
    with pytest.raises(ValueError, match=message):
      selector_training.SelectorTraining(dataclasses.replace(config, **changes))


def test_what_it_commands_is_a_plan(trained: pathlib.Path) -> None:
  config = steering.SteeringConfig(str(trained))
  found = planner.solve('quickstart', 'gap', planner=config, quiet=True)
  # 11 knots of 0.3 s, as 22 of 0.15 s.
  assert (len(found.plan.modes), found.plan.knot_duration) == (22, 0.15)
  assert found.origin['planner'] == 'selector'
  assert 0 < found.origin['decision_ms'] <= found.origin['decision_ms_p99']
  # Open-loop, the plan does the same.
  problem = dataclasses.replace(
    reaching.PROBLEMS['gap'].config(0),
    knots=22,
    knot_duration=0.15,
  )
  again = planner.solve(
    'quickstart', 'gap', problem=problem, planner=config, quiet=True
  )
  np.testing.assert_array_equal(again.path, found.path)


def test_rejects(trained: pathlib.Path, tmp_path: pathlib.Path) -> None:
  solve = lambda policy, folder: planner.solve(
    policy, 'gap', planner=steering.SteeringConfig(folder), quiet=True
  )
  with pytest.raises(ValueError, match='made for the policy quickstart'):
    solve('pi2', str(trained))
  with pytest.raises(FileNotFoundError, match='has no selector beside it'):
    solve('unimodal_walk', '')
  with pytest.raises(FileNotFoundError, match='holds no selector.json'):
    solve('quickstart', str(tmp_path))
  broken = tmp_path / 'selector.json'
  broken.write_text('{"format": "dmc_multimode.selector.1"}')
  with pytest.raises(ValueError, match="damaged: it lacks 'layout'"):
    solve('quickstart', str(tmp_path))
