"""What a training run is made of: its configuration, and its parts."""

import dataclasses
import json
import pathlib
from typing import Any, Mapping

import torch

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import builder as builder_lib
from dmc_multimode.agents.ppo import config as ppo_config
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import networks
from dmc_multimode.arenas import track
from dmc_multimode.experiments import symmetry
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.imitation import mode_sampler
from dmc_multimode.utils import files
from dmc_multimode.utils import schedule
from dmc_multimode.utils import typed

CONFIG_FILE = 'config.json'
ENCODER = 'encoder'  # The folder of a run's mode encoder.
INITIAL = 'initial'  # The folder of the policy that a run has begun with.
_MAX_WORLDS = 1_000_000
_FLAT_SEGMENTS = 2  # The ground and the step of at most one command.
_OBSTACLE_SEGMENTS = 3  # The ground and what each of two commands may meet.


@dataclasses.dataclass(frozen=True)
class RunConfig:
  """Everything that decides a run's result.

  What docs/LEARNING.md found best is the default.

  Attributes:
    modes: a set's name or mode names, comma-separated.
    seed: of all randomness.
    num_worlds: stepped together, by all processes.
    threads: of the physics and of torch, in each process; part of
      bit-reproducibility.
    one_hot: one-hot commands instead of an encoder's latents.
    init_from: the policy that it begins with, as its user has named it; empty
      for none.
    init_modes: the modes that this policy knows, comma-separated.
    ppo: of the learner.
    sampling: of Algorithm 1.
    task: of the imitation task.
  """

  modes: str = 'quickstart'
  seed: int = 0
  num_worlds: int = 1024
  threads: int = 2
  one_hot: bool = False
  init_from: str = ''
  init_modes: str = ''
  ppo: ppo_config.PPOConfig = ppo_config.PPOConfig(
    symmetry='alternate', anneal_start=6_000_000, anneal_end=9_000_000
  )
  sampling: mode_sampler.SamplingConfig = mode_sampler.SamplingConfig()
  task: task_config.ImitationConfig = task_config.ImitationConfig(
    physics_timestep=0.01,
    events=events_lib.TrainingEvents(
      # Farther from the reference at first.
      distance_slack=schedule.Schedule(0.15, 0.0, 0, 3_000_000),
      assistance_steps=2_000_000,
    ),
  )

  def __post_init__(self) -> None:
    for name in ('num_worlds', 'threads'):
      if getattr(self, name) < 1:
        raise ValueError(f'{name} must be positive, got {getattr(self, name)}.')
    if self.num_worlds > _MAX_WORLDS:
      raise ValueError(
        f'num_worlds must be at most {_MAX_WORLDS:,}, got {self.num_worlds}.'
      )
    if not 0 <= self.seed < 2**32:
      raise ValueError(f'seed must be in [0, 2^32), got {self.seed}.')


Ingredients = tuple[RunConfig, mode_set_lib.ModeSet]


def to_dict(config: RunConfig) -> dict[str, Any]:
  """Returns the configuration as JSON-able values."""
  values = dataclasses.asdict(config)
  values['ppo']['hidden_sizes'] = list(config.ppo.hidden_sizes)
  values['task'] = task_config.to_dict(config.task)
  return values


def from_dict(values: Mapping[str, Any]) -> RunConfig:
  """Returns what `to_dict` was given; raises ValueError for anything else."""
  try:
    ppo = dict(values['ppo'])
    ppo['hidden_sizes'] = tuple(ppo['hidden_sizes'])
    return typed.build(
      RunConfig,
      {
        **values,
        'ppo': typed.build(ppo_config.PPOConfig, ppo),
        'sampling': typed.build(
          mode_sampler.SamplingConfig, values['sampling']
        ),
        'task': task_config.from_dict(values['task']),
      },
    )
  except KeyError as error:
    raise ValueError(
      f'Not the configuration of a run: it lacks {error}.'
    ) from error
  except (TypeError, ValueError) as error:
    reason = str(error).rstrip('.')
    raise ValueError(f'Not the configuration of a run: {reason}.') from error


def check_ranks(config: RunConfig, ranks: int) -> None:
  """Raises ValueError where so many processes cannot share the worlds."""
  if config.num_worlds % ranks:
    raise ValueError(
      f'num_worlds {config.num_worlds} is the total over all processes: '
      f'{ranks} of them cannot have equally many.'
    )


def save_run(
  directory: pathlib.Path,
  config: RunConfig,
  mode_set: mode_set_lib.ModeSet,
) -> None:
  """Writes what a run needs to be resumed, besides its checkpoint."""
  text = describe(config, mode_set)
  files.write(directory / CONFIG_FILE, text.encode())


def describe(
  config: RunConfig,
  mode_set: mode_set_lib.ModeSet,
) -> str:
  """Returns JSON from which `parse` makes the same again."""
  description = {
    'run': to_dict(config),
    **mode_files.mode_set_to_dict(mode_set),
  }
  return json.dumps(description, indent=1)


def parse(text: str) -> Ingredients:
  """Returns what `describe` was given; raises ValueError for anything else."""
  try:
    description = json.loads(text)
    mode_set = mode_files.mode_set_from_dict(description)
    return from_dict(description['run']), mode_set
  except KeyError as error:
    raise ValueError(f'it lacks {error}') from error
  except (TypeError, OverflowError, RecursionError) as error:
    raise ValueError(str(error)) from error


def load_run(directory: pathlib.Path) -> Ingredients:
  """Reads what `save_run` wrote.

  Raises:
    FileNotFoundError: the folder holds no run.
    ValueError: the file is damaged.
  """
  path = directory / CONFIG_FILE
  if not path.is_file():
    raise FileNotFoundError(
      f'{directory} holds no run to resume; start one without --resume.'
    )
  content = files.read_bounded(path)
  try:
    return parse(content.decode())
  except ValueError as error:
    raise ValueError(f'{path} is damaged: {error}') from error


def load_initial(
  directory: pathlib.Path, config: RunConfig
) -> policy_lib.Policy | None:
  """Reads the policy that the run in a folder has begun with, if any.

  Raises:
    FileNotFoundError: the run lacks it.
    ValueError: it is damaged.
  """
  if not config.init_from:
    return None
  return policy_lib.load(directory / INITIAL)


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
  """The parts of a run, connected.

  Attributes:
    config: of the run.
    environment: the worlds.
    network: what is learned.
    loop: collects and learns.
    initial: the policy that it has begun with, if any.
  """

  config: RunConfig
  environment: batched_env.BatchedImitation
  network: networks.ActorCritic
  loop: runner.TrainingLoop
  initial: policy_lib.Policy | None = None

  def policy(self) -> policy_lib.Policy:
    """Returns the policy as it is now."""
    provenance: dict[str, Any] = {
      'steps': self.loop.steps,
      'run': to_dict(self.config),
    }
    if self.initial:
      provenance['initial'] = dict(self.initial.provenance)
    return policy_lib.Policy(
      self.network,
      self.config.ppo.hidden_sizes,
      self.environment.mode_set,
      self.config.task,
      provenance,
    )


def build(
  config: RunConfig,
  mode_set: mode_set_lib.ModeSet,
  communicator: distributed.Communicator = distributed.LOCAL,
  device: torch.device | str = 'cpu',
  initial: policy_lib.Policy | None = None,
) -> Run:
  """Connects environment, agent and loop; nothing is trained yet.

  Args:
    config: of the run, which `check_ranks` has seen.
    mode_set: its modes.
    communicator: of the ranks, each of which builds its own part.
    device: on which the network is, and learns.
    initial: whose weights the network begins with, if any; only rank 0's
      matters.
  """
  # Two threads at once, see `agents.pair`, each with its share of all.
  torch.set_num_threads(max(config.threads // 2, 1))
  environment = _make_environment(config, mode_set, communicator)
  about = _describe(config, environment, device)
  builder = builder_lib.PPOBuilder(
    config.ppo,
    about,
    config.seed,
    communicator,
    device,
    # A GPU gains nothing, and NCCL's operations must not cross.
    parallel=config.threads > 1 and torch.device(device).type == 'cpu',
  )
  network = builder.make_networks(
    initial.network.state_dict() if initial else None
  )
  reference = _make_reference(config, mode_set, about, network)
  loop = runner.TrainingLoop(
    environment,
    builder.make_actor(network),
    builder.make_learner(network, reference),
    config.ppo.rollout_length,
    mode_set.names,
    lambda: {
      **environment.episodes.probabilities(),
      'assistance': environment.assistance.share,
    },
    communicator,
  )
  return Run(config, environment, network, loop, initial)


def _make_environment(
  config: RunConfig,
  mode_set: mode_set_lib.ModeSet,
  communicator: distributed.Communicator,
) -> batched_env.BatchedImitation:
  """Returns this rank's worlds, in which Algorithm 1 chooses the episodes."""
  task = multimode_biped.make_task(
    mode_set,
    episodes.TransitionEpisodes(
      mode_set, config.sampling, config.task.commands_from_ground
    ),
    track.make(
      'flat',
      _OBSTACLE_SEGMENTS
      if config.task.events.most_obstacles
      else _FLAT_SEGMENTS,
    ),
    config.task,
  )
  return batched_env.BatchedImitation(
    task,
    config.num_worlds // communicator.size,
    distributed.rank_seed(config.seed, communicator.rank),
    config.threads,
    privileged=config.ppo.privileged_critic,
    replicas=communicator.size,
  )


def _describe(
  config: RunConfig,
  environment: batched_env.BatchedImitation,
  device: torch.device | str,
) -> core.EnvironmentDescription:
  """Returns what the agent must know of the worlds."""
  latents = environment.mode_set.latents
  mirror = None
  if config.ppo.symmetry != 'none':
    mirror = symmetry.Mirror(environment.mirror_image(), latents, device)
  return core.EnvironmentDescription(
    environment.observation_spec(),
    environment.action_spec(),
    environment.privileged_size,
    environment.standing_action(),
    mirror,
    symmetry.ModeOf(latents, device=device),
  )


def _make_reference(
  config: RunConfig,
  mode_set: mode_set_lib.ModeSet,
  about: core.EnvironmentDescription,
  network: networks.ActorCritic,
) -> kickstarting.ReferencePolicy | None:
  """Returns the policy to stay near to, which the network begins as."""
  if not (config.init_from and config.ppo.anchor_weight and about.mode_of):
    return None
  known = config.init_modes.split(',')
  return kickstarting.ReferencePolicy(
    network, about.mode_of, [name in known for name in mode_set.names]
  )
