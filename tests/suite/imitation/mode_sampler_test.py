"""Tests of dmc_multimode.suite.imitation.mode_sampler."""

from typing import Any

import hypothesis
from hypothesis.extra import numpy as numpy_strategies
import hypothesis.strategies as st
import numpy as np
import pytest

from dmc_multimode.suite.imitation import mode_sampler

_RETURNS = numpy_strategies.arrays(
  np.float64,
  st.integers(1, 6),
  elements=st.floats(-10, 10, allow_subnormal=False),
)


@pytest.mark.parametrize(
  ('returns', 'epsilon', 'expected'),
  [
    # k = -R = (-1, -3, -2); less the least (2, 0, 1); over the most
    # (1, 0, 0.5); plus epsilon (1.2, 0.2, 0.7); the sum is 2.1.
    ([1.0, 3.0, 2.0], 0.2, [1.2 / 2.1, 0.2 / 2.1, 0.7 / 2.1]),
    # Without epsilon the best mode is never drawn.
    ([0.0, 4.0, 2.0], 0.0, [2 / 3, 0.0, 1 / 3]),
    ([-3.0] * 4, 0.0, [0.25] * 4),
    ([7.5] * 4, 0.2, [0.25] * 4),
    # Rows are independent.
    ([[2.0, 4.25], [5.0, 5.0]], 0.2, [[1.2 / 1.4, 0.2 / 1.4], [0.5, 0.5]]),
  ],
)
def test_probabilities_by_hand(
  returns: list[Any], epsilon: float, expected: list[Any]
) -> None:
  p = mode_sampler.returns_to_probabilities(np.array(returns), epsilon)
  np.testing.assert_allclose(p, expected)


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(returns=_RETURNS, epsilon=st.sampled_from([0.0, 0.01, 1.0]))
def test_poorer_is_likelier(returns: np.ndarray, epsilon: float) -> None:
  p = mode_sampler.returns_to_probabilities(returns, epsilon)
  assert np.all(p >= 0)
  np.testing.assert_allclose(p.sum(), 1.0)
  in_order = p[np.argsort(returns)]
  assert np.all(np.diff(in_order) <= 1e-12)


def _update(
  sampler: mode_sampler.ModeSampler,
  initial: np.ndarray,
  final: np.ndarray,
  returns: np.ndarray,
) -> None:
  sampler.update(initial, final, returns, np.zeros(len(initial), dtype=bool))


def test_failures_are_practised() -> None:
  sampler = mode_sampler.ModeSampler(
    2, mode_sampler.SamplingConfig(kind='failures')
  )
  np.testing.assert_allclose(sampler.initial_probabilities, [0.5, 0.5])
  failed = np.array([True, False, False])
  sampler.update(
    np.array([0, 0, 1]), np.array([1, 0, 0]), np.full(3, 0.5), failed
  )
  assert sampler.counts[0].tolist() == [[1, 1], [1, 0]]
  assert sampler.counts[1].tolist() == [[0, 1], [0, 0]]
  # (0 + 1) / (1 + 2), (1 + 1) / (1 + 2) and, of no episode, 1 / 2.
  bound = lambda share, count: share + np.sqrt(share * (1 - share) / count)
  weights = np.array(
    [[bound(1 / 3, 3), bound(2 / 3, 3)], [bound(1 / 3, 3), bound(1 / 2, 2)]]
  )
  np.testing.assert_allclose(
    sampler.initial_probabilities, weights.sum(axis=1) / weights.sum()
  )
  np.testing.assert_allclose(
    sampler.final_probabilities, weights / weights.sum(axis=1)[:, None]
  )
  one = np.array([0])
  sampler.update(one, one + 1, np.zeros(1), np.array([False]))
  np.testing.assert_allclose(sampler.counts[:, 0, 1], [1.99, 0.99])


def test_update_by_hand() -> None:
  config = mode_sampler.SamplingConfig(gamma_initial=0.5, gamma_final=0.25)
  sampler = mode_sampler.ModeSampler(2, config)
  np.testing.assert_allclose(sampler.initial_probabilities, np.full(2, 0.5))
  np.testing.assert_allclose(sampler.final_probabilities, np.full((2, 2), 0.5))
  _update(sampler, np.array([0, 0]), np.array([1, 0]), np.array([1.0, 2.0]))
  # One after the other: 0.5 (0.5 x 0 + 1) + 2.
  np.testing.assert_allclose(sampler.initial_returns, [2.5, 0.0])
  np.testing.assert_allclose(sampler.final_returns, [[2.0, 1.0], [0.0, 0.0]])
  _update(sampler, np.array([0]), np.array([1]), np.array([4.0]))
  np.testing.assert_allclose(sampler.initial_returns, [5.25, 0.0])
  np.testing.assert_allclose(sampler.final_returns, [[2.0, 4.25], [0.0, 0.0]])
  # Rows of p_f belong to initial modes: (2, 4.25) -> (1, 0) + 0.2.
  np.testing.assert_allclose(
    sampler.final_probabilities, [[1.2 / 1.4, 0.2 / 1.4], [0.5, 0.5]]
  )
  # The uniform baseline learns nothing.
  baseline = mode_sampler.ModeSampler(
    2, mode_sampler.SamplingConfig(kind='uniform')
  )
  _update(baseline, np.array([0]), np.array([1]), np.array([5.0]))
  np.testing.assert_allclose(baseline.initial_probabilities, np.full(2, 0.5))
  np.testing.assert_allclose(baseline.final_probabilities, np.full((2, 2), 0.5))


def test_frequencies() -> None:
  sampler = mode_sampler.ModeSampler(3, mode_sampler.SamplingConfig())
  sampler.initial_returns[:] = [1.0, 3.0, 2.0]
  sampler.final_returns[0] = [0.0, 0.0, 1.0]
  count = 20_000
  initial, final = sampler.sample(count, np.random.RandomState(0))
  frequency = np.bincount(initial, minlength=3) / count
  # Four standard deviations of such a frequency are at most 0.0142.
  np.testing.assert_allclose(
    frequency, sampler.initial_probabilities, atol=0.0142
  )
  after_first = final[initial == 0]
  frequency = np.bincount(after_first, minlength=3) / len(after_first)
  np.testing.assert_allclose(
    frequency, np.array([1.2, 1.2, 0.2]) / 2.6, atol=0.02
  )


def test_state_round_trip() -> None:
  config = mode_sampler.SamplingConfig()
  one, other = (mode_sampler.ModeSampler(3, config) for _ in range(2))
  _update(one, np.array([0, 2]), np.array([1, 1]), np.array([0.3, 0.9]))
  state = one.state()
  other.restore(state)
  _update(one, np.array([1]), np.array([1]), np.array([0.5]))
  # The state is a copy, and the two go their own ways.
  np.testing.assert_array_equal(state['initial_returns'], [0.3, 0.0, 0.9])
  np.testing.assert_array_equal(other.initial_returns, [0.3, 0.0, 0.9])
  _update(other, np.array([1]), np.array([1]), np.array([0.5]))
  np.testing.assert_array_equal(other.final_returns, one.final_returns)
  with pytest.raises(ValueError, match='another mode set'):
    mode_sampler.ModeSampler(4, config).restore(state)


@pytest.mark.parametrize(
  ('values', 'message'),
  [
    ({'gamma_initial': 1.0}, 'gamma_initial'),
    ({'gamma_final': -0.1}, 'gamma_final'),
    ({'epsilon': -0.1}, 'epsilon'),
    ({'focus_fraction': -0.1}, 'a share is in'),
    ({'gait_fraction': 1.1}, 'a share is in'),
  ],
)
def test_config_rejects(values: dict[str, float], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    mode_sampler.SamplingConfig(**values)  # type: ignore[arg-type]
