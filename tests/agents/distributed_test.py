"""Tests of dmc_multimode.agents.distributed, and of two ranks that learn.

Two processes do everything once; the tests look at what each has brought home.
"""

from concurrent import futures
import dataclasses
import multiprocessing
import os
import pathlib
import socket
from typing import Any, Mapping
from unittest import mock

import numpy as np
import pytest
import torch

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import builder
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import rollouts as rollouts_lib
from tests.agents import toy

pytestmark = pytest.mark.usefixtures('one_thread')

_RANKS = 2
_TIMEOUT = 120  # Seconds.
# One minibatch has all samples, so that the order in which they come is none.
_WHOLE = ppo_config.PPOConfig(
  hidden_sizes=(16,), rollout_length=4, epochs=2, minibatches=1
)
_PPO = dataclasses.replace(_WHOLE, minibatches=2)
_LATENTS = torch.tensor([-1.0, 1.0, 0.0])
_Found = dict[str, Any]


class _Environment(toy.TargetEnvironment):
  """Worlds of a rank, which note what they learn; mode 0 at rank 0, else 1."""

  def __init__(self, rank: int, seed: int, replicas: int = 1):
    draw = lambda rng, count: rng.uniform(size=(count, 4))
    super().__init__(4, lambda seen: seen[:, :1], draw, seed, replicas)
    self._rank = rank
    self.learned: list[np.ndarray] = []

  def step(self, actions: np.ndarray) -> toy.TimeStep:
    found = super().step(actions)
    found.results.initial[:] = found.results.final[:] = self._rank
    return found

  def learn(self, outcomes: core.Outcomes) -> None:
    found = outcomes.initial, outcomes.final, outcomes.returns
    self.learned.append(np.stack([*found, outcomes.causes == 0]))

  def state(self) -> dict[str, np.ndarray]:
    words = self._random_state.get_state(legacy=False)['state']
    return {
      **super().state(),
      'keys': words['key'],
      'position': np.array(words['pos']),
    }

  def restore(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
    words = {'key': state['keys'], 'pos': int(state['position'])}
    self._random_state.set_state(
      {**self._random_state.get_state(legacy=False), 'state': words}
    )
    return super().restore(state)


def _loop(
  communicator: distributed.Communicator,
) -> tuple[_Environment, runner.TrainingLoop]:
  seed = distributed.rank_seed(5, communicator.rank)
  environment = _Environment(communicator.rank, seed, communicator.size)
  parts = builder.PPOBuilder(
    _PPO, environment.description(), 0, communicator, parallel=True
  )
  network = parts.make_networks()
  return environment, runner.TrainingLoop(
    environment,
    parts.make_actor(network),
    parts.make_learner(network),
    _PPO.rollout_length,
    ('reach', 'turn'),
    lambda: {},
    communicator,
  )


def _rollouts() -> rollouts_lib.Rollouts:
  """8 steps of 6 worlds, in which all modes and ends occur."""
  generator = torch.Generator().manual_seed(1)
  draw = lambda *shape: torch.randn(*shape, generator=generator)
  seen, ended = draw(8, 6, 4), draw(8, 6) > 1
  # Mode 2 is seen by the worlds of one rank alone.
  seen[..., 2] = torch.tensor([-1.0, 1.0, -1.0, 1.0, 0.0, -1.0])
  return rollouts_lib.Rollouts(
    observations=seen,
    actions=draw(8, 6, 1),
    log_probs=draw(8, 6).abs().neg(),
    means=0.1 * draw(8, 6, 1),
    rewards=draw(8, 6),
    discounts=(~ended).float(),
    last=ended,
    next_observations=seen + 0.1 * draw(8, 6, 4),
  )


def _learn(
  communicator: distributed.Communicator, advantages: str
) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
  """Learns from a rank's part of the rollouts: its network, and metrics."""
  config = dataclasses.replace(_WHOLE, advantages=advantages)
  mode_of = lambda raw: (raw[:, 2:3] - _LATENTS).abs().argmin(dim=1)
  about = _Environment(0, 0).description(mode_of=mode_of)
  parts = builder.PPOBuilder(config, about, 0, communicator, parallel=True)
  network = parts.make_networks()
  learner = parts.make_learner(network)
  mine = slice(communicator.rank, None, communicator.size)
  data = rollouts_lib.Rollouts(*(field[:, mine] for field in _rollouts()))
  for _ in range(3):
    metrics = learner.step(data, 0)
  return network.state_dict(), metrics


def _operations(ranks: distributed.Communicator) -> _Found:
  """Results of every operation."""
  rank = ranks.rank
  pair = [torch.full((2, 2), 1.0 + rank), torch.tensor(4.0 * rank)]
  ranks.average(pair)
  sent = [torch.tensor([7.0 + rank])]
  ranks.broadcast(sent)
  values = torch.arange(3.0 + 4 * rank) ** 2

  def fail() -> str:
    raise OSError('no such run')

  errors = {}
  for name, make in (('good', lambda: 'text' * (rank + 1)), ('bad', fail)):
    try:
      errors[name] = distributed.from_first(ranks, make)
    except (OSError, ValueError) as error:
      errors[name] = repr(error)
  return {
    'average': pair,
    'broadcast': sent,
    'moments': ranks.moments(values),
    'few': ranks.moments(torch.full((rank,), 3.0)),
    'any': ranks.any(False, rank == 1, True),
    'gather': ranks.gather(torch.full((2 * rank, 3), float(rank))),
    'collect': ranks.collect(b'abc'[: 1 + rank]),
    'scatter': ranks.scatter([b'first', b''] if rank == 0 else []),
    'from_first': errors,
  }


def _in_two_threads(ranks: distributed.Communicator) -> list[float]:
  """Both ranks' threads may be ahead of each other, in any order."""
  other = ranks.split()

  def count(communicator: distributed.Communicator, step: float) -> float:
    total = torch.zeros(1)
    for _ in range(200):
      total += step * (1 + communicator.rank)
      communicator.average([total])
    return float(total)

  with futures.ThreadPoolExecutor(1) as pool:
    theirs = pool.submit(count, other, 1.0)
    return [count(ranks, 100.0), theirs.result()]


def _diverge(ranks: distributed.Communicator) -> _Found:
  """One rank's rollouts are not finite."""
  environment, loop = _loop(ranks)
  if ranks.rank == 1:
    environment.step = lambda actions, step=environment.step: step(  # type: ignore
      np.full_like(actions, np.nan)
    )
  before = loop.state()[0]
  try:
    loop.run(runner.TrainingConfig(steps=1), mock.Mock(), lambda: None)
  except FloatingPointError as error:
    return {'error': str(error), 'before': before, 'after': loop.state()[0]}
  raise AssertionError('it learned')


def _train(ranks: distributed.Communicator) -> _Found:
  """Trains, saves, trains on; restores, trains on again."""
  environment, loop = _loop(ranks)
  config = runner.TrainingConfig(steps=8 * 16 * _RANKS)
  asked = iter([False, False, ranks.rank == 1])  # Only one is asked to.
  save = mock.Mock()
  loop.run(config, mock.Mock(), save, lambda: next(asked))
  stopped, saves = loop.iterations, save.call_count
  first = loop.state()
  loop.run(config, mock.Mock(), lambda: None)
  learned = np.concatenate(environment.learned, axis=1)
  second, values = loop.state()
  _, other = _loop(ranks)
  other.restore(*(first if ranks.rank == 0 else ({}, {})))
  other.run(config, mock.Mock(), lambda: None)
  found = {
    'stopped': (stopped, saves),
    'first': first,
    'state': (second, values),
    'again': other.state()[0],
    'learned': learned,
    'tracker': loop._returns.seen,
  }
  del first[1]['ranks']
  try:
    other.restore(*first)
  except ValueError as error:
    found['error'] = str(error)
  loop.network.log_std.data += 0.1 * ranks.rank
  try:
    loop.state()
  except ValueError as error:
    found['apart'] = str(error)
  return found


def _leave(ranks: distributed.Communicator) -> str:
  """One rank dies, the other learns of it."""
  if ranks.rank == 1:
    return ''
  try:
    while True:
      ranks.average([torch.zeros(3)])
  except ConnectionError as error:
    return str(error)


def _rank(rank: int, port: int, path: pathlib.Path) -> None:
  """Runs the operations of one process; writes the results."""
  torch.set_num_threads(1)
  os.environ.update(
    RANK=str(rank),
    WORLD_SIZE=str(_RANKS),
    MASTER_ADDR='127.0.0.1',
    MASTER_PORT=str(port),
  )
  with distributed.connect() as ranks:
    found = {
      'who': (ranks.rank, ranks.size),
      'operations': _operations(ranks),
      'threads': _in_two_threads(ranks),
      'all': _learn(ranks, 'all'),
      'mode': _learn(ranks, 'mode'),
      'diverge': _diverge(ranks),
      'train': _train(ranks),
      'leave': _leave(ranks),
    }
    torch.save(found, path)
    os._exit(0)  # As if it had died.


@pytest.fixture(scope='module')
def found(tmp_path_factory: pytest.TempPathFactory) -> list[_Found]:
  """Returns the results of two ranks."""
  with socket.socket() as server:
    server.bind(('127.0.0.1', 0))
    port = server.getsockname()[1]
  folder = tmp_path_factory.mktemp('ranks')
  context = multiprocessing.get_context('spawn')
  processes = [
    context.Process(target=_rank, args=(rank, port, folder / str(rank)))
    for rank in range(_RANKS)
  ]
  try:
    for process in processes:
      process.start()
    for process in processes:
      process.join(_TIMEOUT)
    assert [process.exitcode for process in processes] == [0, 0]
  finally:
    for process in processes:
      process.kill()
  return [
    torch.load(folder / str(rank), weights_only=False) for rank in range(_RANKS)
  ]


def test_operations(found: list[_Found]) -> None:
  assert [one['who'] for one in found] == [(0, 2), (1, 2)]
  values = torch.cat([torch.arange(3.0) ** 2, torch.arange(7.0) ** 2])
  for rank, one in enumerate(found):
    seen = one['operations']
    assert torch.equal(seen['average'][0], torch.full((2, 2), 1.5))
    assert float(seen['average'][1]) == 2.0
    assert float(seen['broadcast'][0]) == 7.0
    number, mean, std = seen['moments']
    assert number == 10
    torch.testing.assert_close(mean, values.mean())
    torch.testing.assert_close(std, values.std())
    assert seen['few'] == (1, 3.0, 0.0)
    assert seen['any'] == (False, True, True)
    assert torch.equal(seen['gather'], torch.ones(2, 3))
    assert seen['collect'] == ([b'a', b'ab'] if rank == 0 else [])
    assert seen['scatter'] == (b'first' if rank == 0 else b'')
    assert seen['from_first']['good'] == 'text'
  assert 'no such run' in found[0]['operations']['from_first']['bad']
  assert 'ValueError' in found[1]['operations']['from_first']['bad']


def test_threads_do_not_disturb_each_other(found: list[_Found]) -> None:
  for one in found:
    assert one['threads'] == pytest.approx([30000.0, 300.0])


@pytest.mark.parametrize('advantages', ['all', 'mode'])
def test_ranks_learn_what_one_process_would(
  found: list[_Found], advantages: str
) -> None:
  alone, metrics = _learn(distributed.LOCAL, advantages)
  mine, theirs = (one[advantages] for one in found)
  assert mine[1] == theirs[1]
  for key, value in alone.items():
    assert torch.equal(mine[0][key], theirs[0][key]), key
    torch.testing.assert_close(mine[0][key], value, rtol=1e-4, atol=1e-5)
  # The KL is of other samples: every eighth, of each rank.
  for key in metrics.keys() - {'kl'}:
    assert mine[1][key] == pytest.approx(metrics[key], rel=1e-3, abs=1e-4), key


def test_all_learn_that_one_has_diverged(found: list[_Found]) -> None:
  for one in found:
    assert 'not finite' in one['diverge']['error']
    before, after = one['diverge']['before'], one['diverge']['after']
    for key, value in before.items():
      if key.startswith('learner/'):
        assert torch.equal(torch.as_tensor(value), after[key]), key


def test_training_of_two(found: list[_Found]) -> None:
  mine, theirs = (one['train'] for one in found)
  assert mine['stopped'] == theirs['stopped'] == (3, 1)
  state, values = mine['state']
  assert values == {'steps': 256, 'iterations': 8, 'ranks': 2}
  # Both know all episodes, by time; minibatches and noise are their own.
  np.testing.assert_array_equal(mine['learned'], theirs['learned'])
  assert mine['learned'][0].tolist() == (4 * [0] + 4 * [1]) * 32
  assert mine['tracker'].tolist() == [[128, 0], [0, 128]]
  for key in ('actor/generator', 'learner/generator'):
    assert not torch.equal(state[key], state[f'rank1/{key}']), key
  for key, value in theirs['state'][0].items():
    own = key.startswith(('actor', 'environment')) or 'generator' in key
    name = f'rank1/{key}' if own else key
    assert torch.equal(torch.as_tensor(value), state[name]), key


def test_two_go_on_bit_for_bit(found: list[_Found]) -> None:
  for one in found:
    expected, again = one['train']['state'][0], one['train']['again']
    assert expected.keys() == again.keys()
    for key, value in expected.items():
      assert torch.equal(value, again[key]), key
  assert 'of 1 processes, this run has 2' in found[0]['train']['error']
  assert found[1]['train']['error'] == 'Rank 0 has failed.'


def test_ranks_that_have_come_apart_or_are_gone(found: list[_Found]) -> None:
  for one in found:
    assert 'no longer hold the same network' in one['train']['apart']
  assert 'Rank 0 has lost the others' in found[0]['leave']


# One process alone, and what needs no other.


def test_local_operations_are_identities() -> None:
  alone, values = distributed.LOCAL, torch.tensor([1.0, 2.0, 4.0])
  assert alone.split() is alone and (alone.rank, alone.size) == (0, 1)
  alone.average([values])
  alone.broadcast([values])
  assert values.tolist() == [1.0, 2.0, 4.0]
  assert alone.gather(values) is values
  assert alone.moments(values) == (3, values.mean(), values.std())
  assert alone.any(True, False) == (True, False)
  assert alone.collect(b'a') == [alone.scatter([b'a'])] == [b'a']
  assert distributed.from_first(alone, lambda: '') == ''
  with pytest.raises(OSError, match='absent'):
    distributed.from_first(alone, lambda: open('absent').read())
  # So is torchrun of one process.
  with mock.patch.dict(os.environ, WORLD_SIZE='1', RANK='0'):
    with distributed.connect() as communicator:
      assert communicator is distributed.LOCAL


def test_seeds_of_ranks() -> None:
  assert distributed.rank_seed(3, 0) == 3
  seeds = [distributed.rank_seed(s, r) for s in (0, 1) for r in range(100)]
  assert len(set(seeds)) == 200
  assert all(0 <= seed < 2**32 for seed in seeds)


def test_no_cuda_device() -> None:
  assert distributed.find_device('cpu') == torch.device('cpu')
  with mock.patch.object(torch.cuda, 'is_available', return_value=False):
    with pytest.raises(ValueError, match='--device=cuda: .* finds 0'):
      distributed.find_device('cuda')


def test_cores_are_shared_on_a_machine() -> None:
  with mock.patch.object(os, 'cpu_count', return_value=8):
    assert distributed.local_cores() == 8
    for processes, cores in (('4', 2), ('16', 1)):
      with mock.patch.dict(os.environ, LOCAL_WORLD_SIZE=processes):
        assert distributed.local_cores() == cores
