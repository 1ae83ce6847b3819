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

  def __repr__(self) -> str:
    """Returns one line: the modes."""
    return f'ModeSet({", ".join(self.names)})'

  def for_feet(self, count: int) -> 'ModeSet':
    """Returns the modes for a robot with `count` feet.

    Raises:
      ValueError: a mode has contacts of another number of feet.
    """
    if self.bank.num_feet == count:
      return self
    for motion in self.motions:
      if motion.num_feet not in (None, count):
        raise ValueError(
          f'{motion.name} has contacts of {motion.num_feet} feet, and the '
          f'robot has {count}: give it modes of its own, with contacts of '
          f'{count} feet or none.'
        )
    other = dataclasses.replace(self)
    bank = reference.ReferenceBank(self.motions, count)
    object.__setattr__(other, 'bank', bank)
    return other

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


def with_blends(mode_set: ModeSet, names: Sequence[str]) -> ModeSet:
  """Returns a mode set with the blends that `names` has besides.

  A blend such as 'walk_forward*0.5+idle*0.5' is the weighted mean of modes: of
  their references and of their latents. Weights sum to 1.

  Args:
    mode_set: the modes that there are.
    names: of modes, or blends.

  Raises:
    ValueError: a blend is malformed, has unknown modes, or modes that cannot be
      blended.
  """
  motions, latents = list(mode_set.motions), list(mode_set.latents)
  for name in dict.fromkeys(names):
    if not {'*', '+'} & set(name):
      continue
    weights = _parse_blend(name)
    rows = [mode_set.index(part) for part in weights]
    shares = np.array(list(weights.values()))
    parts = [mode_set.motions[row] for row in rows]
    motions.append(motion_lib.blend(parts, shares.tolist(), name))
    latents.append((shares @ mode_set.latents[rows]).astype(np.float32))
  if len(motions) == len(mode_set):
    return mode_set
  known = tuple(motion.name for motion in motions)
  codebook = codebook_lib.Codebook(known, np.stack(latents))
  return ModeSet(tuple(motions), codebook)


def _parse_blend(text: str) -> dict[str, float]:
  """Returns the weights by mode of a blend; see `with_blends`."""
  weights: dict[str, float] = {}
  for item in text.split('+'):
    name, _, weight = item.strip().partition('*')
    try:
      weights[name.strip()] = float(weight)
    except ValueError:
      weights[name.strip()] = float('nan')
  values = np.array(list(weights.values()))
  if not (np.all(values > 0) and abs(values.sum() - 1) < 1e-6):
    raise ValueError(
      f'{text!r} is no blend: write MODE*WEIGHT+MODE*WEIGHT with positive '
      'weights of sum 1, as in walk_forward*0.5+idle*0.5.'
    )
  return weights


def one_hot(motions: Sequence[motion_lib.ReferenceMotion]) -> ModeSet:
  """Returns a mode set with one-hot latents, the baseline: n_m = M."""
  names = tuple(motion.name for motion in motions)
  latents = np.eye(len(names), dtype=np.float32)
  return ModeSet(tuple(motions), codebook_lib.Codebook(names, latents))
