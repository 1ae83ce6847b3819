"""Policies as ONNX models, for runtimes without torch or this package.

The model maps `observation`, float32 [B, D], raw as from the task, to the mean
`action`, float32 [B, 10], joint targets in radians. Observations are normalised
inside. Its metadata have, as JSON, `deployment`, the whole `description` of the
policy, which is also written beside it; and of that, for those who need no
more, `modes` (names), `latents`, `control_timestep` (seconds), `observation`.
"""

import json
import logging
import os
import pathlib
from typing import Any
import warnings

import numpy as np
import torch
from torch import nn

from dmc_multimode import pretrained
from dmc_multimode.deployment import description
from dmc_multimode.utils import files

CONTROLLER = 'controller.py'
_CHECKED = 256  # Random observations for the comparison.
_TOLERANCE = 1e-5  # Radians.
_SPREAD = 3.0  # Deviation of these, in standard deviations.


class _Actor(nn.Module):
  """The policy part of the network, for export."""

  def __init__(self, policy: pretrained.Policy):
    super().__init__()
    self._network = policy.network

  def forward(self, observation: torch.Tensor) -> torch.Tensor:
    """Returns mean joint targets [B, 10] for raw observations [B, D]."""
    return self._network.act(observation)


def write(policy: pretrained.Policy, path: str | os.PathLike[str]) -> float:
  """Writes a policy as an ONNX model, and beside it what runs the model.

  Args:
    policy: the policy.
    path: of the model. The description has the same name, and ends in .json;
      `CONTROLLER` turns sensors into joint targets with both.

  Returns:
    The greatest difference of onnxruntime and torch, radians.

  Raises:
    ModuleNotFoundError: the extra `export` is not installed.
    OSError: the folder cannot be written.
    ValueError: the path ends in .json, or the model and torch act apart; then
      nothing is written.
  """
  path = pathlib.Path(files.expand(path))
  beside = path.with_suffix('.json')
  if beside == path:
    raise ValueError(f'{path} is where the description goes: name a .onnx.')
  described = description.describe(policy)
  model = to_onnx(policy, described)
  apart = difference(policy, model)
  if not apart <= _TOLERANCE:
    raise ValueError(f'The model and torch act apart, by {apart:.2e} rad.')
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write(path, model)
  files.write_json(beside, described)
  # As text: it is for programs without this package.
  source = pathlib.Path(__file__).with_name(CONTROLLER).read_bytes()
  files.write(path.with_name(CONTROLLER), source)
  return apart


def metadata(described: dict[str, Any]) -> dict[str, Any]:
  """Returns a model's metadata, JSON values, of a description."""
  return {
    'deployment': described,
    'modes': [mode['name'] for mode in described['modes']],
    'latents': [mode['latent'] for mode in described['modes']],
    'control_timestep': described['control_timestep'],
    'observation': described['observation'],
  }


def to_onnx(policy: pretrained.Policy, described: dict[str, Any]) -> bytes:
  """Returns the policy as a serialized ONNX model.

  Args:
    policy: the policy.
    described: its description.

  Raises:
    ModuleNotFoundError: the extra `export` is not installed.
  """
  try:
    import onnx
    import onnxscript  # noqa: F401  # Used by torch.
  except ModuleNotFoundError as error:
    raise ModuleNotFoundError(_missing(error)) from error
  example = torch.zeros(2, policy.network.observation_size)
  # Warnings of unused operators, and of torch's own deprecations.
  logging.getLogger('torch.onnx').setLevel(logging.ERROR)
  with warnings.catch_warnings():
    warnings.simplefilter('ignore')
    program = torch.onnx.export(
      _Actor(policy),
      (example,),
      dynamo=True,
      dynamic_shapes=({0: torch.export.Dim('batch')},),
      input_names=[described['model']['input']],
      output_names=[described['model']['output']],
      verbose=False,
    )
  assert program is not None
  model = program.model_proto
  texts = {key: json.dumps(value) for key, value in metadata(described).items()}
  onnx.helper.set_model_props(model, texts)
  onnx.checker.check_model(model)
  return model.SerializeToString()


def difference(policy: pretrained.Policy, model: bytes) -> float:
  """Returns the greatest difference of onnxruntime and torch, radians.

  Args:
    policy: the original.
    model: exported from the policy.

  Raises:
    ModuleNotFoundError: the extra `export` is not installed.
  """
  try:
    import onnxruntime
  except ModuleNotFoundError as error:
    raise ModuleNotFoundError(_missing(error)) from error
  network = policy.network
  size = network.observation_size
  noise = torch.randn(
    _CHECKED, size, generator=torch.Generator().manual_seed(0)
  )
  normaliser = network.normaliser
  seen = normaliser.mean[:size] + (
    _SPREAD * noise * normaliser.variance[:size].sqrt()
  )
  session = onnxruntime.InferenceSession(
    model, providers=['CPUExecutionProvider']
  )
  (actions,) = session.run(None, {'observation': seen.numpy()})
  return float(np.abs(actions - policy.select_action(seen.numpy())).max())


def _missing(error: ModuleNotFoundError) -> str:
  return (
    f'{error}; exporting takes the extra `export`: pip install '
    "'dmc_multimode[export]'"
  )
