"""Communication of the processes that train one network together.

Each process, a rank, has its own worlds and the same network. Operations are
collective: every rank must call them in the same order, or all ranks wait.
"""

import contextlib
import datetime
import os
from typing import Callable, Iterator, NamedTuple, Sequence

import numpy as np
import torch
from torch import distributed

# For a rank that hangs; one that dies is noticed at once.
_PATIENCE = datetime.timedelta(minutes=30)


class Moments(NamedTuple):
  """Number of values, their mean and standard deviation (unbiased)."""

  number: int
  mean: torch.Tensor
  std: torch.Tensor


class Communicator:
  """Collective operations of a torch process group, or of one process.

  Every operation raises ConnectionError where another rank has ended.

  Attributes:
    rank: number of this process, from 0.
    size: number of ranks. With one, every operation is an identity.
  """

  def __init__(self, group: distributed.ProcessGroup | None = None):
    """Connects the ranks of `group`; this process is alone if None."""
    self._group = group
    self.rank = group.rank() if group else 0
    self.size = group.size() if group else 1

  @contextlib.contextmanager
  def _contact(self) -> Iterator[None]:
    try:
      yield
    except RuntimeError as error:
      reason = str(error).strip().partition('\n')[0].partition('. ')[0]
      raise ConnectionError(
        f'Rank {self.rank} has lost the others: {reason}'
      ) from error

  def split(self) -> 'Communicator':
    """Returns a communicator of the same ranks for another thread."""
    if self.size == 1:
      return self
    with self._contact():
      return Communicator(distributed.new_group(timeout=_PATIENCE))

  def _sum(self, tensor: torch.Tensor) -> torch.Tensor:
    """Sums over all ranks, in place, to the same bits at every rank."""
    with self._contact():
      distributed.all_reduce(tensor, group=self._group)
    return tensor

  def average(self, tensors: Sequence[torch.Tensor]) -> None:
    """Replaces tensors of one dtype by their means over all ranks, in place."""
    if self.size == 1:
      return
    # One large operation costs less than many small ones.
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    parts = self._sum(flat).div_(self.size).split([t.numel() for t in tensors])
    for tensor, part in zip(tensors, parts, strict=True):
      tensor.copy_(part.view_as(tensor))

  def broadcast(self, tensors: Sequence[torch.Tensor]) -> None:
    """Replaces tensors by those of rank 0, in place."""
    if self.size == 1:
      return
    with self._contact():
      for tensor in tensors:
        distributed.broadcast(tensor, 0, group=self._group)

  def moments(self, values: torch.Tensor) -> Moments:
    """Returns the moments of all ranks' values, [N] with any N."""
    if self.size == 1:
      alone = len(values) < 2
      std = values.new_zeros(()) if alone else values.std()
      return Moments(len(values), values.mean(), std)
    wide = values.double()
    total = torch.stack([wide.new_tensor(len(wide)), wide.sum()])
    count, mean = self._sum(total)[0], total[1] / total[0].clamp(min=1)
    squares = self._sum((wide - mean).square().sum())
    std = (squares / (count - 1).clamp(min=1)).sqrt()
    return Moments(int(count), mean.to(values.dtype), std.to(values.dtype))

  def any(self, *flags: bool) -> tuple[bool, ...]:
    """Returns, for each flag, True if it is set at any rank."""
    if self.size == 1:
      return flags
    counts = self._sum(torch.tensor(flags).int()).tolist()
    return tuple(count > 0 for count in counts)

  def gather(self, rows: torch.Tensor) -> torch.Tensor:
    """Returns all ranks' rows, [N, ...] with any N, in the order of ranks."""
    if self.size == 1:
      return rows
    lengths = torch.zeros(self.size, dtype=torch.int64)
    lengths[self.rank] = len(rows)
    counts = self._sum(lengths).tolist()
    padded = rows.new_zeros(max(counts), *rows.shape[1:])
    padded[: len(rows)] = rows
    parts = [torch.empty_like(padded) for _ in counts]
    with self._contact():
      distributed.all_gather(parts, padded, group=self._group)
    return torch.cat([p[:n] for p, n in zip(parts, counts, strict=True)])

  def collect(self, payload: bytes) -> list[bytes]:
    """Returns all ranks' payloads at rank 0, an empty list elsewhere."""
    if self.size == 1:
      return [payload]
    parts = [b''] * self.size if self.rank == 0 else None
    with self._contact():
      distributed.gather_object(payload, parts, 0, group=self._group)
    return parts or []

  def scatter(self, payloads: Sequence[bytes]) -> bytes:
    """Returns this rank's entry of the payloads of rank 0."""
    if self.size == 1:
      (payload,) = payloads
      return payload
    mine: list[bytes] = [b'']
    parts = list(payloads) if self.rank == 0 else None
    with self._contact():
      distributed.scatter_object_list(mine, parts, 0, group=self._group)
    return mine[0]


LOCAL = Communicator()


@contextlib.contextmanager
def connect(device: torch.device | None = None) -> Iterator[Communicator]:
  """Connects the ranks until the context ends.

  Args:
    device: of tensors to exchange, besides the CPU.

  Yields:
    The communicator; `LOCAL` for a single process.

  Raises:
    ConnectionError: other ranks do not answer.
    ValueError: the environment variables of `torchrun` are incomplete.
  """
  if int(os.environ.get('WORLD_SIZE', '1')) == 1:
    yield LOCAL
    return
  on_gpu = device is not None and device.type == 'cuda'
  backend = 'cpu:gloo,cuda:nccl' if on_gpu else 'gloo'
  try:
    distributed.init_process_group(backend, timeout=_PATIENCE)
  except RuntimeError as error:
    raise ConnectionError(f'The other ranks do not answer: {error}') from error
  try:
    communicator = Communicator(distributed.group.WORLD)
    yield communicator
    communicator.any(False)  # Leaving early looks like dying.
  finally:
    distributed.destroy_process_group()


def find_device(name: str) -> torch.device:
  """Returns the device that this rank computes on.

  Args:
    name: 'cpu' or 'cuda'; ranks on one machine get a GPU each.

  Raises:
    ValueError: the device does not exist.
  """
  if name != 'cuda':
    return torch.device(name)
  found = torch.cuda.device_count() if torch.cuda.is_available() else 0
  index = int(os.environ.get('LOCAL_RANK', '0'))
  if index >= found:
    raise ValueError(
      f'--device=cuda: process {index} of this machine needs a CUDA device, '
      f'and torch {torch.__version__} finds {found}: use --device=cpu.'
    )
  torch.cuda.set_device(index)
  return torch.device('cuda', index)


def local_cores() -> int:
  """Returns the number of cores for each rank on this machine."""
  cores = os.cpu_count() or 1
  return max(cores // int(os.environ.get('LOCAL_WORLD_SIZE', '1')), 1)


def rank_seed(seed: int, rank: int) -> int:
  """Returns the seed of a rank, in [0, 2^32); rank 0 keeps `seed`.

  Seeds of ranks lie far apart, because parts of an agent use the numbers that
  follow `seed`.
  """
  if not rank:
    return seed
  return int(np.random.SeedSequence((seed, rank)).generate_state(1)[0])


def from_first(communicator: Communicator, make: Callable[[], str]) -> str:
  """Returns at every rank the text that `make` returns at rank 0.

  Raises:
    ValueError: at other ranks, if `make` raises any error at rank 0.
  """
  text = None
  try:
    if communicator.rank == 0:
      text = make()
  finally:
    # A first byte tells success from an empty text.
    payload = b'' if text is None else b'+' + text.encode()
    payload = communicator.scatter([payload] * communicator.size)
  if not payload:
    raise ValueError('Rank 0 has failed.')
  return payload[1:].decode()
