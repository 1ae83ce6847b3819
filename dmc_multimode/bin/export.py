r"""Exports a policy to ONNX, for runtimes without torch or this package.

  python -m dmc_multimode.bin.export --policy=pi2 --format=onnx --out=pi2.onnx

The model maps `observation`, float32 [B, D], raw as from the task, to the mean
`action`, float32 [B, 10], joint targets in radians. Observations are normalised
inside. The model's metadata have, as JSON: `modes`, `latents` (the command of
each mode), `control_timestep` (seconds) and `observation` (names and sizes of
its parts, in their order).
"""

import json
import logging
from typing import Any, Sequence
import warnings

from absl import flags
import numpy as np
import torch
from torch import nn

from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.suite.imitation import observations
from dmc_multimode.utils import files

_POLICY = flags.DEFINE_string(
  'policy', 'pi2', 'Name of a shipped policy, or folder of a policy or a run.'
)
_FORMAT = flags.DEFINE_enum('format', 'onnx', ['onnx'], 'Of the file.')
_OUT = flags.DEFINE_string('out', None, 'The file to write.')

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


def metadata(policy: pretrained.Policy) -> dict[str, Any]:
  """Returns the model's metadata, JSON values; see the module."""
  mode_set = policy.mode_set
  return {
    'modes': list(mode_set.names),
    'latents': mode_set.latents.tolist(),
    'control_timestep': policy.config.control_timestep,
    'observation': [
      {'name': name, 'size': size}
      for name, size in observations.layout(mode_set.latent_dim)
    ],
  }


def to_onnx(policy: pretrained.Policy) -> bytes:
  """Returns the policy as a serialized ONNX model.

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
      input_names=['observation'],
      output_names=['action'],
      verbose=False,
    )
  assert program is not None
  model = program.model_proto
  onnx.helper.set_model_props(
    model, {key: json.dumps(value) for key, value in metadata(policy).items()}
  )
  onnx.checker.check_model(model)
  return model.SerializeToString()


def difference(policy: pretrained.Policy, model: bytes) -> float:
  """Returns the largest difference of onnxruntime and torch, radians.

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
  (actions,) = session.run(['action'], {'observation': seen.numpy()})
  return float(np.abs(actions - policy.select_action(seen.numpy())).max())


def _missing(error: ModuleNotFoundError) -> str:
  return (
    f'{error}; exporting takes the extra `export`: pip install '
    "'dmc_multimode[export]'"
  )


def main(argv: Sequence[str]) -> None:
  """Exports, compares and writes; a wrong model replaces no file."""
  del argv
  out = files.output_file('out', _OUT.value)
  if out is None:
    raise ValueError('Say what to write: --out=FILE.onnx.')
  policy = pretrained.load(_POLICY.value)
  model = to_onnx(policy)
  apart = difference(policy, model)
  print(f'greatest difference from torch: {apart:.2e} rad')
  if not apart <= _TOLERANCE:
    raise ValueError(f'The model and torch act apart, by {apart:.2e} rad.')
  out.parent.mkdir(parents=True, exist_ok=True)
  files.write(out, model)
  print(f'wrote {out} ({len(model)} bytes)')


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
