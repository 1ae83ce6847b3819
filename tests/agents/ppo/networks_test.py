"""Tests of dmc_multimode.agents.ppo.networks."""

from typing import Callable

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np
import torch

from dmc_multimode.agents.ppo import networks


class NormaliserTest(parameterized.TestCase):
  def test_is_the_identity_at_first(self) -> None:
    observation = torch.tensor([[0.5, -2.0, 3.0]])
    found = networks.Normaliser(3)(observation)
    torch.testing.assert_close(found, observation, rtol=1e-4, atol=0.0)

  def test_running_moments_are_numpys(self) -> None:
    rng = np.random.RandomState(0)
    scale, offset = np.array([0.1, 1.0, 30.0]), np.array([5.0, 0.0, -100.0])
    batches = [
      (offset + scale * (rng.standard_normal((n, 3)) + i)).astype(np.float32)
      for i, n in enumerate((1, 64, 7, 500, 32))
    ]
    normaliser = networks.Normaliser(3)
    for batch in batches:
      normaliser.update(torch.from_numpy(batch))
    seen = np.concatenate(batches).astype(np.float64)
    np.testing.assert_allclose(normaliser.mean, seen.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(normaliser.variance, seen.var(axis=0), rtol=1e-4)
    self.assertEqual(normaliser.count.item(), len(seen))
    np.testing.assert_allclose(
      normaliser(torch.from_numpy(batches[3])),
      (batches[3] - seen.mean(axis=0)) / np.sqrt(seen.var(axis=0) + 1e-4),
      atol=1e-3,
    )

  def test_constants_and_outliers_stay_bounded(self) -> None:
    normaliser = networks.Normaliser(2)
    normaliser.update(torch.tensor([[1.0, 0.0], [1.0, 1.0]]))
    found = normaliser(torch.tensor([[1.0, 0.5], [1.001, 1e9], [1.0, -1e9]]))
    expected = torch.tensor([[0.0, 0.0], [0.1, 8.0], [0.0, -8.0]])
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0.0)

  def test_observations_are_left_alone(self) -> None:
    observation = torch.tensor([[100.0]])
    normaliser = networks.Normaliser(1)
    normaliser(observation)
    normaliser.update(observation)
    self.assertEqual(observation.item(), 100.0)


class ActorCriticTest(parameterized.TestCase):
  def test_initial_action(self) -> None:
    action = np.linspace(-1.0, 1.0, 3)
    network = networks.ActorCritic(6, 3, (32, 16), initial_action=action)
    observation = torch.randn(
      100, 6, generator=torch.Generator().manual_seed(0)
    )
    found = network.act(observation).detach().numpy()
    np.testing.assert_allclose(found, np.tile(action, (100, 1)), atol=0.1)
    self.assertGreater(found.std(axis=0).min(), 0.0)

  def test_initial_action_is_zero_by_default(self) -> None:
    network = networks.ActorCritic(6, 3, (32,))
    self.assertLess(network.act(torch.ones(1, 6)).abs().max().item(), 0.1)

  def test_orthogonal_initialisation(self) -> None:
    network = networks.ActorCritic(12, 3, (10, 8))
    policy = networks.linears_of(network.policy)
    value = networks.linears_of(network.value)
    self.assertEqual([linear.out_features for linear in policy], [10, 8, 3])
    self.assertEqual([linear.out_features for linear in value], [10, 8, 1])
    for linears, output_gain in ((policy, 0.01), (value, 1.0)):
      for linear, gain in zip(
        linears, (2**0.5, 2**0.5, output_gain), strict=True
      ):
        # Every layer narrows, so that its rows are orthogonal.
        rows = linear.weight @ linear.weight.T
        expected = gain**2 * torch.eye(len(rows))
        torch.testing.assert_close(rows, expected, atol=1e-5, rtol=0.0)
        self.assertFalse(linear.bias.any())

  def test_hidden_layers_are_not_linear(self) -> None:
    network = networks.ActorCritic(1, 1, (4,))
    one, two = (network.value(torch.tensor([x])).item() for x in (1.0, -1.0))
    self.assertNotAlmostEqual(one, -two, places=3)

  @parameterized.parameters(
    ('elu', torch.nn.functional.elu),
    ('silu', torch.nn.functional.silu),
    ('tanh', torch.tanh),
  )
  def test_activation(
    self, name: str, function: Callable[[torch.Tensor], torch.Tensor]
  ) -> None:
    network = networks.ActorCritic(5, 2, (4, 3), activation=name)
    self.assertEqual(network.activation, name)
    observation = torch.randn(6, 5)
    for perceptron in (network.policy, network.value):
      first, second, output = networks.linears_of(perceptron)
      expected = output(function(second(function(first(observation)))))
      torch.testing.assert_close(perceptron(observation), expected)

  def test_std(self) -> None:
    network = networks.ActorCritic(2, 3, (4,), initial_std=0.25)
    torch.testing.assert_close(network.std, torch.full((3,), 0.25))
    with torch.no_grad():
      network.log_std.copy_(torch.log(torch.tensor([0.02, 0.1, 0.7])))
    network.bound_std(0.1, 0.5)
    torch.testing.assert_close(network.std, torch.tensor([0.1, 0.1, 0.5]))


class PrivilegedTest(parameterized.TestCase):
  """Four numbers for the policy, and three more for the value."""

  def setUp(self) -> None:
    super().setUp()
    torch.manual_seed(0)
    self.network = networks.ActorCritic(4, 2, (8,), privileged_size=3)
    # Statistics that would show if those of other numbers were taken.
    scale = torch.tensor([0.1, 1.0, 5.0, 2.0, 30.0, 0.3, 7.0])
    self.network.normaliser.update(3 * scale + scale * torch.randn(200, 7))
    self.observation = 3 * scale + scale * torch.randn(50, 7)
    self.other = self.observation.clone()
    self.other[:, 4:] = torch.randn(50, 3)

  def test_sizes(self) -> None:
    self.assertEqual(self.network.observation_size, 4)
    self.assertEqual(self.network.privileged_size, 3)
    self.assertEqual(networks.linears_of(self.network.policy)[0].in_features, 4)
    self.assertEqual(networks.linears_of(self.network.value)[0].in_features, 7)
    self.assertEqual(self.network.normaliser.mean.shape, (7,))

  @torch.no_grad()
  def test_acting_does_without(self) -> None:
    expected = self.network.act(self.observation)
    self.assertGreater(expected.std().item(), 0.0)
    for seen in (self.other, self.observation[:, :4]):
      torch.testing.assert_close(
        self.network.act(seen), expected, rtol=0.0, atol=0.0
      )
    self.other[:, 4:] = np.nan
    torch.testing.assert_close(
      self.network.act(self.other), expected, rtol=0.0, atol=0.0
    )

  @torch.no_grad()
  def test_acting_depends_on_all_that_the_policy_sees(self) -> None:
    expected = self.network.act(self.observation)
    for i in range(4):
      seen = self.observation.clone()
      seen[:, i] += 1.0
      self.assertFalse(torch.equal(self.network.act(seen), expected), i)

  @torch.no_grad()
  def test_mean_of_what_is_normalised(self) -> None:
    seen = self.network.normaliser(self.observation)
    torch.testing.assert_close(
      self.network.mean(seen), self.network.act(self.observation)
    )
    by_hand = self.network.policy(seen[:, :4])
    torch.testing.assert_close(
      self.network.mean(seen), by_hand, rtol=0.0, atol=0.0
    )

  @torch.no_grad()
  def test_value_sees_everything(self) -> None:
    expected = self.network.values(self.network.normaliser(self.observation))
    self.assertEqual(expected.shape, (50,))
    for i in range(7):
      seen = self.observation.clone()
      seen[:, i] += 1.0
      values = self.network.values(self.network.normaliser(seen))
      self.assertFalse(torch.equal(values, expected), i)

  @torch.no_grad()
  def test_leading_axes(self) -> None:
    rollout = self.observation.unflatten(0, (5, 10))
    seen = self.network.normaliser(rollout)
    self.assertEqual(self.network.values(seen).shape, (5, 10))
    self.assertEqual(self.network.mean(seen).shape, (5, 10, 2))
    torch.testing.assert_close(
      self.network.act(rollout).flatten(0, 1),
      self.network.act(self.observation),
    )

  def test_nothing_privileged_by_default(self) -> None:
    network = networks.ActorCritic(4, 2, (8,))
    self.assertEqual(network.privileged_size, 0)
    self.assertEqual(networks.linears_of(network.value)[0].in_features, 4)

  def test_normaliser_of_the_first_numbers(self) -> None:
    normaliser = self.network.normaliser
    whole = normaliser(self.observation)
    torch.testing.assert_close(
      normaliser(self.observation[:, :4]), whole[:, :4], rtol=0.0, atol=0.0
    )


if __name__ == '__main__':
  absltest.main()
