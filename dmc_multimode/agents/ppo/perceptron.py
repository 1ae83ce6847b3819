"""A multi-layer perceptron, forward and backward, as training needs it.

What `torch.nn` computes, without an allocation for every operation and with the
products of `agents.blas`.
"""

import threading
from typing import Any

import torch
from torch import nn

from dmc_multimode.agents import blas


class _Workspace:
  """The memory of hidden layers.

  Attributes:
    passes: forward passes that have used it.
  """

  def __init__(self) -> None:
    self.passes = 0
    self._buffers: dict[tuple[str, int], torch.Tensor] = {}

  def take(self, use: str, index: int, rows: int, width: int) -> torch.Tensor:
    """Returns memory [rows, width]; the same `use` and `index`, the same."""
    size = rows * width
    buffer = self._buffers.get((use, index))
    if buffer is None or len(buffer) < size:
      with torch.inference_mode(False):  # What is made in it is of no more use.
        buffer = self._buffers[use, index] = torch.empty(size)
    return buffer[:size].view(rows, width)


class _Own(threading.local):
  """One workspace for each thread."""

  def __init__(self) -> None:
    self.workspace = _Workspace()


_OWN = _Own()


def apply(network: nn.Sequential, rows: torch.Tensor) -> torch.Tensor:
  """Returns `network(rows)`.

  Args:
    network: linear layers with SiLU between them; others are left to torch.
    rows: [N, D] float32 on the CPU, without gradients; others are left to
      torch.

  Raises:
    RuntimeError: in the backward pass, when the thread of the forward pass has
      made another since, of any network.
  """
  if (
    rows.ndim != 2
    or rows.dtype != torch.float32
    or rows.device.type != 'cpu'
    or rows.requires_grad
    or not _is_silu(network)
  ):
    return network(rows)
  parameters = [
    parameter
    for layer in list(network)[::2]
    for parameter in (layer.weight, layer.bias)
  ]
  return _Perceptron.apply(rows, *parameters)


def _is_silu(network: nn.Sequential) -> bool:
  kinds = [type(layer) for layer in network]
  wanted = [nn.Linear, nn.SiLU] * len(kinds)
  return kinds == wanted[: len(kinds)] and len(kinds) % 2 == 1


class _Perceptron(torch.autograd.Function):
  """Layer by layer; `parameters` are weight, bias, weight, bias ..."""

  @staticmethod
  def forward(
    ctx: Any, rows: torch.Tensor, *parameters: torch.Tensor
  ) -> torch.Tensor:
    parameters = tuple(parameter.detach() for parameter in parameters)
    weights, biases = parameters[::2], parameters[1::2]
    count, last = len(rows), len(weights) - 1
    space = ctx.space = _OWN.workspace
    space.passes += 1
    ctx.turn = space.passes
    inputs, sums = [rows], []
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
      width = len(weight)
      if i == last:
        total = rows.new_empty(count, width)
      else:
        total = space.take('sum', i, count, width)
      blas.addmm(bias, inputs[i], weight.T, total)
      if i < last:
        hidden = space.take('hidden', i, count, width)
        inputs.append(torch.ops.aten.silu.out(total, out=hidden))
        sums.append(total)
    ctx.inputs, ctx.sums, ctx.weights = inputs, sums, weights
    return total

  @staticmethod
  @torch.autograd.function.once_differentiable
  def backward(ctx: Any, gradient: torch.Tensor) -> Any:
    if ctx.turn != ctx.space.passes:
      raise RuntimeError(
        'A later forward pass has overwritten what this backward pass needs: '
        'follow every forward pass by its own.'
      )
    gradient = gradient.contiguous()
    gradients: list[torch.Tensor] = []
    for i in reversed(range(len(ctx.weights))):
      weight, inputs = ctx.weights[i], ctx.inputs[i]
      mine = blas.mm(gradient.T, inputs, torch.empty_like(weight))
      gradients[:0] = mine, gradient.sum(dim=0)
      if i:
        back = ctx.space.take('gradient', i, *inputs.shape)
        blas.mm(gradient, weight, back)
        gradient = torch.ops.aten.silu_backward.grad_input(
          back, ctx.sums[i - 1], grad_input=back
        )
    return None, *gradients
