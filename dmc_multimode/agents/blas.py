"""Matrix products of the faster library.

torch multiplies by MKL, which does without AVX-512 on processors of AMD.
OpenBLAS has it, and is twice as fast there (docs/LEARNING.md, "Where the time
goes"). Elsewhere these are torch's own products. Either way the result is the
same to the bit for the same shapes, but the rounding of a row may depend on the
others.
"""

import ctypes
import functools
import importlib.util
import pathlib
import platform
from typing import Any, Callable

import torch

_PACKAGE = 'scipy_openblas32'
_SHARED = ('.so', '.dylib', '.dll')  # There may be a `.lib` beside them.
_CPUINFO = pathlib.Path('/proc/cpuinfo')
_ROW_MAJOR, _AS_IS, _TRANSPOSED = 101, 111, 112  # Of `cblas.h`.
_INT, _FLOAT, _POINTER = ctypes.c_int, ctypes.c_float, ctypes.c_void_p
_SGEMM = (
  *(_INT, _INT, _INT),  # Order, how A and B lie in memory.
  *(_INT, _INT, _INT),  # M, N, K.
  *(_FLOAT, _POINTER, _INT),  # alpha, A, and how far its lines are apart.
  *(_POINTER, _INT),  # B.
  *(_FLOAT, _POINTER, _INT),  # beta, C.
)


def mm(a: torch.Tensor, b: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
  """Is `torch.mm`, [M, K] by [K, N], into `out` [M, N], without gradients."""
  accumulate = _accumulation(a, b, out)
  if accumulate is None:
    return torch.mm(a, b, out=out)
  accumulate(0.0)
  return out


def addmm(
  bias: torch.Tensor, a: torch.Tensor, b: torch.Tensor, out: torch.Tensor
) -> torch.Tensor:
  """Is `torch.addmm`: `mm` and a bias [N] for each row of the product."""
  accumulate = _accumulation(a, b, out)
  if accumulate is None:
    return torch.addmm(bias, a, b, out=out)
  out.copy_(bias)
  accumulate(1.0)
  return out


def _accumulation(
  a: torch.Tensor, b: torch.Tensor, out: torch.Tensor
) -> Callable[[float], None] | None:
  """Returns out <- a b + beta out by beta, or None if torch is to do it."""
  sgemm = _sgemm()
  if sgemm is None:
    return None
  (rows, inner), columns = a.shape, b.shape[1]
  lies_a, lies_b, lies = _lie(a), _lie(b), _lie(out)
  if lies_a is None or lies_b is None or lies is None or lies[0] != _AS_IS:
    return None
  if b.shape[0] != inner or out.shape != (rows, columns):
    return None
  return lambda beta: sgemm(
    *(_ROW_MAJOR, lies_a[0], lies_b[0], rows, columns, inner),
    *(1.0, a.data_ptr(), lies_a[1], b.data_ptr(), lies_b[1]),
    *(beta, out.data_ptr(), lies[1]),
  )


def _lie(matrix: torch.Tensor) -> tuple[int, int] | None:
  """Returns how a matrix lies in memory, and how far its lines are apart."""
  if matrix.dtype != torch.float32 or matrix.device.type != 'cpu':
    return None
  (down, right), (rows, columns) = matrix.stride(), matrix.shape
  if right == 1 and down >= columns:
    return _AS_IS, max(down, 1)
  if down == 1 and right >= rows:
    return _TRANSPOSED, max(right, 1)
  return None


@functools.cache
def _sgemm() -> Callable[..., None] | None:
  """Returns OpenBLAS's product, or None where torch's is as good."""
  if not _is_amd():
    return None
  package = importlib.util.find_spec(_PACKAGE)
  if package is None or package.origin is None:
    return None
  files = pathlib.Path(package.origin).parent.glob('lib/libscipy_openblas.*')
  [path] = [file for file in files if file.suffix in _SHARED]
  # Not by importing the package, which hides scipy's own copy behind this one.
  library = ctypes.CDLL(str(path))
  library.scipy_openblas_set_num_threads(1)
  function: Any = library.scipy_cblas_sgemm
  function.argtypes, function.restype = _SGEMM, None
  return function


def _is_amd() -> bool:
  if _CPUINFO.exists():
    return 'AuthenticAMD' in _CPUINFO.read_text()
  return 'AuthenticAMD' in platform.processor()
