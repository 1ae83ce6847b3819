"""Matrix products of the faster library, for the CPU and without gradients.

torch multiplies by MKL, which does without AVX-512 on processors of AMD. numpy
multiplies by OpenBLAS, which has it, and is twice as fast there
(docs/LEARNING.md, "Where the time goes"). Either way the result is the same to
the bit for the same shapes and number of threads, but the rounding of a row may
depend on the others.
"""

import functools
import pathlib
import platform

import numpy as np
import torch

_CPUINFO = pathlib.Path('/proc/cpuinfo')


def mm(a: torch.Tensor, b: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
  """Is `torch.mm`, [M, K] by [K, N], into `out` [M, N]."""
  if not _is_amd():
    return torch.mm(a, b, out=out)
  np.matmul(a.numpy(), b.numpy(), out=out.numpy())
  return out


def addmm(
  bias: torch.Tensor, a: torch.Tensor, b: torch.Tensor, out: torch.Tensor
) -> torch.Tensor:
  """Is `torch.addmm`: `mm` and a bias [N] for each row of the product."""
  if not _is_amd():
    return torch.addmm(bias, a, b, out=out)
  return mm(a, b, out).add_(bias)


@functools.cache
def _is_amd() -> bool:
  if _CPUINFO.exists():
    return 'AuthenticAMD' in _CPUINFO.read_text()
  return 'AuthenticAMD' in platform.processor()
