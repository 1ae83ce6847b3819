"""Tests of dmc_multimode.agents.statistics."""

import numpy as np
import pytest
import torch

from dmc_multimode.agents import distributed
from dmc_multimode.agents import statistics
from tests.agents import toy


def _results(
  *episodes: tuple[int, int, float, int], lengths: tuple[int, ...] = ()
) -> toy.Results:
  """Each (initial, final, return, cause), and lengths that are 0, 1, ..."""
  initial, final, returns, causes = map(np.array, zip(*episodes, strict=True))
  count = np.arange(len(initial))
  taken = np.array(lengths) if lengths else count
  return toy.Results(count, initial, final, returns, taken, causes)


def test_tracker_by_hand() -> None:
  tracker = statistics.ReturnTracker(2, 0.5)
  first = (0, 0, 0.4, 0), (0, 1, 0.8, 0), (0, 0, 0.6, 3)
  tracker.update(_results(*first, lengths=(10, 10, 4)))
  tracker.update(_results((1, 1, 0.2, 1), lengths=(3,)))
  np.testing.assert_allclose(tracker.returns, [[0.5, 0.8], [0.0, 0.2]])
  np.testing.assert_allclose(tracker.survival, [[0.5, 1.0], [0.0, 0.0]])
  np.testing.assert_array_equal(tracker.seen, [[2, 1], [0, 1]])
  found = tracker.summary(('a', 'b'))
  expected = {
    'mra_modes': 0.35,
    'mra_transitions': 0.5,
    'survival': 0.5,
    'seconds': (3.5 + 5.0 + 1.5) / 3,  # No episode went from b to a.
    'worst_transition': 0.2,
    'return/a': 0.5,
    'return/b': 0.2,
    'return/a->b': 0.8,
    'return/b->a': np.nan,  # No such episode has ended.
    'survival/a': 0.5,
    'survival/b': 0.0,
    'seconds/a': 3.5,
    'seconds/b': 1.5,
    'survival/a->b': 1.0,
    'survival/b->a': np.nan,
  }
  assert found == pytest.approx(expected, nan_ok=True)
  unknown = statistics.ReturnTracker(2, 0.5).summary(('a', 'b'))
  assert unknown.keys() == expected.keys()
  assert np.isnan([*unknown.values()]).all()
  tracker = statistics.ReturnTracker(1, 0.5)
  for _ in range(50):
    tracker.update(_results((0, 0, 1.0, 1)))
  tracker.update(_results((0, 0, 0.0, 0)))  # It forgets.
  assert tracker.returns[0, 0] == pytest.approx(0.98)
  assert tracker.survival[0, 0] == pytest.approx(0.02)


def test_a_state_from_before_there_were_seconds() -> None:
  """They begin with the next episode, and not with a mean of nothing."""
  tracker = statistics.ReturnTracker(1, 0.5)
  tracker.update(_results((0, 0, 1.0, 0), lengths=(8,)))
  state = {k: torch.from_numpy(v) for k, v in tracker.state().items()}
  del state['seconds'], state['timed']
  tracker.restore(state)
  assert np.isnan(tracker.summary(('a',))['seconds'])
  tracker.update(_results((0, 0, 0.0, 0), lengths=(4,)))
  assert tracker.summary(('a',))['seconds/a'] == 2.0
  assert tracker.returns[0, 0] == 0.5
  del state['seen']
  with pytest.raises(KeyError, match='seen'):
    tracker.restore(state)


def test_table_is_in_the_order_of_time() -> None:
  table = statistics.EpisodeTable()
  table.add(0, _results((0, 1, 0.5, 0), (1, 1, 0.25, 3)))
  table.add(2, _results((2, 0, 0.75, 1)))
  found = table.gather(distributed.LOCAL)
  assert found.initial.tolist() == [0, 1, 2]
  assert found.final.tolist() == [1, 1, 0]
  assert found.returns.tolist() == [0.5, 0.25, 0.75]
  assert found.causes.tolist() == [0, 3, 1]
  assert found.lengths.tolist() == [0, 1, 0]


def test_some_divergence_is_borne() -> None:
  counter = statistics.DivergenceCounter()
  # A thousandth of 20,000 steps is 20.
  counter.update(20, 10_000)
  counter.update(0, 10_000)  # The window ends.
  counter.update(20, 10_000)
  assert counter.total == 40
  with pytest.raises(FloatingPointError, match='21 worlds .* 10,001'):
    counter.update(1, 1)
