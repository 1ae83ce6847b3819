"""Checkpoints: one safetensors file each, replaced atomically.

A training's checkpoint has tensors with these keys (`runner.TrainingLoop`):

    learner/network/*          state dictionary of the `ActorCritic`
    learner/optimiser/P/N/*    Adam's moments; P is policy or value, N a number
    learner/generator          of the minibatches
    learner/learning_rate
    actor/*                    noise generator, mask of deterministic worlds
    environment/*              worlds, Algorithm 1, assistance, random numbers
    tracker/*                  running means of `statistics.ReturnTracker`
    rankR/*                    actor, environment and generator of rank R > 0

Metadata are `steps`, `iterations`, `format`; if any, `ranks` and `diverged`.
"""

import json
import os
import pathlib
from typing import Any, Mapping
import zlib

import numpy as np
import safetensors
from safetensors import torch as safetensors_torch
import torch

from dmc_multimode.agents import distributed
from dmc_multimode.utils import files

_FORMAT = 'dmc_multimode.checkpoint.1'
_MAX_BYTES = 4 << 30  # Larger files are rejected.
NAME = 'checkpoint.safetensors'
PREVIOUS = 'checkpoint.previous.safetensors'


def save_tensors(
  path: pathlib.Path,
  tensors: Mapping[str, torch.Tensor | np.ndarray],
  metadata: Mapping[str, Any],
) -> None:
  """Writes tensors and a JSON dictionary into one safetensors file.

  The file has a checksum: safetensors detects truncation, not flipped bits.
  """
  converted = {
    key: torch.as_tensor(value).cpu().contiguous()
    for key, value in tensors.items()
  }
  text = json.dumps(dict(metadata))
  strings = {'json': text, 'crc32': str(_checksum(converted, text))}
  files.write(path, safetensors_torch.save(converted, metadata=strings))


def _checksum(tensors: Mapping[str, torch.Tensor], text: str) -> int:
  """Returns the CRC-32 of all tensors and of the metadata text."""
  found = zlib.crc32(text.encode())
  for key in sorted(tensors):
    value = tensors[key]
    found = zlib.crc32(f'{key} {value.dtype} {value.shape}'.encode(), found)
    # A scalar cannot be viewed as bytes, a row of one number can.
    bits = value.contiguous().reshape(-1).view(torch.uint8)
    found = zlib.crc32(bits.numpy().data, found)
  return found


def load_tensors(
  path: pathlib.Path,
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
  """Returns the tensors and metadata of a file of `save_tensors`.

  Raises:
    FileNotFoundError: there is no such file.
    ValueError: the file is truncated, damaged or of another kind.
  """
  if not path.is_file():
    raise FileNotFoundError(f'{path} does not exist.')
  files.check_size(path, _MAX_BYTES)
  try:
    with safetensors.safe_open(str(path), framework='pt') as file:
      strings = file.metadata() or {}
      metadata = json.loads(strings['json'])
      if not isinstance(metadata, dict):
        raise ValueError('its metadata is no object.')
      tensors = {key: file.get_tensor(key) for key in file.keys()}
    # Older files have no checksum.
    if 'crc32' in strings:
      if strings['crc32'] != str(_checksum(tensors, strings['json'])):
        raise ValueError('its checksum is of other content.')
  except (
    safetensors.SafetensorError,
    AttributeError,  # A dtype that this torch does not know.
    KeyError,
    RuntimeError,  # Likewise; and RecursionError is one.
    ValueError,
  ) as error:
    raise ValueError(
      f'{path} is truncated or was not written by dmc_multimode: {error}'
    ) from error
  return tensors, metadata


class Checkpointer:
  """Keeps the newest two checkpoints of a run."""

  def __init__(self, directory: pathlib.Path):
    """Keeps checkpoints in `directory`, which must exist."""
    self._directory = directory
    self._newest_is_damaged = False

  @property
  def path(self) -> pathlib.Path:
    """Path of the newest checkpoint."""
    return self._directory / NAME

  def exists(self) -> bool:
    """Returns True if there is a checkpoint to resume from."""
    return self.path.exists() or (self._directory / PREVIOUS).exists()

  def save(
    self,
    tensors: Mapping[str, torch.Tensor | np.ndarray],
    metadata: Mapping[str, Any],
  ) -> None:
    """Writes a checkpoint; the one before it stays as a fallback."""
    newest = self._directory / f'.{NAME}.new'
    save_tensors(newest, tensors, {**metadata, 'format': _FORMAT})
    # A damaged checkpoint must not replace the one that was resumed.
    if self.path.exists() and not self._newest_is_damaged:
      os.replace(self.path, self._directory / PREVIOUS)
    os.replace(newest, self.path)
    self._newest_is_damaged = False

  def load(self) -> tuple[dict[str, torch.Tensor], dict[str, Any], str]:
    """Reads the newest checkpoint that is intact.

    Returns:
      Tensors, metadata, and a warning if it is not the newest; otherwise ''.

    Raises:
      FileNotFoundError: there is no checkpoint.
      ValueError: no checkpoint is intact.
    """
    problem = ''
    for path in (self.path, self._directory / PREVIOUS):
      try:
        tensors, metadata = load_tensors(path)
      except (FileNotFoundError, ValueError) as error:
        problem = problem or str(error)
        continue
      if (
        metadata.get('format') != _FORMAT
        or type(metadata.get('steps')) is not int
      ):
        problem = problem or f'{path} is not a training checkpoint.'
        continue
      self._newest_is_damaged = bool(problem)
      note = f'{problem} Resuming from {path.name}.' if problem else ''
      return tensors, metadata, note
    if not self.exists():
      raise FileNotFoundError(f'{self.path} does not exist.')
    raise ValueError(problem)


# Prefixes of the tensors that differ by rank.
_OWN = ('actor/', 'environment/', 'learner/generator')
_NETWORK = 'learner/network/'


def collect(
  communicator: distributed.Communicator,
  tensors: Mapping[str, torch.Tensor | np.ndarray],
) -> dict[str, Any]:
  """Collects the states of all ranks at rank 0.

  Returns:
    At rank 0 its `tensors` and, as `rank1/NAME`, those of other ranks that
    differ by rank; at other ranks only their own.

  Raises:
    ValueError: the ranks do not hold the same network.
  """
  if communicator.size == 1:
    return dict(tensors)
  state = {name: torch.as_tensor(value) for name, value in tensors.items()}
  network = [v for k, v in state.items() if k.startswith(_NETWORK)]
  checksum = zlib.crc32(b''.join(v.cpu().numpy().tobytes() for v in network))
  if len(communicator.gather(torch.tensor([checksum])).unique()) > 1:
    raise ValueError(
      'The ranks no longer hold the same network: resume from the last '
      'checkpoint, on machines of one kind.'
    )
  own = {k: v.contiguous() for k, v in state.items() if k.startswith(_OWN)}
  payloads = communicator.collect(
    safetensors_torch.save(own) if communicator.rank else b''
  )
  for rank, payload in enumerate(payloads[1:], start=1):
    others = safetensors_torch.load(payload)
    state |= {f'rank{rank}/{name}': value for name, value in others.items()}
  return state


def scatter(
  communicator: distributed.Communicator,
  tensors: Mapping[str, torch.Tensor],
  values: Mapping[str, Any],
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
  """Returns each rank's part of the result of `collect`.

  Args:
    communicator: of the ranks.
    tensors, values: a checkpoint; ignored at ranks other than 0.

  Raises:
    ValueError: the checkpoint has another number of ranks.
  """

  def text() -> str:
    if values.get('ranks', 1) != communicator.size:
      raise ValueError(
        f'The checkpoint is of {values.get("ranks", 1)} processes, this run '
        f'has {communicator.size}: resume it with as many.'
      )
    return json.dumps(dict(values))

  shared = json.loads(distributed.from_first(communicator, text))
  if communicator.size == 1:
    return dict(tensors), shared
  payloads = []
  if communicator.rank == 0:
    payloads = [
      safetensors_torch.save(_of_rank(tensors, rank))
      for rank in range(communicator.size)
    ]
  return safetensors_torch.load(communicator.scatter(payloads)), shared


def _of_rank(
  tensors: Mapping[str, torch.Tensor], rank: int
) -> dict[str, torch.Tensor]:
  """Returns the state of one rank from the state of all ranks."""
  shared = {k: v for k, v in tensors.items() if not k.startswith('rank')}
  if not rank:
    return shared
  prefix = f'rank{rank}/'
  return {k: tensors.get(prefix + k, v) for k, v in shared.items()}
