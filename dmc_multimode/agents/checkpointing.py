"""Checkpoints that are whole or not there: one safetensors file, renamed."""

import json
import os
import pathlib
from typing import Any, Mapping

import numpy as np
import safetensors
from safetensors import torch as safetensors_torch
import torch

from dmc_multimode import atomic

_FORMAT = 'dmc_multimode.checkpoint.1'
NAME = 'checkpoint.safetensors'
PREVIOUS = 'checkpoint.previous.safetensors'


def save_tensors(
  path: pathlib.Path,
  tensors: Mapping[str, torch.Tensor | np.ndarray],
  metadata: Mapping[str, Any],
) -> None:
  """Writes tensors and a JSON-able dictionary into one safetensors file."""
  converted = {
    key: torch.as_tensor(value).contiguous() for key, value in tensors.items()
  }
  text = {'json': json.dumps(dict(metadata))}
  atomic.write(path, safetensors_torch.save(converted, metadata=text))


def load_tensors(
  path: pathlib.Path,
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
  """Reads what `save_tensors` wrote.

  Raises:
    FileNotFoundError: there is no such file.
    ValueError: it is truncated, or not one of ours.
  """
  if not path.is_file():
    raise FileNotFoundError(f'{path} does not exist.')
  try:
    with safetensors.safe_open(str(path), framework='pt') as file:
      metadata = json.loads((file.metadata() or {})['json'])
      if not isinstance(metadata, dict):
        raise ValueError('its metadata is no object.')
      tensors = {key: file.get_tensor(key) for key in file.keys()}
  except (
    safetensors.SafetensorError,
    KeyError,
    ValueError,
    RecursionError,
  ) as error:
    raise ValueError(
      f'{path} is truncated or was not written by dmc_multimode: {error}'
    ) from error
  return tensors, metadata


class Checkpointer:
  """Keeps the newest two checkpoints of a run."""

  def __init__(self, directory: pathlib.Path):
    """Writes into `directory`, which must exist."""
    self._directory = directory
    self._newest_is_damaged = False

  @property
  def path(self) -> pathlib.Path:
    """The newest checkpoint."""
    return self._directory / NAME

  def exists(self) -> bool:
    """Whether there is anything to resume from."""
    return self.path.exists() or (self._directory / PREVIOUS).exists()

  def save(
    self,
    tensors: Mapping[str, torch.Tensor | np.ndarray],
    metadata: Mapping[str, Any],
  ) -> None:
    """Writes a checkpoint; the one before it stays as a fallback."""
    newest = self._directory / f'.{NAME}.new'
    save_tensors(newest, tensors, {**metadata, 'format': _FORMAT})
    # A damaged one must not take the place of the one that was resumed.
    if self.path.exists() and not self._newest_is_damaged:
      os.replace(self.path, self._directory / PREVIOUS)
    os.replace(newest, self.path)
    self._newest_is_damaged = False

  def load(self) -> tuple[dict[str, torch.Tensor], dict[str, Any], str]:
    """Reads the newest checkpoint that is whole.

    Returns:
      Tensors, metadata, and a line that says so if it is not the newest.

    Raises:
      FileNotFoundError: there is none.
      ValueError: none is whole.
    """
    problem = ''
    for path in (self.path, self._directory / PREVIOUS):
      try:
        tensors, metadata = load_tensors(path)
      except (FileNotFoundError, ValueError) as error:
        problem = problem or str(error)
        continue
      if metadata.get('format') != _FORMAT:
        problem = problem or f'{path} is not a training checkpoint.'
        continue
      self._newest_is_damaged = bool(problem)
      note = f'{problem} Resuming from {path.name}.' if problem else ''
      return tensors, metadata, note
    if not self.exists():
      raise FileNotFoundError(f'{self.path} does not exist.')
    raise ValueError(problem)
