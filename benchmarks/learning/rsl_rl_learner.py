"""Learns by rsl_rl's PPO on BatchedImitation; needs the extra `bench`."""

# Optional, and without type information of its own.
# mypy: disable-error-code="import-not-found,import-untyped"

import contextlib
import io
from typing import Any

import numpy as np
import torch

from benchmarks.learning import learners
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.experiments import setup

try:
  from rsl_rl import algorithms
  from rsl_rl import models
  from rsl_rl import modules
  from rsl_rl import runners
  import tensordict

  from dmc_multimode.suite.wrappers import rsl_rl_env
except ModuleNotFoundError as error:
  raise learners.missing(error) from None

_DEVICE = 'cpu'
_ACTIVATIONS = {'silu': 'swish'}  # Where it has another name for one.
_MAX_STD = 1e6  # Radians; none.


def settings(
  ppo: ppo_config.PPOConfig, groups: list[str], recurrent: bool = False
) -> dict[str, Any]:
  """Returns the runner's configuration.

  Args:
    ppo: our hyperparameters.
    groups: of observations, the policy's first; the critic sees all.
    recurrent: whether a GRU comes before each network.
  """
  network = {
    'class_name': models.MLPModel,
    'hidden_dims': list(ppo.hidden_sizes),
    'activation': _ACTIVATIONS.get(ppo.activation, ppo.activation),
    'obs_normalization': True,
  }
  if recurrent:
    network |= {
      'class_name': models.RNNModel,
      'rnn_type': 'gru',
      'rnn_hidden_dim': ppo.hidden_sizes[0],
    }
  distribution = {
    'class_name': modules.GaussianDistribution,
    'init_std': ppo.initial_std,
    'std_range': (ppo.std_floor.first, _MAX_STD),
    'std_type': 'log',
    'learn_std': ppo.learn_std,
  }
  algorithm = {
    'class_name': algorithms.PPO,
    'num_learning_epochs': ppo.epochs,
    'num_mini_batches': ppo.minibatches,
    'clip_param': ppo.clip,
    'gamma': ppo.discount,
    'lam': ppo.gae_lambda,
    'value_loss_coef': learners.VALUE_COEFFICIENT,
    'entropy_coef': ppo.entropy_coefficient,
    'learning_rate': ppo.learning_rate,
    'max_grad_norm': ppo.max_gradient_norm,
    'schedule': 'adaptive' if ppo.target_kl else 'fixed',
    'desired_kl': ppo.target_kl or None,
  }
  return {
    'num_steps_per_env': ppo.rollout_length,
    'obs_groups': {'actor': groups[:1], 'critic': groups},
    'algorithm': algorithm,
    'actor': {**network, 'distribution_cfg': distribution},
    'critic': network,
  }


class Learner(learners.Learner):
  """See `learners.Learner`."""

  update: learners.Methods = (
    (algorithms.PPO, 'compute_returns'),
    (algorithms.PPO, 'update'),
  )
  _recurrent = False

  def __init__(self, run: setup.Run, reward_scale: float):
    """Learns in the worlds of `run`, from its weights on."""
    super().__init__(run, reward_scale)
    environment, network = run.environment, run.network
    ppo, seed = run.config.ppo, run.config.seed
    worlds = rsl_rl_env.RslRlVecEnv(environment, reward_scale)
    groups = [str(name) for name in worlds.get_observations().keys()]
    torch.manual_seed(seed)  # Of the exploration and the minibatches.
    with contextlib.redirect_stdout(io.StringIO()):  # It prints its networks.
      self.runner = runners.OnPolicyRunner(
        worlds, settings(ppo, groups, self._recurrent), device=_DEVICE
      )
    if not self._recurrent:
      learners.copy_linears(network.policy, self.runner.alg.actor)
      learners.copy_linears(network.value, self.runner.alg.critic)

  def iterate(self) -> None:
    self.runner.learn(1)

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    return _act(self.runner.get_inference_policy(), observations)


class RecurrentLearner(Learner):
  """The same with a GRU before each network."""

  _recurrent = True
  _memory: torch.Tensor | None = None

  def begin_episodes(self) -> None:
    self._memory = None

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    actor = self.runner.get_inference_policy()
    # Its own memory is of the episodes of the training, which go on.
    of_training = actor.rnn.hidden_state
    actor.rnn.hidden_state = self._memory
    actions = _act(actor, observations)
    self._memory = actor.rnn.hidden_state
    actor.rnn.hidden_state = of_training
    return actions


@torch.no_grad()
def _act(actor: Any, observations: np.ndarray) -> np.ndarray:
  seen = tensordict.TensorDict(
    {rsl_rl_env.POLICY: torch.from_numpy(observations)},
    batch_size=[len(observations)],
  )
  return actor(seen).numpy()
