"""Learners to compare, behind one interface: ours, and those of libraries.

Each brings its own loop, its own storage and its own update; what they share is
the task, networks of the same size and initial weights, and every
hyperparameter that they know. What a library does by default and ours does not,
or the reverse, stays:

- rsl_rl clips the value loss, adapts the learning rate in every minibatch, and
  bootstraps a time limit from the value of the last state but one (its issue
  151).
- Stable-Baselines3 has no schedule for the learning rate, normalises advantages
  by minibatch, and has no floor for the standard deviation.
- Ours fits policy and value function apart, each with its own bound on the
  gradient's norm.
- Ours alone keeps the standard deviation below where it begins, and lowers its
  bounds (`std_floor`).

`rsl_rl_gru` is rsl_rl's with a recurrent layer before each of the two networks,
as many units as their first hidden layer.
"""

import contextlib
import importlib
import time
from typing import Any, Callable, Iterator
from unittest import mock

import numpy as np
import torch
from torch import nn

from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import learning
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library

OURS = 'ours'
# Of the libraries, which add the two losses up; ours are fitted apart.
VALUE_COEFFICIENT = 0.5
# Name -> module and class.
_LIBRARIES = {
  'rsl_rl': ('benchmarks.learning.rsl_rl_learner', 'Learner'),
  'sb3': ('benchmarks.learning.sb3_learner', 'Learner'),
  'rsl_rl_gru': ('benchmarks.learning.rsl_rl_learner', 'RecurrentLearner'),
}
NAMES = (OURS, *_LIBRARIES)
ALIKE = NAMES[:3]  # With networks and initial weights that are the same.

Methods = tuple[tuple[Any, str], ...]


class Learner:
  """Learns on worlds of its own.

  Attributes:
    update: classes and names of the methods that are called between the last
      step of a rollout and the first of the next.
    environment: those worlds; mode_set: their modes.
    network: its initial weights.
    threads: of torch's, for each operation.
  """

  update: Methods = ()

  def __init__(self, run: setup.Run, reward_scale: float):
    """Learns in the worlds of `run`; libraries get rewards scaled."""
    del reward_scale
    self.environment, self.network = run.environment, run.network
    self.mode_set, self.threads = run.environment.mode_set, run.config.threads

  def iterate(self) -> None:
    """Collects one rollout of every world and learns from it."""
    raise NotImplementedError

  def begin_episodes(self) -> None:
    """Forgets what went before episodes that begin together, if anything."""

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    """Returns mean actions, rad, [B, A] for float32 [B, D], none privileged."""
    raise NotImplementedError


class Ours(Learner):
  """This package's PPO."""

  update: Methods = ((learning.PPOLearner, 'step'),)

  def __init__(self, run: setup.Run, reward_scale: float):
    super().__init__(run, reward_scale)
    self._loop, self._policy = run.loop, run.policy()
    self.threads = torch.get_num_threads()  # As `setup.build` left them.

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    return self._policy.select_action(observations)

  def iterate(self) -> None:
    length = runner.TrainingConfig(steps=self._loop.steps + 1)
    self._loop.run(length, loggers.Dispatcher([]), save=lambda: None)


def make(
  name: str, config: run_config.RunConfig, scale_rewards: bool = True
) -> Learner:
  """Returns the learner `name` of `NAMES`, with worlds of its own.

  Args:
    name: of the learner.
    config: task, hyperparameters and seed.
    scale_rewards: whether libraries get rewards times 1 - gamma, as our learner
      does by itself: values are then mean rewards, and what depends on their
      scale (weight and clip of the value loss, bound on the gradient) means the
      same to all. Nobody's rewards are normalised.

  Raises:
    ValueError: there is no such learner.
    ModuleNotFoundError: its library is not installed.
  """
  if name not in NAMES:
    raise ValueError(f'Unknown learner {name!r}; there is: {", ".join(NAMES)}.')
  run = setup.build(config, library.mode_set(config.modes))
  kind: Any = Ours
  if name != OURS:
    module, class_name = _LIBRARIES[name]
    kind = getattr(importlib.import_module(module), class_name)
  learner: Learner = kind(run, 1 - config.ppo.discount if scale_rewards else 1)
  return learner


def iterate(learner: Learner) -> None:
  """Runs one iteration of `learner` on its number of threads."""
  torch.set_num_threads(learner.threads)
  learner.iterate()


def missing(error: ModuleNotFoundError) -> ModuleNotFoundError:
  """Returns an error that says how to get a library's missing module."""
  return ModuleNotFoundError(
    f'{error.name} is not installed: pip install dmc_multimode[bench]',
    name=error.name,
  )


@torch.no_grad()
def copy_linears(source: nn.Module, *targets: nn.Module) -> None:
  """Copies weights of linear layers, in order, to those of all `targets`."""
  found, wanted = (
    [x for part in parts for x in part.modules() if isinstance(x, nn.Linear)]
    for parts in ((source,), targets)
  )
  for old, new in zip(found, wanted, strict=True):
    new.weight.copy_(old.weight)
    new.bias.copy_(old.bias)


@contextlib.contextmanager
def timing(methods: Methods) -> Iterator[list[float]]:
  """Collects the seconds of every call of methods of classes."""
  spent: list[float] = []

  def timed(method: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
      began = time.perf_counter()
      try:
        return method(*args, **kwargs)
      finally:
        spent.append(time.perf_counter() - began)

    return call

  with contextlib.ExitStack() as stack:
    for owner, name in methods:
      method = timed(getattr(owner, name))
      stack.enter_context(mock.patch.object(owner, name, method))
    yield spent
