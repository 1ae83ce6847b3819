"""Policies on disk: weights, modes, and the task of the training.

A policy is a folder of

    policy.safetensors  weights and observation normaliser
    policy.json         sizes, mode definitions, latents, task configuration
    metrics.json        scores of `evaluate` (optional)

and never a pickle: loading runs no code. Shipped folders may also hold
encoder.json and encoder.safetensors, the mode encoder of the latents (for
fine-tuning), and training.csv, the log of the training; `load` reads neither.
"""

import dataclasses
import functools
import os
import pathlib
from typing import Any, Callable, Mapping

import mujoco
import numpy as np
import torch

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents.ppo import acting
from dmc_multimode.agents.ppo import networks
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.pretrained import folder as folder_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import observations as task_observations
from dmc_multimode.utils import arrays
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import files
from dmc_multimode.walkers import robot as robot_lib

WEIGHTS_FILE = 'policy.safetensors'
DESCRIPTION_FILE = folder_lib.DESCRIPTION_FILE
METRICS_FILE = 'metrics.json'
RUN_SUBFOLDER = folder_lib.RUN_SUBFOLDER

_FORMAT = folder_lib.FORMAT
_MAX_UNITS = 4096
MakeNetwork = Callable[[int, int, int], networks.ActorCritic]


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
  """A latent-conditioned policy with its modes and task.

  Attributes:
    network: policy, value function and normaliser.
    hidden_sizes: of the network.
    mode_set: modes of the training.
    config: task of the training.
    provenance: steps, seed, versions and configuration of the training.
    metrics: scores of `evaluate`, or empty.
  """

  network: networks.ActorCritic
  hidden_sizes: tuple[int, ...]
  mode_set: mode_set_lib.ModeSet
  config: task_config.ImitationConfig
  provenance: Mapping[str, Any]
  metrics: Mapping[str, Any] = dataclasses.field(default_factory=dict)

  def __post_init__(self) -> None:
    # Somebody may have assigned modules of their own.
    if self.network.own_modules(self.hidden_sizes):
      self.network.check()

  def __repr__(self) -> str:
    """Returns one line: modes, robot and steps."""
    steps = self.provenance.get('steps')
    trained = f', {steps:,} steps' if isinstance(steps, int) else ''
    modes, robot = ', '.join(self.mode_set.names), self.config.robot
    return f'Policy({modes}; robot {robot.name}{trained})'

  @functools.cached_property
  def actor(self) -> acting.FeedForwardActor:
    """Returns an actor for one dm_env environment, deterministic."""
    layout = task_observations.layout(
      self.mode_set.latent_dim,
      extra=self.config.extra_observations,
      robot=self.config.robot,
    )
    return acting.FeedForwardActor(self.network, [name for name, _ in layout])

  @torch.no_grad()
  def select_action(self, observations: np.ndarray) -> np.ndarray:
    """Returns mean actions for flat observations.

    Args:
      observations: numbers of any type, D of them or D + P with the privileged
        ones of the training, [B, D]. An observation that is not finite, as
        after a divergence, has such an action.

    Returns:
      Joint targets in radians, float32 [B, J].

    Raises:
      ValueError: they are no numbers, or have another shape.
    """
    rows = arrays.rows(observations, 'observations')
    return self.network.act(torch.from_numpy(rows)).numpy()

  def save(self, path: str | os.PathLike[str]) -> None:
    """Writes the policy's files into a folder, each atomically.

    A network with modules of one's own is saved as its weights: `load` takes
    the function that makes it.

    Raises:
      OSError: the folder cannot be written.
      ValueError: a limit of the task is infinite, which no file can hold.
    """
    config_lib.check_finite(self.config, 'task.')
    directory = pathlib.Path(files.expand(path))
    directory.mkdir(parents=True, exist_ok=True)
    description = {
      'format': _FORMAT,
      'hidden_sizes': list(self.hidden_sizes),
      'activation': self.network.activation,
      'privileged_size': self.network.privileged_size,
      **mode_files.mode_set_to_dict(self.mode_set),
      'task': task_config.to_dict(self.config),
      'provenance': {
        'mujoco': mujoco.__version__,
        'torch': torch.__version__,
        **self.provenance,
      },
    }
    own = self.network.own_modules(self.hidden_sizes)
    if own:
      description['own_modules'] = own
    checkpointing.save_tensors(
      directory / WEIGHTS_FILE, self.network.state_dict(), {'format': _FORMAT}
    )
    files.write_json(directory / DESCRIPTION_FILE, description)


def load(
  policy: str | os.PathLike[str],
  network: MakeNetwork | None = None,
  robot: robot_lib.Robot | str | os.PathLike[str] | None = None,
) -> Policy:
  """Loads a policy by the name of a shipped one, or from a folder.

  Args:
    policy: one of `pretrained.names()`, such as 'pi2', 'pi_all' and
      'quickstart', a policy's folder, or a training run's folder. The name is
      also that of the set of its modes; the policy has a task of its own, and
      `make_worlds(policy, ...)` makes the worlds of that.
    network: makes the network of a policy that has modules of one's own, for
      its weights to be loaded into: called with the numbers of observations, of
      actions and of privileged observations, it returns an `ActorCritic`.
    robot: that the policy must have been trained for, or its file; any by
      default. A policy's files have its robot in them.

  Raises:
    FileNotFoundError: there is no such policy; the message lists those there
      are.
    ValueError: a file is truncated, foreign, or does not fit the others; the
      policy needs `network`, or was trained for another robot.
  """
  directory = folder_lib.find(policy)
  path = directory / DESCRIPTION_FILE
  description = folder_lib.read_description(directory)
  try:
    untrained = _untrained(description)
  except (KeyError, TypeError, ValueError, OverflowError) as error:
    lacks = isinstance(error, KeyError)
    reason = f'it lacks {error}.' if lacks else str(error)
    raise ValueError(f'{path} is damaged: {reason}') from error
  if robot is not None:
    check_robot(untrained, robot, str(policy))
  if network is not None:
    untrained = dataclasses.replace(
      untrained, network=_made(network, untrained)
    )
  elif description.get('own_modules'):
    raise ValueError(
      f'{path} has modules of its own ({description["own_modules"]}): load it '
      'by load(..., network=FUNCTION), which makes its ActorCritic.'
    )
  _load_weights(untrained.network, directory / WEIGHTS_FILE)
  metrics = directory / METRICS_FILE
  return dataclasses.replace(
    untrained, metrics=folder_lib.read_json(metrics) if metrics.exists() else {}
  )


def check_robot(
  policy: Policy, robot: robot_lib.Robot | str | os.PathLike[str], name: str
) -> None:
  """Raises ValueError if a policy was trained for another robot.

  Args:
    policy: with its robot.
    robot: the declared robot, or its file.
    name: of the policy, for the error.
  """
  found = robot_lib.find(robot)
  if found != policy.config.robot:
    raise ValueError(
      f'{name} was trained for the robot {policy.config.robot}, and this is '
      f'{found}: another declaration or model.'
    )


def _made(make: MakeNetwork, policy: Policy) -> networks.ActorCritic:
  """Returns the network of a user's function, for acting."""
  plain, actions = policy.network, policy.config.robot.num_joints
  made = make(plain.observation_size, actions, plain.privileged_size)
  if not isinstance(made, networks.ActorCritic):
    raise ValueError(f'network must return an ActorCritic, got {type(made)}')
  return made.eval()


def _untrained(description: dict[str, Any]) -> Policy:
  """Builds the policy of a description, without its weights."""
  hidden = tuple(int(size) for size in description['hidden_sizes'])
  if (
    not hidden
    or len(hidden) > 8
    or not all(0 < h <= _MAX_UNITS for h in hidden)
  ):
    raise ValueError(f'hidden sizes {hidden} are out of bounds.')
  mode_set = mode_files.mode_set_from_dict(description)
  config = task_config.from_dict(description['task'])
  robot = config.robot
  mode_set = mode_set.for_feet(robot.num_feet)
  size = task_observations.size(
    mode_set.latent_dim, extra=config.extra_observations, robot=robot
  )
  activation = description.get('activation', 'elu')  # As it once was.
  if activation not in networks.ACTIVATIONS:
    raise ValueError(f'activation {activation!r} is unknown.')
  more = int(description.get('privileged_size', 0))
  if not 0 <= more <= _MAX_UNITS:
    raise ValueError(f'privileged size {more} is out of bounds.')
  with torch.device('meta'):  # Allocates no memory.
    network = networks.ActorCritic(
      size,
      robot.num_joints,
      hidden,
      privileged_size=more,
      activation=activation,
    )
  return Policy(
    network,
    hidden,
    mode_set,
    config,
    dict(description.get('provenance', {})),
  )


def _load_weights(network: networks.ActorCritic, path: pathlib.Path) -> None:
  if not path.is_file():
    raise FileNotFoundError(f'{path} does not exist.')
  files.check_size(path)
  weights, metadata = checkpointing.load_tensors(path)
  if metadata.get('format') != _FORMAT:
    raise ValueError(f'{path} does not hold the weights of a policy.')
  expected = {k: tuple(v.shape) for k, v in network.state_dict().items()}
  found = {k: tuple(v.shape) for k, v in weights.items()}
  if expected != found:
    wrong = next(
      k for k in [*expected, *found] if expected.get(k) != found.get(k)
    )
    raise ValueError(
      f'{path}: {wrong} has shape {found.get(wrong)}, expected '
      f'{expected.get(wrong)}; the weights are of another network or of other '
      'latents.'
    )
  cast = {k: weights[k].to(v.dtype) for k, v in network.state_dict().items()}
  if not all(torch.isfinite(v).all() for v in cast.values()):
    raise ValueError(f'{path} holds weights that are not finite.')
  network.load_state_dict(cast, assign=True)
