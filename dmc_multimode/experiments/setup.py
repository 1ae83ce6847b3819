"""Builds the parts of a training run."""

import dataclasses
from typing import Any

import torch

from dmc_multimode.agents import core
from dmc_multimode.agents import distributed
from dmc_multimode.agents import runner
from dmc_multimode.agents.ppo import builder as builder_lib
from dmc_multimode.agents.ppo import kickstarting
from dmc_multimode.agents.ppo import networks
from dmc_multimode.arenas import track
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import symmetry
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import episodes

_FLAT_SEGMENTS = 2  # The ground and the ledge of at most one command.
_MORE_SEGMENTS = 3  # The ground, and two obstacles or ledges.


def check_ranks(config: run_config.RunConfig, ranks: int) -> None:
  """Raises ValueError if the worlds do not divide among `ranks`."""
  if config.num_worlds % ranks:
    raise ValueError(
      f'num_worlds {config.num_worlds} is the total over all processes: '
      f'{ranks} of them cannot have equally many.'
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
  """The parts of a run, connected.

  Attributes:
    config: of the run.
    environment: the worlds.
    network: the trained network.
    loop: the training loop.
    initial: the initial policy, if any.
  """

  config: run_config.RunConfig
  environment: batched_env.BatchedImitation
  network: networks.ActorCritic
  loop: runner.TrainingLoop
  initial: policy_lib.Policy | None = None

  def policy(self) -> policy_lib.Policy:
    """Returns the current policy."""
    provenance: dict[str, Any] = {
      'steps': self.loop.steps,
      'run': run_config.to_dict(self.config),
    }
    # The task of the policy has it.
    provenance['run']['task'].pop('robot', None)
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
  config: run_config.RunConfig,
  mode_set: mode_set_lib.ModeSet,
  communicator: distributed.Communicator = distributed.LOCAL,
  device: torch.device | str = 'cpu',
  initial: policy_lib.Policy | None = None,
) -> Run:
  """Connects environment, agent and loop; nothing is trained yet.

  Args:
    config: of the run, checked by `check_ranks`.
    mode_set: its modes.
    communicator: of the ranks, each of which builds its own part.
    device: of the network.
    initial: policy with the initial weights, if any; ignored at ranks other
      than 0.
  """
  # Two threads (see `agents.pair`) share this rank's threads.
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
  config: run_config.RunConfig,
  mode_set: mode_set_lib.ModeSet,
  communicator: distributed.Communicator,
) -> batched_env.BatchedImitation:
  """Returns this rank's worlds, with episodes of Algorithm 1."""
  task = multimode_biped.make_task(
    mode_set,
    episodes.TransitionEpisodes(mode_set, config.sampling),
    track.make(
      'flat',
      _MORE_SEGMENTS
      if config.task.events.most_obstacles or config.sampling.has_strings
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
  config: run_config.RunConfig,
  environment: batched_env.BatchedImitation,
  device: torch.device | str,
) -> core.EnvironmentDescription:
  """Returns the description of the worlds for the agent."""
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
  config: run_config.RunConfig,
  mode_set: mode_set_lib.ModeSet,
  about: core.EnvironmentDescription,
  network: networks.ActorCritic,
) -> kickstarting.ReferencePolicy | None:
  """Returns the kickstarting policy, a copy of `network`; may be None."""
  if not (
    config.init_from and config.ppo.kickstarting_weight and about.mode_of
  ):
    return None
  known = config.init_modes.split(',')
  return kickstarting.ReferencePolicy(
    network, about.mode_of, [name in known for name in mode_set.names]
  )
