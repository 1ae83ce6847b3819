"""Untrained policies on disk, for binaries that load one."""

import pathlib
from typing import Any, Mapping, Sequence

from dmc_multimode import pretrained
from dmc_multimode.agents.ppo import networks
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import training as encoder_training
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import observations
from dmc_multimode.walkers import mini_biped


def save(
  folder: pathlib.Path,
  modes: Sequence[str],
  task: task_config.ImitationConfig,
  provenance: Mapping[str, Any],
) -> None:
  """Writes a small policy with one-hot commands for `modes` into a folder."""
  known = mode_set.one_hot(library.resolve(modes))
  size = observations.size(known.latent_dim)
  network = networks.ActorCritic(size, len(mini_biped.JOINTS), (8,))
  pretrained.Policy(network, (8,), known, task, provenance).save(folder)


def save_with_encoder(
  folder: pathlib.Path,
  modes: Sequence[str],
  provenance: Mapping[str, Any],
  task: task_config.ImitationConfig | None = None,
) -> pretrained.Policy:
  """Writes and returns one with latents; the encoder is as untrained."""
  encoder = encoder_training.train(
    library.resolve(modes),
    mode_encoder.EncoderConfig(hidden=4, max_rmse=9.0, min_separation=0.0),
  )
  encoder.save(folder)
  book = encoder.codebook()
  size = observations.size(book.latent_dim)
  policy = pretrained.Policy(
    networks.ActorCritic(
      size,
      len(mini_biped.JOINTS),
      (16,),
      privileged_size=observations.size(book.latent_dim, True) - size,
      activation='silu',
    ),
    (16,),
    mode_set.ModeSet(encoder.motions, book),
    task or task_config.ImitationConfig(),
    provenance,
  )
  policy.save(folder)
  return policy
