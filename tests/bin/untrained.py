"""An untrained policy on disk, for binaries that load one."""

import pathlib
from typing import Any, Mapping, Sequence

from dmc_multimode import pretrained
from dmc_multimode.agents.ppo import networks
from dmc_multimode.modes import codebook
from dmc_multimode.modes import library
from dmc_multimode.suite import config
from dmc_multimode.suite import observations


def save(
  folder: pathlib.Path,
  modes: Sequence[str],
  task: config.ImitationConfig,
  provenance: Mapping[str, Any],
) -> None:
  """Writes a small policy with one-hot commands for `modes` into a folder."""
  motions = library.resolve(modes)
  book = codebook.one_hot(motions)
  size = 2 + book.latent_dim + observations.STATE_SIZE
  network = networks.ActorCritic(size, observations.NUM_JOINTS, (8,))
  pretrained.Policy(network, (8,), motions, book, task, provenance).save(folder)
