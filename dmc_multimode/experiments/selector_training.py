"""Trains a mode selector by PPO on the worlds of a `reach_*` task.

`python -m dmc_multimode.bin.train_selector` as a function. The reward of a knot
is the way towards the goal, in metres, more while the robot stands there, and
less for a fall.
"""

import dataclasses
import math
import os
import pathlib
import time
from typing import Any, Mapping, NamedTuple

import numpy as np
import torch
from torch import nn

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import loggers
from dmc_multimode.agents.ppo import losses
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import signals
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.reaching import environment as reaching_env
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.suite.reaching import worlds as worlds_lib
from dmc_multimode.utils import arrays
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import files
from dmc_multimode.utils import schedule

_CONFIG_FILE = 'config.json'
_METRICS_FILE = 'metrics.csv'
_SUBFOLDER = 'selector'
_LOG_EVERY = 10  # Iterations.
_CHECKPOINT_SECONDS = 60.0
_MEMORY = 0.99  # The means follow about the last 100 episodes.


@config_lib.dataclass
class LearningConfig:
  """Hyperparameters of PPO over modes; schedules are of decisions.

  Attributes:
    hidden_sizes: of policy and value networks.
    rollout_length: decisions per world and iteration.
    discount: gamma, a decision.
    gae_lambda: lambda of generalised advantage estimation.
    epochs: passes over each iteration's data.
    minibatches: parts that each pass is cut into.
    clip: epsilon of the clipped surrogate objective.
    entropy_coefficient: weight of the entropy bonus, a schedule.
    learning_rate: of Adam, a schedule.
    max_gradient_norm: gradients are scaled down to it.
  """

  hidden_sizes: tuple[config_lib.PositiveInt, ...] = (128, 128)
  rollout_length: config_lib.PositiveInt = 32
  discount: config_lib.Share = 0.97
  gae_lambda: config_lib.Share = 0.95
  epochs: config_lib.PositiveInt = 4
  minibatches: config_lib.PositiveInt = 4
  clip: config_lib.Positive = 0.2
  entropy_coefficient: schedule.ScheduleField = schedule.Schedule(
    0.02, 0.002, 0, 2_500_000
  )
  learning_rate: schedule.ScheduleField = schedule.Schedule(
    1e-3, 1e-4, 0, 3_000_000
  )
  max_gradient_norm: config_lib.Positive = 1.0


@config_lib.dataclass
class TaskConfig:
  """The worlds and rewards of a selector's training.

  Attributes:
    knot_duration: seconds from choice to choice.
    physics_timestep: seconds; longer than those of users, and faster.
    push_speed: largest velocity that a push adds, m/s.
    push_interval: mean time between the pushes of a robot, seconds.
    push_fraction: probability of an episode to have pushes.
    scan_errors: of the observed ground.
    standing: reward of a knot at whose end the robot stands at the goal.
    fall: cost of a fall.
  """

  knot_duration: config_lib.Positive = 0.15
  physics_timestep: config_lib.Positive = 0.0075
  push_speed: config_lib.NonNegative = 0.5
  push_interval: config_lib.Positive = 2.0
  push_fraction: config_lib.Share = 1.0
  scan_errors: sensing.ScanErrors = sensing.ScanErrors(0.02, 0.02, 0.02)
  standing: config_lib.NonNegative = 0.1
  fall: config_lib.NonNegative = 1.0


@config_lib.dataclass
class SelectorConfig:
  """Configuration of a selector's training.

  Attributes:
    policy: low-level policy, a shipped one or a folder.
    arena: name of the track.
    sizes: of the track, where they are not its defaults.
    decisions: choices of modes in all, summed over all worlds.
    seed: of all randomness.
    num_worlds: number of worlds.
    threads: of the physics.
    init_from: folder of a selector to go on from, of the same policy; by
      default training starts from scratch.
    learning: hyperparameters.
    task: worlds and rewards.
  """

  policy: str = 'pi2'
  arena: str = 'parkour'
  sizes: Mapping[str, float] = dataclasses.field(default_factory=dict)
  decisions: config_lib.PositiveInt = 3_000_000
  seed: config_lib.Count = 0
  num_worlds: config_lib.PositiveInt = 256
  threads: config_lib.PositiveInt = 2
  init_from: str = ''
  learning: LearningConfig = LearningConfig()
  task: TaskConfig = TaskConfig()


class _Rollouts(NamedTuple):
  """T decisions of B worlds; see `ppo.rollouts.Rollouts`."""

  observations: torch.Tensor
  obeyed: torch.Tensor
  modes: torch.Tensor
  log_probs: torch.Tensor
  rewards: torch.Tensor
  discounts: torch.Tensor
  last: torch.Tensor
  next_values: torch.Tensor
  values: torch.Tensor


class SelectorTraining:
  """Collects decisions and learns from them.

  Attributes:
    worlds: in which it learns.
    network: that learns.
    decisions: so far, summed over all worlds.
  """

  def __init__(self, config: SelectorConfig):
    """Compiles the worlds.

    Raises:
      FileNotFoundError: there is no such policy, or selector to go on from.
      ValueError: a setting is wrong, or that selector is of another policy.
    """
    self._config = config
    self._learning, self._task = config.learning, config.task
    disturbed = dataclasses.replace(
      events.fixed(config.task.push_speed),
      push_interval=config.task.push_interval,
      push_fraction=config.task.push_fraction,
    )
    self.worlds = worlds_lib.ReachingWorlds(
      reaching_env.load_policy(config.policy),
      config.arena,
      config.num_worlds,
      config.seed,
      config.threads,
      config.sizes,
      disturbed,
      config.task.scan_errors,
      physics_timestep=config.task.physics_timestep,
      knot_duration=config.task.knot_duration,
    )
    with torch.random.fork_rng(devices=[]):
      torch.manual_seed(config.seed)
      self.network = selector_lib.SelectorNetwork(
        self.worlds.layout,
        len(self.worlds.mode_names),
        config.learning.hidden_sizes,
      )
    if config.init_from:
      start = selector_lib.load(config.init_from)
      steering.check(start, self.worlds.mode_names, self.worlds.layout)
      if start.hidden_sizes != config.learning.hidden_sizes:
        raise ValueError(
          f'The selector in {config.init_from} has hidden_sizes='
          f'{start.hidden_sizes}, not {config.learning.hidden_sizes}.'
        )
      self.network.load_state_dict(start.network.state_dict())
    self._adam = torch.optim.Adam(self.network.parameters(), eps=1e-5)
    self._generator = torch.Generator().manual_seed(config.seed + 2)
    self._goal = self.worlds.part('goal')
    self.decisions = 0
    self._means = {'reached': 0.0, 'fell': 0.0, 'progress': 0.0}
    self._episodes = 0
    self._gained = np.zeros(config.num_worlds)
    self._observation = self.worlds.reset()

  @property
  def means(self) -> dict[str, float]:
    """Running means over episodes; NaN until one has ended.

    Of `reached` (the robot stood at the goal in the end), `fell`, and
    `progress`, the way to the goal, metres.
    """
    if self._episodes:
      return dict(self._means)
    return dict.fromkeys(self._means, math.nan)

  def selector(self) -> selector_lib.Selector:
    """Returns the current selector."""
    worlds = self.worlds
    return selector_lib.Selector(
      self.network,
      worlds.layout,
      worlds.mode_names,
      self._config.policy,
      self._learning.hidden_sizes,
      worlds.knot_steps * worlds.control_timestep,
      {
        'decisions': self.decisions,
        'training': config_lib.to_dict(self._config),
      },
    )

  def iterate(self) -> dict[str, float]:
    """Collects one rollout of every world and learns from it.

    Raises:
      FloatingPointError: the update is not finite.
    """
    rollouts = self._collect()
    metrics = self._learn(rollouts)
    seen = self.network.prepare(rollouts.observations.flatten(0, 1))
    self.network.normaliser.update(seen)
    self.decisions += len(seen)
    return {'steps': self.decisions, **self.means, **metrics}

  @torch.no_grad()
  def _collect(self) -> _Rollouts:
    config, rows = self._learning, []
    for _ in range(config.rollout_length):
      seen = torch.from_numpy(self._observation)
      obeyed = torch.from_numpy(self.worlds.obeyed())
      scores = self.network(seen, obeyed)
      modes = torch.multinomial(
        scores.exp(), 1, generator=self._generator
      ).squeeze(1)
      step = self.worlds.step(modes.numpy())
      after = step.observation.copy()
      after[step.last] = step.final_observation
      reward = self._reward(step, after)
      self._count(step)
      values = self.network.values(seen)
      rows.append(
        _Rollouts(
          seen,
          obeyed,
          modes,
          scores.gather(1, modes[:, None]).squeeze(1),
          torch.from_numpy(reward).float(),
          torch.from_numpy(step.discount).float(),
          torch.from_numpy(step.last),
          self.network.values(torch.from_numpy(after)),
          values,
        )
      )
      self._observation = step.observation
    return _Rollouts(*(torch.stack(field) for field in zip(*rows, strict=True)))

  def _reward(
    self, step: worlds_lib.ReachingStep, after: np.ndarray
  ) -> np.ndarray:
    """Returns the rewards of a knot, [B]."""
    before, now = (
      np.linalg.norm(seen[:, self._goal][:, :2], axis=1)
      for seen in (self._observation, after)
    )
    progress = np.where(step.discount > 0, before - now, 0.0)
    self._gained += progress
    return (
      progress
      + self._task.standing * step.reached
      - self._task.fall * (step.discount == 0)
    )

  def _count(self, step: worlds_lib.ReachingStep) -> None:
    """Updates the means with the episodes that ended."""
    for i in np.flatnonzero(step.last):
      found = {
        'reached': float(step.reached[i]),
        'fell': float(step.discount[i] == 0),
        'progress': float(self._gained[i]),
      }
      self._episodes += 1
      rate = max(1 - _MEMORY, 1 / self._episodes)
      for name, value in found.items():
        self._means[name] += rate * (value - self._means[name])
    self._gained[step.last] = 0.0

  def _learn(self, rollouts: _Rollouts) -> dict[str, float]:
    """Fits the network to a rollout; returns metrics."""
    config = self._learning
    # In units of 1 - gamma a value is a mean reward: of order one.
    advantages = losses.generalised_advantages(
      (1 - config.discount) * rollouts.rewards,
      rollouts.values,
      rollouts.next_values,
      config.discount * rollouts.discounts,
      rollouts.last,
      config.gae_lambda,
    )
    targets = (advantages + rollouts.values).flatten()
    advantages = losses.normalised(advantages.flatten())
    flat = _Rollouts(*(field.flatten(0, 1) for field in rollouts))
    for group in self._adam.param_groups:
      group['lr'] = config.learning_rate.at(self.decisions)
    totals = {'loss/policy': 0.0, 'loss/value': 0.0, 'entropy': 0.0}
    count = 0
    for _ in range(config.epochs):
      order = torch.randperm(len(targets), generator=self._generator)
      for ids in order.chunk(config.minibatches):
        count += 1
        for name, value in self._fit(flat, advantages, targets, ids).items():
          totals[name] += value
    return {name: total / count for name, total in totals.items()}

  def _fit(
    self,
    flat: _Rollouts,
    advantages: torch.Tensor,
    targets: torch.Tensor,
    ids: torch.Tensor,
  ) -> dict[str, float]:
    """Takes one step of Adam on the samples `ids`."""
    config, network = self._learning, self.network
    seen = flat.observations[ids]
    scores = network(seen, flat.obeyed[ids])
    surrogate, _ = losses.surrogate_loss(
      scores.gather(1, flat.modes[ids][:, None]).squeeze(1),
      flat.log_probs[ids],
      advantages[ids],
      config.clip,
    )
    possible = scores.masked_fill(~flat.obeyed[ids], 0.0)
    entropy = -(possible.exp() * possible).sum(dim=-1).mean()
    value = torch.mean((network.values(seen) - targets[ids]) ** 2)
    weight = config.entropy_coefficient.at(self.decisions)
    self._adam.zero_grad(set_to_none=True)
    (surrogate - weight * entropy + value).backward()
    norm = nn.utils.clip_grad_norm_(
      network.parameters(), config.max_gradient_norm
    )
    if not math.isfinite(norm):
      raise FloatingPointError(
        'A gradient is not finite; the last checkpoint is unharmed: resume '
        'from it, with a lower learning rate if it recurs.'
      )
    self._adam.step()
    return {
      'loss/policy': float(surrogate.detach()),
      'loss/value': float(value.detach()),
      'entropy': float(entropy.detach()),
    }

  def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns tensors and JSON values for `restore`."""
    tensors: dict[str, Any] = {
      f'network/{k}': v for k, v in self.network.state_dict().items()
    }
    tensors |= {
      f'adam/{i}/{key}': value
      for i, parameter in enumerate(self.network.parameters())
      for key, value in self._adam.state.get(parameter, {}).items()
    }
    tensors |= {f'worlds/{k}': v for k, v in self.worlds.state().items()}
    tensors['generator'] = self._generator.get_state()
    tensors['gained'] = self._gained
    return tensors, {
      'steps': self.decisions,
      'means': dict(self._means),
      'episodes': self._episodes,
    }

  def restore(
    self, tensors: Mapping[str, torch.Tensor], values: Mapping[str, Any]
  ) -> None:
    """Restores a `state`; training then continues bit for bit."""
    self.network.load_state_dict(arrays.part_of(tensors, 'network/'))
    for i, parameter in enumerate(self.network.parameters()):
      moments = arrays.part_of(tensors, f'adam/{i}/')
      if moments:
        self._adam.state[parameter] = {
          key: value.clone() for key, value in moments.items()
        }
    worlds = {
      k: v.numpy() for k, v in arrays.part_of(tensors, 'worlds/').items()
    }
    self._observation = self.worlds.restore(worlds)
    self._generator.set_state(tensors['generator'])
    self._gained[:] = tensors['gained'].numpy()
    self.decisions = int(values['steps'])
    self._means = {k: float(v) for k, v in values['means'].items()}
    # Earlier checkpoints do not count them.
    self._episodes = int(values.get('episodes', round(1 / (1 - _MEMORY))))


def train(
  run_dir: str | os.PathLike[str],
  *,
  resume: bool = False,
  minutes: float = math.inf,
  decisions: int | None = None,
  **overrides: Any,
) -> selector_lib.Selector:
  """Trains a selector up to `decisions` or the time limit.

  Args:
    run_dir: folder of the run: `selector/` is the newest selector,
      `metrics.csv` has a row every few iterations.
    resume: continues the run in the folder, bit for bit.
    minutes: wall-clock limit.
    decisions: choices in all; a resumed run may be given others.
    **overrides: other fields of `SelectorConfig`, named as the flags are:
      `num_worlds=64`, `learning_discount=0.98`.

  Returns:
    The selector, also written to the run's folder.

  Raises:
    FileNotFoundError: the run to resume or the policy does not exist.
    ValueError: in one line, a setting is wrong, contradicts the run that is
      resumed, or the folder already holds one.
    FloatingPointError: an update is not finite.
  """
  if not minutes > 0:
    raise ValueError(f'minutes must be positive, got {minutes}.')
  folder = pathlib.Path(files.expand(run_dir))
  config = _configure(folder, resume, overrides)
  if decisions is not None:
    config = dataclasses.replace(config, decisions=decisions)
  run = SelectorTraining(config)
  folder.mkdir(parents=True, exist_ok=True)
  checkpointer = checkpointing.Checkpointer(folder)
  files.write_json(folder / _CONFIG_FILE, config_lib.to_dict(config))
  if resume and checkpointer.exists():
    tensors, values, note = checkpointer.load()
    run.restore(tensors, values)
    print(note or f'Resuming at {run.decisions:,} decisions.', flush=True)

  def save() -> None:
    checkpointer.save(*run.state())
    run.selector().save(folder / _SUBFOLDER)

  logger = loggers.Dispatcher(
    [
      loggers.ProgressLogger(config.decisions, run.decisions, minutes),
      loggers.CSVLogger(folder / _METRICS_FILE, run.decisions),
    ]
  )
  began = saved = logged = time.monotonic()
  steps, saved_at, iteration = run.worlds.steps, -1, 0
  try:
    with signals.Stop() as stop:
      while run.decisions < config.decisions:
        row = run.iterate()
        now, iteration = time.monotonic(), iteration + 1
        if iteration % _LOG_EVERY == 0:
          speed = (run.worlds.steps - steps) / (now - logged)
          logged, steps = now, run.worlds.steps
          logger.write({**row, 'steps_per_second': speed})
        if now - saved > _CHECKPOINT_SECONDS:
          save()
          saved, saved_at = time.monotonic(), run.decisions
        if stop() or now - began > 60 * minutes:
          break
    if run.decisions != saved_at:
      save()
  finally:
    logger.close()
  print(
    f'{run.decisions:,} decisions; the selector is in {folder / _SUBFOLDER}'
  )
  return run.selector()


def _configure(
  folder: pathlib.Path, resume: bool, overrides: Mapping[str, Any]
) -> SelectorConfig:
  """Returns the configuration of a new or resumed run; creates nothing."""
  path = folder / _CONFIG_FILE
  if not resume:
    if path.exists():
      raise ValueError(
        f'{folder} already holds a run: add --resume (from Python '
        'resume=True), or name another folder.'
      )
    files.output_folder('run_dir', folder)
    return run_config.overridden(SelectorConfig(), overrides)
  if not path.is_file():
    raise FileNotFoundError(
      f'{folder} holds no run to resume; start one without --resume (from '
      'Python resume=False).'
    )
  config = config_lib.build(SelectorConfig, files.read_json(path))
  asked = run_config.overridden(config, overrides)
  for name, stored, wanted in run_config.differences(config, asked):
    raise ValueError(
      f'The run in {folder} has {name}={stored}, not {wanted}. Leave that out '
      'to resume it, or name another folder.'
    )
  return config
