"""Mode selector: a small network that commands modes from what the robot sees.

Where a search needs the simulator, the selector needs the observations of the
`reach_*` tasks: the state of the robot, its running mode, the ground ahead and
the goal. It chooses once a knot, among the modes that the robot can obey.

A selector is a folder of

    selector.safetensors  weights and observation normaliser
    selector.json         its observations, modes and low-level policy
"""

import dataclasses
import os
import pathlib
from typing import Any, Mapping

import numpy as np
import torch
from torch import nn

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents.ppo import networks
from dmc_multimode.utils import files

WEIGHTS_FILE = 'selector.safetensors'
DESCRIPTION_FILE = 'selector.json'
_FORMAT = 'dmc_multimode.selector.1'
_FAR = 2.0  # Metres: goals farther away are all alike.
_UNSEEN = ('knots_left',)  # An endless track has no last knot.
_MAX_UNITS = 4096

Layout = tuple[tuple[str, int], ...]


class SelectorNetwork(nn.Module):
  """pi(m | o), a categorical distribution over M modes, and v(o)."""

  _seen: torch.Tensor
  _far: torch.Tensor

  def __init__(
    self, layout: Layout, num_modes: int, hidden_sizes: tuple[int, ...]
  ):
    """Initialises orthogonally; at first all modes are about as likely.

    Args:
      layout: (name, size) of the parts of an observation, in order.
      num_modes: M.
      hidden_sizes: of both networks.
    """
    super().__init__()
    size = sum(length for _, length in layout)
    start, seen = 0, np.ones(size, dtype=bool)
    far = np.full(size, np.inf)
    for name, length in layout:
      here = slice(start, start + length)
      seen[here] = name not in _UNSEEN
      far[here] = _FAR if name == 'goal' else np.inf
      start += length
    self.register_buffer('_seen', torch.from_numpy(seen), persistent=False)
    self.register_buffer(
      '_far', torch.from_numpy(far).float(), persistent=False
    )
    self.normaliser = networks.Normaliser(size)
    self.policy = networks.mlp((size, *hidden_sizes, num_modes), 'silu')
    self.value = networks.mlp((size, *hidden_sizes, 1), 'silu')
    for network, gain in ((self.policy, 0.01), (self.value, 1.0)):
      networks.initialise(network, gain)

  def prepare(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns raw observations [..., D] without what is not to be seen."""
    near = torch.minimum(observations, self._far).maximum(-self._far)
    return near * self._seen

  def forward(
    self, observations: torch.Tensor, obeyed: torch.Tensor
  ) -> torch.Tensor:
    """Returns log-probabilities of the modes, [N, M].

    Args:
      observations: raw, [N, D].
      obeyed: modes that may be chosen, at least one a row, [N, M].
    """
    logits = self.policy(self.normaliser(self.prepare(observations)))
    return torch.log_softmax(logits.masked_fill(~obeyed, -torch.inf), dim=-1)

  def values(self, observations: torch.Tensor) -> torch.Tensor:
    """Returns the values of raw observations [..., D], [...]."""
    seen = self.normaliser(self.prepare(observations))
    return self.value(seen).squeeze(-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Selector:
  """A trained selector.

  Attributes:
    network: its network.
    layout: (name, size) of the parts of its observations, in order; those of
      `ReachingWorlds.layout`.
    mode_names: the modes, in the order of their indices.
    policy: the low-level policy that it was trained with, as it was named.
    hidden_sizes: of the network.
    knot_duration: seconds between choices.
    provenance: configuration and steps of its training.
  """

  network: SelectorNetwork
  layout: Layout
  mode_names: tuple[str, ...]
  policy: str
  hidden_sizes: tuple[int, ...]
  knot_duration: float
  provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)

  def __repr__(self) -> str:
    """Returns one line: policy, modes and knots."""
    return (
      f'Selector({", ".join(self.mode_names)}; policy {self.policy}, '
      f'a choice every {self.knot_duration:g} s)'
    )

  @torch.no_grad()
  def select(self, observations: np.ndarray, obeyed: np.ndarray) -> np.ndarray:
    """Returns the likeliest mode of each world, [B].

    Args:
      observations: float32 [B, D].
      obeyed: modes that may be chosen, [B, M].
    """
    scores = self.network(
      torch.from_numpy(observations), torch.from_numpy(obeyed)
    )
    return scores.argmax(dim=-1).numpy()

  @torch.no_grad()
  def sample(
    self,
    observations: np.ndarray,
    obeyed: np.ndarray,
    random_state: np.random.RandomState,
    temperature: float = 1.0,
  ) -> np.ndarray:
    """Returns a mode for each world, [B]: drawn; in the first the likeliest.

    Args:
      observations: float32 [B, D].
      obeyed: modes that may be chosen, [B, M].
      random_state: source of the draws.
      temperature: by which the last world divides its log-probabilities; the
        first's is 1, and those between form a geometric series.
    """
    scores = self.network(
      torch.from_numpy(observations), torch.from_numpy(obeyed)
    ).numpy()
    scores /= np.geomspace(1.0, temperature, len(scores))[:, None]
    # The largest of log-probabilities with Gumbel noise is a draw.
    noise = random_state.gumbel(size=scores.shape)
    noise[0] = 0.0
    return np.argmax(scores + noise, axis=1)

  @torch.no_grad()
  def values(self, observations: np.ndarray) -> np.ndarray:
    """Returns the values of observations, float32 [B, D]: [B]."""
    return self.network.values(torch.from_numpy(observations)).numpy()

  def save(self, path: str | os.PathLike[str]) -> None:
    """Writes the selector's files into a folder, each atomically.

    Raises:
      OSError: the folder cannot be written.
    """
    directory = pathlib.Path(files.expand(path))
    directory.mkdir(parents=True, exist_ok=True)
    checkpointing.save_tensors(
      directory / WEIGHTS_FILE, self.network.state_dict(), {'format': _FORMAT}
    )
    files.write_json(
      directory / DESCRIPTION_FILE,
      {
        'format': _FORMAT,
        'policy': self.policy,
        'modes': list(self.mode_names),
        'layout': [list(part) for part in self.layout],
        'hidden_sizes': list(self.hidden_sizes),
        'knot_duration': self.knot_duration,
        'provenance': dict(self.provenance),
      },
    )


def load(path: str | os.PathLike[str]) -> Selector:
  """Loads a selector from its folder.

  Raises:
    FileNotFoundError: the folder holds no selector.
    ValueError: a file is damaged, foreign, or does not fit the other.
  """
  directory = pathlib.Path(files.expand(path))
  described = directory / DESCRIPTION_FILE
  if not described.is_file():
    raise FileNotFoundError(f'{directory} holds no {DESCRIPTION_FILE}.')
  values = files.read_json(described)
  try:
    if values['format'] != _FORMAT:
      raise ValueError('it is not a selector of this version')
    layout = tuple((str(name), int(size)) for name, size in values['layout'])
    hidden = tuple(int(size) for size in values['hidden_sizes'])
    names = tuple(str(name) for name in values['modes'])
    sizes = (*hidden, *(size for _, size in layout), len(names))
    if not all(0 < size <= _MAX_UNITS for size in sizes):
      raise ValueError('a size is out of bounds')
    found = Selector(
      SelectorNetwork(layout, len(names), hidden),
      layout,
      names,
      str(values['policy']),
      hidden,
      float(values['knot_duration']),
      dict(values.get('provenance', {})),
    )
    tensors, _ = checkpointing.load_tensors(directory / WEIGHTS_FILE)
    found.network.load_state_dict(tensors)
  except (KeyError, TypeError, ValueError, RuntimeError) as error:
    lacks = isinstance(error, KeyError)
    reason = f'it lacks {error}' if lacks else ' '.join(str(error).split())
    raise ValueError(f'{described} is damaged: {reason}.') from error
  return found
