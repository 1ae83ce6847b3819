"""Tests of dmc_multimode.agents.ppo.losses."""

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np
import torch
from torch import distributions

from dmc_multimode.agents.ppo import losses
from dmc_multimode.agents.ppo import networks

_FALSE = (False, False, False)


def _column(*values: float) -> torch.Tensor:
  """T steps of one world, [T, 1]."""
  return torch.tensor(values, dtype=torch.float64)[:, None]


def _by_returns(
  rewards: np.ndarray,
  values: np.ndarray,
  next_values: np.ndarray,
  discounts: np.ndarray,
  last: np.ndarray,
  gae_lambda: float,
) -> np.ndarray:
  """GAE by its definition: a geometric mean of n-step returns, [T] each."""
  advantages = np.empty_like(values)
  for t in range(len(values)):
    ends = np.flatnonzero(last[t:])
    steps = ends[0] + 1 if len(ends) else len(values) - t
    returns = []
    for n in range(1, steps + 1):
      factors = np.concatenate([[1.0], np.cumprod(discounts[t : t + n])])
      returns.append(
        np.sum(factors[:-1] * rewards[t : t + n])
        + factors[-1] * next_values[t + n - 1]
      )
    weights = (1 - gae_lambda) * gae_lambda ** np.arange(steps)
    weights[-1] = gae_lambda ** (steps - 1)
    advantages[t] = np.dot(weights, returns) - values[t]
  return advantages


class AdvantagesTest(parameterized.TestCase):
  """gamma = lambda = 0.5; the errors are 1, 1.75 and 2.5 without an end."""

  @parameterized.named_parameters(
    ('no_end', (0.5, 0.5, 0.5), _FALSE, (1.59375, 2.375, 2.5)),
    ('terminated', (0.5, 0.0, 0.5), (False, True, False), (1.25, 1.0, 2.5)),
    # Bootstrapped from what was seen last, and nothing flows across.
    ('time', (0.5, 0.5, 0.5), (False, True, False), (1.4375, 1.75, 2.5)),
    ('time_at_the_end', (0.5, 0.5, 0.5), (False, False, True), None),
  )
  def test_by_hand(
    self,
    discounts: tuple[float, ...],
    last: tuple[bool, ...],
    expected: tuple[float, ...] | None,
  ) -> None:
    found = losses.generalised_advantages(
      _column(1.0, 2.0, 3.0),
      _column(0.5, 1.0, 1.5),
      _column(1.0, 1.5, 2.0),
      _column(*discounts),
      torch.tensor(last)[:, None],
      0.5,
    )
    expected = expected or (1.59375, 2.375, 2.5)
    self.assertEqual(tuple(found[:, 0].tolist()), expected)

  @parameterized.parameters(0.0, 0.3, 0.95, 1.0)
  def test_is_a_mean_of_n_step_returns(self, gae_lambda: float) -> None:
    rng = np.random.RandomState(0)
    shape = (24, 40)
    rewards, values, next_values = rng.standard_normal((3, *shape))
    last = rng.uniform(size=shape) < 0.2
    terminated = last & (rng.uniform(size=shape) < 0.5)
    discounts = 0.97 * ~terminated
    # Within an episode the value after a step is the one before the next.
    next_values[:-1] = np.where(last[:-1], next_values[:-1], values[1:])
    found = losses.generalised_advantages(
      torch.from_numpy(rewards),
      torch.from_numpy(values),
      torch.from_numpy(next_values),
      torch.from_numpy(discounts),
      torch.from_numpy(last),
      gae_lambda,
    )
    for world in range(shape[1]):
      expected = _by_returns(
        rewards[:, world],
        values[:, world],
        next_values[:, world],
        discounts[:, world],
        last[:, world],
        gae_lambda,
      )
      np.testing.assert_allclose(found[:, world], expected, atol=1e-12)


class NormalisedTest(parameterized.TestCase):
  def test_by_hand(self) -> None:
    found = losses.normalised(torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(found, torch.tensor([-1.0, 0.0, 1.0]))

  def test_each_group_by_itself(self) -> None:
    advantages = torch.tensor([1.0, 40.0, 2.0, 20.0, 3.0, 7.0])
    kept = advantages.clone()
    groups = torch.tensor([5, 0, 5, 0, 5, 2])
    found = losses.normalised(advantages, groups)
    # Of two, half of their difference over the difference by sqrt 2; of one,
    # nothing is known.
    half = 0.5**0.5
    expected = torch.tensor([-1.0, half, 0.0, -half, 1.0, 0.0])
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(advantages, kept, rtol=0.0, atol=0.0)

  def test_one_group_is_no_group(self) -> None:
    advantages = torch.randn(20, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
      losses.normalised(advantages, torch.full((20,), 3)),
      losses.normalised(advantages),
    )

  def test_equal_advantages_stay_finite(self) -> None:
    for groups in (None, torch.tensor([0, 0, 1, 1])):
      found = losses.normalised(torch.full((4,), 7.0), groups)
      torch.testing.assert_close(found, torch.zeros(4))

  def test_every_sample_alone(self) -> None:
    found = losses.normalised(torch.tensor([3.0, -4.0]), torch.tensor([1, 0]))
    torch.testing.assert_close(found, torch.zeros(2))


class LossesTest(parameterized.TestCase):
  @parameterized.parameters(
    # ratio, advantage, surrogate, whether the policy is still moved by it.
    (1.5, 1.0, 1.2, False),
    (0.5, 1.0, 0.5, True),
    (1.5, -1.0, -1.5, True),
    (0.5, -1.0, -0.8, False),
    (1.1, 2.0, 2.2, True),
    (0.9, -2.0, -1.8, True),
  )
  def test_clipped_surrogate(
    self, ratio: float, advantage: float, surrogate: float, moves: bool
  ) -> None:
    log_prob = torch.tensor([np.log(ratio) - 3.0], requires_grad=True)
    loss, outside = losses.surrogate_loss(
      log_prob, torch.tensor([-3.0]), torch.tensor([advantage]), clip=0.2
    )
    self.assertAlmostEqual(loss.item(), -surrogate, places=5)
    self.assertEqual(outside.item(), float(abs(ratio - 1) > 0.2))
    (gradient,) = torch.autograd.grad(loss, log_prob)
    expected = -ratio * advantage if moves else 0.0
    self.assertAlmostEqual(gradient.item(), expected, places=5)

  def test_means_over_the_batch(self) -> None:
    loss, outside = losses.surrogate_loss(
      torch.log(torch.tensor([1.5, 0.5, 1.1])),
      torch.zeros(3),
      torch.tensor([1.0, 1.0, 1.0]),
      clip=0.2,
    )
    self.assertAlmostEqual(loss.item(), -(1.2 + 0.5 + 1.1) / 3, places=6)
    self.assertAlmostEqual(outside.item(), 2 / 3, places=6)


class GaussianTest(parameterized.TestCase):
  """Against torch.distributions."""

  def setUp(self) -> None:
    super().setUp()
    generator = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(
      *shape, generator=generator, dtype=torch.float64
    )
    self.mean, self.new_mean, self.action = normal(3, 7, 5)
    self.std, self.new_std = normal(2, 5).exp()

  def _distribution(
    self, mean: torch.Tensor, std: torch.Tensor
  ) -> distributions.Distribution:
    return distributions.Independent(distributions.Normal(mean, std), 1)

  def test_log_prob(self) -> None:
    expected = self._distribution(self.mean, self.std).log_prob(self.action)
    found = networks.log_prob(self.action, self.mean, self.std)
    torch.testing.assert_close(found, expected)

  def test_entropy(self) -> None:
    expected = self._distribution(self.mean, self.std).entropy()[0]
    torch.testing.assert_close(networks.entropy(self.std), expected)

  def test_kl_divergence(self) -> None:
    expected = distributions.kl_divergence(
      self._distribution(self.mean, self.std),
      self._distribution(self.new_mean, self.new_std),
    )
    found = networks.kl_divergence(
      self.mean, self.std, self.new_mean, self.new_std
    )
    torch.testing.assert_close(found, expected)


if __name__ == '__main__':
  absltest.main()
