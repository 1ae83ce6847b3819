"""The training loop: collect, learn, log, checkpoint."""

import math
import time
from typing import Any, Callable, Mapping

import torch

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import core as agents_core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import loggers
from dmc_multimode.agents import statistics
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import learning
from dmc_multimode.agents.ppo import networks
from dmc_multimode.agents.ppo import rollouts
from dmc_multimode.utils import arrays
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import constants


@config_lib.dataclass
class TrainingConfig:
  """Length of a training, and intervals of logs and checkpoints.

  Attributes:
    steps: environment steps, summed over all worlds.
    minutes: wall-clock limit of this process.
    log_every: iterations between rows in the logs.
    checkpoint_seconds: longest time between two checkpoints.
    keep_every: environment steps between policies that are kept permanently; 0
      keeps only the last.
  """

  steps: config_lib.PositiveInt = constants.TRAINING_STEPS
  minutes: config_lib.Duration = math.inf
  log_every: config_lib.PositiveInt = 5
  checkpoint_seconds: config_lib.Positive = 60.0
  keep_every: config_lib.Count = 0


class TrainingLoop:
  """Alternates rollouts of all worlds and updates of the networks.

  Of several ranks, each has some of the worlds. They agree on when to stop and
  to save; `run`, `state` and `restore` are collective.

  Attributes:
    iterations: number of iterations so far.
  """

  def __init__(
    self,
    environment: agents_core.TrainingEnvironment,
    actor: acting.BatchedActor,
    learner: learning.PPOLearner,
    rollout_length: int,
    mode_names: tuple[str, ...],
    probabilities: Callable[[], Mapping[str, float]],
    communicator: distributed.Communicator = distributed.LOCAL,
  ):
    """Connects the parts and resets the environment.

    Args:
      environment: B worlds, those of this rank.
      actor: explores in them.
      learner: updates the actor's network.
      rollout_length: control steps per world and iteration.
      mode_names: names of the modes, for the logs.
      probabilities: returns sampling probabilities by name, for the logs.
      communicator: connects the ranks that train together.
    """
    self._environment = environment
    self._actor, self._learner = actor, learner
    self._length = rollout_length
    self._names = mode_names
    self._probabilities = probabilities
    self._communicator = communicator
    self._returns = statistics.ReturnTracker(
      len(mode_names), environment.control_timestep
    )
    self._diverged = statistics.DivergenceCounter()
    self.iterations = 0
    self._observation = torch.from_numpy(environment.reset())
    self._buffers = self._allocate()

  @property
  def steps(self) -> int:
    """Environment steps, summed over all worlds."""
    return self._environment.steps

  @property
  def network(self) -> networks.ActorCritic:
    """Returns the network that is trained."""
    return self._learner.network

  def _allocate(self) -> rollouts.Rollouts:
    shape = (self._length, self._environment.num_worlds)
    size = self._environment.observation_spec().shape[0]
    actions = self._environment.action_spec().shape[0]
    return rollouts.Rollouts(
      observations=torch.zeros(*shape, size),
      actions=torch.zeros(*shape, actions),
      log_probs=torch.zeros(shape),
      means=torch.zeros(*shape, actions),
      rewards=torch.zeros(shape),
      discounts=torch.zeros(shape),
      last=torch.zeros(shape, dtype=torch.bool),
      next_observations=torch.zeros(*shape, size),
    )

  def _collect(self) -> None:
    """Fills the buffers with one rollout of every world."""
    data, seen = self._buffers, self._observation
    steps, table = self.steps, statistics.EpisodeTable()
    transitions = statistics.EpisodeTable()
    for t in range(self._length):
      sample = self._actor.sample(seen, steps)
      step = self._environment.step(sample.action.numpy())
      data.observations[t], data.actions[t] = seen, sample.action
      data.log_probs[t], data.means[t] = sample.log_prob, sample.mean
      data.rewards[t] = torch.from_numpy(step.reward)
      data.discounts[t] = torch.from_numpy(step.discount)
      data.last[t] = torch.from_numpy(step.last)
      seen = torch.from_numpy(step.observation)
      data.next_observations[t] = seen
      # The last observation of a terminated world has value 0, and is not
      # finite where the physics diverged.
      worlds = step.results.worlds
      timed_out = step.discount[worlds] > 0
      data.next_observations[t, torch.from_numpy(worlds[timed_out])] = (
        torch.from_numpy(step.final_observation[timed_out])
      )
      table.add(t, step.results)
      transitions.add(t, step.transitions)
    self._observation = seen
    self.iterations += 1
    episodes = table.gather(self._communicator)
    diverged = episodes.causes == self._environment.invalid_cause
    self._diverged.update(int(diverged.sum()), self.steps - steps)
    self._returns.update(episodes)
    if self._communicator.size > 1:
      self._environment.learn(transitions.gather(self._communicator))

  def run(
    self,
    config: TrainingConfig,
    logger: loggers.Logger,
    save: Callable[[], None],
    should_stop: Callable[[], bool] = lambda: False,
    keep: Callable[[], None] = lambda: None,
  ) -> None:
    """Trains until `config.steps`, the time limit or `should_stop`.

    Args:
      config: length and intervals.
      logger: receives a row every `config.log_every` iterations.
      save: called at least every `config.checkpoint_seconds` and at the end.
      should_stop: called after every iteration.
      keep: called every `config.keep_every` environment steps.
    """
    began = saved = logged = time.monotonic()
    logged_steps, saved_steps = self.steps, -1
    while self.steps < config.steps:
      before = self.steps
      self._collect()
      metrics = self._learner.step(self._buffers, before)
      if config.keep_every and (
        self.steps // config.keep_every > before // config.keep_every
      ):
        keep()
      now = time.monotonic()
      if self.iterations % config.log_every == 0:
        speed = (self.steps - logged_steps) / (now - logged)
        logged, logged_steps = now, self.steps
        logger.write(self._row(metrics, speed))
      save_now, stop = self._communicator.any(
        now - saved > config.checkpoint_seconds,
        should_stop() or now - began > 60 * config.minutes,
      )
      if save_now:
        save()
        saved, saved_steps = time.monotonic(), self.steps
      if stop:
        break
    # Saving the same step twice would overwrite the earlier checkpoint.
    if self.steps != saved_steps:
      save()

  def _row(self, metrics: dict[str, float], speed: float) -> dict[str, float]:
    return {
      'steps': self.steps,
      'steps_per_second': speed,
      'diverged': self._diverged.total,
      **self._returns.summary(self._names),
      **metrics,
      **self._probabilities(),
    }

  def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns tensors and JSON values for `restore`.

    The result is complete at rank 0 only.

    Raises:
      ValueError: the ranks do not hold the same network.
    """
    tensors: dict[str, Any] = {}
    for prefix, part in self._parts():
      tensors |= {f'{prefix}/{k}': v for k, v in part.state().items()}
    tracked = self._returns.state()
    tensors |= {f'tracker/{name}': value for name, value in tracked.items()}
    values = {'steps': self.steps, 'iterations': self.iterations}
    if self._diverged.total:
      values['diverged'] = self._diverged.total
    if self._communicator.size > 1:
      values['ranks'] = self._communicator.size
    return checkpointing.collect(self._communicator, tensors), values

  def _parts(self) -> tuple[tuple[str, Any], ...]:
    return (
      ('learner', self._learner),
      ('actor', self._actor),
      ('environment', self._environment),
    )

  def restore(
    self, tensors: Mapping[str, torch.Tensor], values: Mapping[str, Any]
  ) -> None:
    """Restores a `state`; training then continues bit for bit.

    Args:
      tensors, values: result of `state`; ignored at ranks other than 0.

    Raises:
      ValueError: the state has another network, task, or number of worlds or
        ranks.
    """
    tensors, values = checkpointing.scatter(self._communicator, tensors, values)
    try:
      self._learner.restore(arrays.part_of(tensors, 'learner/'))
      self._actor.restore(arrays.part_of(tensors, 'actor/'))
      world_state = {
        k: v.numpy() for k, v in arrays.part_of(tensors, 'environment/').items()
      }
      self._observation = torch.from_numpy(
        self._environment.restore(world_state)
      )
      self._returns.restore(arrays.part_of(tensors, 'tracker/'))
      self.iterations = int(values['iterations'])
      if int(values['steps']) != self.steps:
        raise RuntimeError(f'its worlds have made {self.steps:,} steps.')
      # Older checkpoints lack it.
      self._diverged.restore(int(values.get('diverged', 0)))
    except KeyError as error:
      raise ValueError(f'The checkpoint lacks {error}.') from error
    except (IndexError, OverflowError, RuntimeError, TypeError) as error:
      reason = ' '.join(str(error).split())
      raise ValueError(f'The checkpoint is damaged: {reason}') from error
