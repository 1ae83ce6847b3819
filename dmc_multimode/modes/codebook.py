"""Latents of modes, and their file: one row a mode."""

import dataclasses
import json
import pathlib
from typing import Sequence

import numpy as np

from dmc_multimode.utils import files

FILE = 'codebook.json'
_MAX_BYTES = 1 << 20  # Larger files are rejected.


@dataclasses.dataclass(frozen=True, eq=False)
class Codebook:
  """Latents of modes in the policy's observation.

  Attributes:
    names: the modes' names, length M, in the order of their mode indices.
    latents: without unit, float32, [M, n_m].
  """

  names: tuple[str, ...]
  latents: np.ndarray

  def __post_init__(self) -> None:
    object.__setattr__(self, 'names', tuple(self.names))
    latents = np.array(self.latents, dtype=np.float32)
    latents.setflags(write=False)
    object.__setattr__(self, 'latents', latents)
    if not self.names:
      raise ValueError('A codebook needs at least one mode.')
    if len(set(self.names)) != len(self.names):
      raise ValueError(f'Mode names must be unique, got {self.names}.')
    expected = len(self.names)
    if latents.ndim != 2 or len(latents) != expected or latents.shape[1] < 1:
      raise ValueError(
        f'A codebook of {expected} modes needs latents of shape '
        f'[{expected}, n_m], got {list(latents.shape)}.'
      )
    if not np.isfinite(latents).all():
      raise ValueError('The latents of a codebook must be finite.')

  def __len__(self) -> int:
    return len(self.names)

  @property
  def latent_dim(self) -> int:
    """Returns n_m, the length of a latent."""
    return self.latents.shape[1]

  def index(self, name: str) -> int:
    """Returns a mode's row; raises ValueError naming the known modes."""
    if name not in self.names:
      raise ValueError(
        f'Unknown mode {name!r}; this codebook has {", ".join(self.names)}.'
      )
    return self.names.index(name)

  def distances(self) -> np.ndarray:
    """Returns the Euclidean distances between the latents, [M, M]."""
    latents = self.latents.astype(np.float64)
    return np.linalg.norm(latents[:, None] - latents[None], axis=-1)

  def subset(self, names: Sequence[str]) -> 'Codebook':
    """Returns the rows of `names`, in their order."""
    rows = [self.index(name) for name in names]
    return Codebook(tuple(names), self.latents[rows])

  def to_json(self) -> str:
    """Returns the codebook as JSON."""
    rows = {
      name: [float(value) for value in row]
      for name, row in zip(self.names, self.latents, strict=True)
    }
    return json.dumps({'latents': rows}, indent=2)

  def save(self, directory: pathlib.Path) -> None:
    """Writes `codebook.json` into a folder, atomically."""
    files.write(directory / FILE, self.to_json().encode())

  def separation(self) -> float:
    """Returns the smallest over the mean distance between two modes.

    The separation is 1 for a single mode and for one-hot codes, and 0 if two
    modes share a latent (mode aliasing by construction).
    """
    between = self.distances()[np.triu_indices(len(self), 1)]
    if not between.size:
      return 1.0
    return float(between.min() / max(between.mean(), 1e-12))


def load(path: pathlib.Path) -> Codebook:
  """Reads a codebook.

  Raises:
    FileNotFoundError: the file does not exist.
    ValueError: the file is not a codebook.
  """
  content = files.read_json(path, _MAX_BYTES)
  try:
    rows = content['latents']
    return Codebook(tuple(rows), np.array(list(rows.values()), np.float32))
  except (
    AttributeError,
    KeyError,
    OverflowError,
    TypeError,
    ValueError,
  ) as error:
    raise ValueError(f'{path} is not a codebook: {error}') from error
