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
import functools
import importlib
import time
from typing import Any, Callable, Iterator, Protocol

import numpy as np
import torch
from torch import nn

from dmc_multimode.agents import loggers
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import learning
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import setup
from dmc_multimode.modes import library
from dmc_multimode.suite.imitation import batched_env

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


class Learner(Protocol):
  """Something that learns on worlds of its own.

  Attributes:
    environment: those worlds.
    update: classes and names of the methods that are called between the last
      step of a rollout and the first of the next.
    threads: of torch's, for each operation.
  """

  environment: batched_env.BatchedImitation
  update: Methods
  threads: int

  def iterate(self) -> None:
    """Collects one rollout of every world and learns from it."""

  def begin_episodes(self) -> None:
    """Resets memory, before the first action of all episodes."""

  def select_action(self, observations: np.ndarray) -> np.ndarray:
    """Returns mean actions, rad, [B, A] for float32 [B, D], none privileged."""


class Ours:
  """This package's PPO."""

  update: Methods = ((learning.PPOLearner, 'step'),)

  def __init__(self, run: setup.Run):
    self._loop = run.loop
    self.environment = run.environment
    self.network = run.network
    self.select_action = run.policy().select_action
    self.threads = torch.get_num_threads()  # As `setup.build` left them.

  def begin_episodes(self) -> None:
    """Does nothing: the policy has no memory."""

  def iterate(self) -> None:
    """See `Learner`."""
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
  if name == OURS:
    return Ours(run)
  module, kind = _LIBRARIES[name]
  scale = 1 - config.ppo.discount if scale_rewards else 1.0
  learner: Learner = getattr(importlib.import_module(module), kind)(
    run.environment, run.network, config.ppo, config.seed, scale
  )
  learner.threads = config.threads
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
    [
      layer
      for module in modules
      for layer in module.modules()
      if isinstance(layer, nn.Linear)
    ]
    for modules in ((source,), targets)
  )
  for old, new in zip(found, wanted, strict=True):
    new.weight.copy_(old.weight)
    new.bias.copy_(old.bias)


@contextlib.contextmanager
def timing(methods: Methods) -> Iterator[list[float]]:
  """Collects the seconds of every call of `methods` while it is open.

  Args:
    methods: classes, each with the name of a method that it defines.
  """
  spent: list[float] = []
  with contextlib.ExitStack() as stack:
    for owner, name in methods:
      method = getattr(owner, name)
      stack.callback(setattr, owner, name, method)
      setattr(owner, name, _timed(method, spent))
    yield spent


def _timed(
  method: Callable[..., Any], spent: list[float]
) -> Callable[..., Any]:
  @functools.wraps(method)
  def call(*args: Any, **kwargs: Any) -> Any:
    began = time.perf_counter()
    try:
      return method(*args, **kwargs)
    finally:
      spent.append(time.perf_counter() - began)

  return call
