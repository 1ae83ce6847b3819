"""Mode sets: reference motions with their latents.

Tasks, policies, plans and trainings refer to modes by index in a set.
"""

import dataclasses
from typing import Sequence

import numpy as np

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import reference


@dataclasses.dataclass(frozen=True, eq=False)
class ModeSet:
  """M modes in the order of their indices.

  Attributes:
    motions: the reference motions, length M.
    codebook: the latents of the same modes, in the same order.
    bank: the motions, stacked for batches of worlds.

  Raises:
    ValueError: the set is empty, two modes have the same name, or the codebook
      has other modes.
  """

  motions: tuple[motion_lib.ReferenceMotion, ...]
  codebook: codebook_lib.Codebook
  bank: reference.ReferenceBank = dataclasses.field(init=False, repr=False)

  def __post_init__(self) -> None:
    object.__setattr__(self, 'motions', tuple(self.motions))
    # Stacking is slow, so that it is done once for all users of the set.
    object.__setattr__(self, 'bank', reference.ReferenceBank(self.motions))
    if self.codebook.names != self.names:
      raise ValueError(
        f'The codebook encodes {self.codebook.names}, the motions are '
        f'{self.names}.'
      )

  def __len__(self) -> int:
    return len(self.motions)

  @property
  def names(self) -> tuple[str, ...]:
    """Names of the modes, length M."""
    return self.bank.names

  @property
  def latents(self) -> np.ndarray:
    """Latents, without unit, float32, [M, n_m]."""
    return self.codebook.latents

  @property
  def latent_dim(self) -> int:
    """Length n_m of a latent."""
    return self.codebook.latent_dim

  def index(self, name: str) -> int:
    """Returns a mode's index; raises ValueError naming the known modes."""
    return self.bank.index(name)

  def subset(self, names: Sequence[str]) -> 'ModeSet':
    """Returns the modes of `names`, in their order."""
    motions = tuple(self.motions[self.index(name)] for name in names)
    return ModeSet(motions, self.codebook.subset(names))


def one_hot(motions: Sequence[motion_lib.ReferenceMotion]) -> ModeSet:
  """Returns a mode set with one-hot latents, the baseline: n_m = M."""
  names = tuple(motion.name for motion in motions)
  latents = np.eye(len(names), dtype=np.float32)
  return ModeSet(tuple(motions), codebook_lib.Codebook(names, latents))
