"""Trainings that start from a policy: initial weights and defaults.

The policy's modes keep their motions and, to the bit, their latents; new modes
get latents of their own from the policy's encoder, which is trained on for them
(`modes.encoder.extension`). So the network keeps its size, and all weights are
reused.
"""

import dataclasses
import pathlib

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.experiments import config as run_config
from dmc_multimode.experiments import run_folder
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes.encoder import extension
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import events as events_lib
from dmc_multimode.suite.imitation import mode_sampler
from dmc_multimode.suite.imitation import observations
from dmc_multimode.utils import files
from dmc_multimode.utils import resources
from dmc_multimode.utils import schedule

# Enough exploration to find a new motion near the known ones.
_INITIAL_STD, _LEAST_STD, _FINAL_STD = 0.18, 0.14, 0.05  # Radians.
_ANNEALING = (0.25, 0.85)  # Start and end, shares of the training.
# A new motion close to a known one earns nearly as much unlearned: a slight
# crouch as much as a squat. So new modes are practised more, and advantages are
# normalised by mode. Kickstarting holds the known modes meanwhile.
_FOCUS_FRACTION, _KICKSTARTING_WEIGHT = 0.5, 0.3
_DETERMINISTIC_FRACTION = 0.3
_DETERMINISTIC_START = 0.5  # Start, a share of the training.

Motions = tuple[motion_lib.ReferenceMotion, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
  """The policy that a training starts from.

  Attributes:
    name: of the policy, as it was given.
    policy: source of the network and the known modes.
    encoder: mode encoder of the policy's latents.
  """

  name: str
  policy: pretrained.Policy
  encoder: mode_encoder.ModeEncoder

  def config(self, motions: Motions, steps: int) -> run_config.RunConfig:
    """Returns the defaults of a training.

    These are the final values of the policy's own training, but for the
    exploration, which rises again, and the settings for new modes. Robots are
    neither pushed nor varied, and their sensors have no noise: a policy that is
    pushed while it learns a squat learns to crouch.

    Args:
      motions: the modes of the training.
      steps: length of the training, environment steps.
    """
    policy, before = self.policy, _trained_with(self.policy)
    start, end = (int(share * steps) for share in _ANNEALING)
    ppo = dataclasses.replace(
      before.ppo,
      hidden_sizes=policy.hidden_sizes,
      activation=policy.network.activation,
      privileged_critic=policy.network.privileged_size > 0,
      initial_std=_INITIAL_STD,
      std_floor=schedule.Schedule(
        _LEAST_STD, _FINAL_STD, start, end, 'geometric'
      ),
      deterministic_fraction=schedule.step(
        _DETERMINISTIC_FRACTION, int(_DETERMINISTIC_START * steps)
      ),
      advantages='mode',
      kickstarting_weight=_KICKSTARTING_WEIGHT,
    )
    sampling = _focused(before.sampling, self.new(motions), steps)
    events = _undisturbed(policy.config.events)
    return run_config.RunConfig(
      modes=','.join(motion.name for motion in motions),
      steps=steps,
      init_from=self.name,
      init_modes=','.join(policy.mode_set.names),
      ppo=ppo,
      sampling=sampling,
      task=dataclasses.replace(policy.config, events=events),
    )

  def new(self, motions: Motions) -> Motions:
    """Returns the motions that the policy does not know."""
    known = set(self.policy.mode_set.names)
    return tuple(motion for motion in motions if motion.name not in known)

  def modes(self, spec: str | None, extra: Motions = ()) -> Motions:
    """Resolves `spec` to motions; the policy's definitions win.

    Args:
      spec: a set's name or mode names, comma-separated; None for those of the
        policy and `extra`.
      extra: modes that may be named besides the policy's and the library's.

    Raises:
      ValueError: a name is unknown, or names another motion in the policy.
    """
    known = {motion.name: motion for motion in self.policy.mode_set.motions}
    for motion in extra:
      mine = known.get(motion.name)
      if mine and mode_files.motion_to_dict(mine) != mode_files.motion_to_dict(
        motion
      ):
        raise ValueError(
          f'{self.name} knows another motion by the name of {motion.name!r}: '
          'give yours a name of its own.'
        )
    named = (*extra, *known.values())
    height = self.policy.config.robot.stand_height
    if spec is None:
      every = [*known, *(m.name for m in self.new(extra))]
      return library.resolve(every, named, height)
    return library.resolve(spec, named, height)

  def check(self, config: run_config.RunConfig) -> None:
    """Raises ValueError if a configuration has another network."""
    network = self.policy.network
    expected = {
      'hidden_sizes': self.policy.hidden_sizes,
      'activation': network.activation,
      'privileged_critic': network.privileged_size > 0,
    }
    for field, value in expected.items():
      if getattr(config.ppo, field) != value:
        raise ValueError(
          f'--ppo_{field}: the weights of {self.name} are taken over, and it '
          f'has {value}.'
        )
    mine = self.policy.config.extra_observations
    if config.task.extra_observations != mine:
      raise ValueError(
        f'--task_extra_observations={",".join(mine)}: {self.name} observes '
        f'{"these" if mine else "none"} beyond the paper.'
      )
    if config.one_hot:
      raise ValueError(f'--one_hot: {self.name} knows modes by their latents.')
    size, latent_dim = observations.size, self.policy.mode_set.latent_dim
    terms = config.task.observed_terms
    robot = config.task.robot
    more = size(latent_dim, True, terms, robot)
    more -= size(latent_dim, extra=terms, robot=robot)
    if network.privileged_size not in (0, more):
      raise ValueError(
        f'The value function of {self.name} sees {network.privileged_size} '
        f'privileged numbers and not {more}: draw disturbances '
        '(--task_events_disturbances_*) if its training did, and only then.'
      )

  def encode(
    self, motions: Motions
  ) -> tuple[mode_encoder.ModeEncoder, mode_set_lib.ModeSet]:
    """Returns an encoder of known and new modes, and their codebook.

    Raises:
      ValueError: the encoder belongs to another policy, or cannot separate the
        modes.
    """
    encoder, mode_set = extension.extend(
      self.encoder, self.policy.mode_set, self.new(motions)
    )
    return encoder, mode_set.subset([motion.name for motion in motions])


def load(name: str, encoder: str | None = None) -> Start:
  """Loads the policy and encoder that a training starts from.

  Args:
    name: of a shipped policy, or a folder of a policy or of a run.
    encoder: folder of the policy's encoder; by default the one beside the
      policy, or in its run.

  Raises:
    FileNotFoundError: there is no such policy.
    ValueError: a file is damaged, the encoder is missing, or the policy has no
      latents.
  """
  policy = pretrained.load(name)
  if np.array_equal(policy.mode_set.latents, np.eye(len(policy.mode_set))):
    raise ValueError(
      f'{name} knows its modes by one-hot commands, which leave no room for '
      'another: begin with a policy that has latents.'
    )
  folder = (
    pathlib.Path(files.expand(encoder)) if encoder else find_encoder(name)
  )
  return Start(name, policy, mode_encoder.load(folder))


def find_encoder(name: str) -> pathlib.Path:
  """Returns the folder of the encoder that belongs to a policy.

  Raises:
    ValueError: there is none beside the policy, nor in its run.
  """
  path = pathlib.Path(files.expand(name))
  folders = [
    path,  # A policy that ships with its encoder.
    path / run_folder.ENCODER,  # A run.
    path.parent / run_folder.ENCODER,  # RUN/policy.
    path.parent.parent / run_folder.ENCODER,  # RUN/policies/STEPS.
  ]
  if not any(
    (folder / policy_lib.DESCRIPTION_FILE).is_file()
    for folder in (path, path / policy_lib.RUN_SUBFOLDER)
  ):
    folders = [resources.path('pretrained', name)]
  for folder in folders:
    if (folder / mode_encoder.CONFIG_FILE).is_file():
      return folder
  raise ValueError(
    f'{name} has no mode encoder beside it: name the folder of the one that it '
    'was trained with, --encoder=DIR.'
  )


def _undisturbed(
  trained: events_lib.TrainingEvents,
) -> events_lib.TrainingEvents:
  """Returns final events, without pushes, disturbances and sensor noise."""
  none = schedule.constant(0.0)
  return dataclasses.replace(
    trained.at_end(),
    push_speed=none,
    disturbance_share=none,
    sensor_noise=none,
  )


def _focused(
  trained: mode_sampler.SamplingConfig, new: Motions, steps: int
) -> mode_sampler.SamplingConfig:
  """Returns final settings of the sampling, with a focus on new modes."""
  return dataclasses.replace(
    trained,
    gait_fraction=schedule.constant(0.0),
    clock_rate_fraction=trained.clock_rate_fraction.at_end(),
    string_fraction=trained.string_fraction.at_end(),
    focus=','.join(motion.name for motion in new),
    focus_fraction=schedule.constant(_FOCUS_FRACTION),
    focus_end=steps,
  )


def _trained_with(policy: pretrained.Policy) -> run_config.RunConfig:
  """Returns the training configuration of a policy, with current keys."""
  try:
    return run_config.from_dict(policy.provenance['run'])
  except (KeyError, ValueError):
    return run_config.RunConfig()
