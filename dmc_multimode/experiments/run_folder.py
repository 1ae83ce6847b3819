"""The folder of a run: all its files, and reading and writing them.

config.json             configuration, modes and latents
encoder/                the mode encoder, but for one-hot commands
initial/                the initial policy, if any
checkpoint.safetensors  state for `--resume`; the previous one beside it
policy/                 the newest policy
policies/STEPS/         policies that are kept permanently
metrics.csv             a row every few iterations
tensorboard/            the same
launch                  id of the launch of `torchrun` that began the run
"""

import json
import os
import pathlib

from dmc_multimode.agents import checkpointing
from dmc_multimode.experiments import config as run_config
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.utils import files

CONFIG_FILE = 'config.json'
ENCODER = 'encoder'
INITIAL = 'initial'
METRICS_FILE = 'metrics.csv'

Description = tuple[run_config.RunConfig, mode_set_lib.ModeSet]


class RunFolder:
  """A run on disk.

  Attributes:
    path: of the folder, which need not exist.
    checkpointer: of the run.
  """

  def __init__(self, path: str | os.PathLike[str]):
    """Refers to a folder; creates nothing."""
    self.path = pathlib.Path(files.expand(path))
    self.checkpointer = checkpointing.Checkpointer(self.path)
    self.config = self.path / CONFIG_FILE
    self.encoder = self.path / ENCODER
    self.initial = self.path / INITIAL
    self.policy = self.path / policy_lib.RUN_SUBFOLDER
    self.metrics = self.path / METRICS_FILE
    self.tensorboard = self.path / 'tensorboard'
    self.launch = self.path / 'launch'

  def __repr__(self) -> str:
    """Returns one line."""
    return f'RunFolder({str(self.path)!r})'

  def kept_policy(self, steps: int) -> pathlib.Path:
    """Returns the folder of the policy kept after `steps`."""
    return self.path / 'policies' / str(steps)

  def holds_run(self) -> bool:
    """Returns True if the folder holds a run."""
    return self.config.exists() or self.checkpointer.exists()

  def save(
    self, config: run_config.RunConfig, mode_set: mode_set_lib.ModeSet
  ) -> None:
    """Writes configuration and modes, for a resumed run."""
    files.write(self.config, describe(config, mode_set).encode())

  def load(self) -> Description:
    """Returns the configuration and modes that `save` wrote.

    Raises:
      FileNotFoundError: the folder holds no run.
      ValueError: the file is damaged.
    """
    if not self.config.is_file():
      raise FileNotFoundError(
        f'{self.path} holds no run to resume; start one without --resume (from '
        'Python resume=False).'
      )
    content = files.read_bounded(self.config)
    try:
      return parse(content.decode())
    except ValueError as error:
      raise ValueError(f'{self.config} is damaged: {error}') from error

  def load_initial(
    self, config: run_config.RunConfig
  ) -> policy_lib.Policy | None:
    """Returns the initial policy, or None without one.

    Raises:
      FileNotFoundError: the policy is missing.
      ValueError: the policy is damaged.
    """
    return policy_lib.load(self.initial) if config.init_from else None


def describe(
  config: run_config.RunConfig, mode_set: mode_set_lib.ModeSet
) -> str:
  """Returns configuration and modes as JSON, for `parse`."""
  description = {
    'run': run_config.to_dict(config),
    **mode_files.mode_set_to_dict(mode_set),
  }
  return json.dumps(description, indent=1)


def parse(text: str) -> Description:
  """Returns the arguments of `describe`; raises ValueError for other text."""
  try:
    description = json.loads(text)
    mode_set = mode_files.mode_set_from_dict(description)
    return run_config.from_dict(description['run']), mode_set
  except KeyError as error:
    raise ValueError(f'it lacks {error}') from error
  except (TypeError, OverflowError, RecursionError) as error:
    raise ValueError(str(error)) from error
