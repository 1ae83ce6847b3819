"""What processes that train one network together tell each other.

Each of them, a rank, has worlds of its own and the same network. `Local` is for
one process alone: its operations are identities. `Torch` connects the ranks
that `torchrun` has started. An operation of several ranks is collective: every
rank must call it, in the same order, or all of them wait.
"""

import contextlib
import datetime
import os
from typing import Callable, Iterator, NamedTuple, Protocol, Sequence

import numpy as np
import torch
from torch import distributed

# A rank that dies is noticed at once; this is for one that does not answer.
_PATIENCE = datetime.timedelta(minutes=30)


class Moments(NamedTuple):
  """How many values, their mean, and their standard deviation (unbiased)."""

  number: int
  mean: torch.Tensor
  std: torch.Tensor


class Communicator(Protocol):
  """Connects the ranks; see the module's docstring."""

  @property
  def rank(self) -> int:
    """Number of this process, from 0."""

  @property
  def size(self) -> int:
    """How many there are."""

  def split(self) -> 'Communicator':
    """Returns one of the same ranks that another thread may use meanwhile."""

  def average(self, tensors: Sequence[torch.Tensor]) -> None:
    """Puts the mean over all ranks into tensors of one type, in place."""

  def broadcast(self, tensors: Sequence[torch.Tensor]) -> None:
    """Puts what rank 0 has into tensors, in place."""

  def moments(self, values: torch.Tensor) -> Moments:
    """Returns the moments of all ranks' values, [N] with any N."""

  def any(self, *flags: bool) -> tuple[bool, ...]:
    """Returns, of each flag, whether a rank has raised it."""

  def gather(self, rows: torch.Tensor) -> torch.Tensor:
    """Returns all ranks' rows, [N, ...] with any N, in the order of ranks."""

  def collect(self, payload: bytes) -> list[bytes]:
    """Returns all ranks' payloads at rank 0, and nothing elsewhere."""

  def scatter(self, payloads: Sequence[bytes]) -> bytes:
    """Returns to each rank its own of the payloads that rank 0 gives."""


class Local:
  """One process alone."""

  rank = 0
  size = 1

  def split(self) -> 'Local':
    """See `Communicator`."""
    return self

  def average(self, tensors: Sequence[torch.Tensor]) -> None:
    """See `Communicator`."""

  def broadcast(self, tensors: Sequence[torch.Tensor]) -> None:
    """See `Communicator`."""

  def moments(self, values: torch.Tensor) -> Moments:
    """See `Communicator`."""
    if len(values) < 2:
      return Moments(len(values), values.mean(), values.new_zeros(()))
    return Moments(len(values), values.mean(), values.std())

  def any(self, *flags: bool) -> tuple[bool, ...]:
    """See `Communicator`."""
    return flags

  def gather(self, rows: torch.Tensor) -> torch.Tensor:
    """See `Communicator`."""
    return rows

  def collect(self, payload: bytes) -> list[bytes]:
    """See `Communicator`."""
    return [payload]

  def scatter(self, payloads: Sequence[bytes]) -> bytes:
    """See `Communicator`."""
    (payload,) = payloads
    return payload


LOCAL = Local()


class Torch:
  """The ranks of a `torch.distributed` process group.

  Every operation raises ConnectionError where another rank has ended.
  """

  def __init__(self, group: distributed.ProcessGroup | None = None):
    """Uses `group`, which has all ranks; the default group if None."""
    self._group = group
    self.rank = distributed.get_rank()
    self.size = distributed.get_world_size()

  @contextlib.contextmanager
  def _contact(self) -> Iterator[None]:
    try:
      yield
    except RuntimeError as error:
      reason = str(error).strip().partition('\n')[0].partition('. ')[0]
      raise ConnectionError(
        f'Rank {self.rank} has lost the others: {reason}'
      ) from error

  def split(self) -> 'Torch':
    """See `Communicator`."""
    with self._contact():
      return Torch(distributed.new_group(timeout=_PATIENCE))

  def _sum(self, tensor: torch.Tensor) -> torch.Tensor:
    """Adds up over all ranks, in place, to the same bits everywhere."""
    with self._contact():
      distributed.all_reduce(tensor, group=self._group)
    return tensor

  def average(self, tensors: Sequence[torch.Tensor]) -> None:
    """See `Communicator`."""
    # One large operation costs less than many small ones.
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    parts = self._sum(flat).div_(self.size).split([t.numel() for t in tensors])
    for tensor, part in zip(tensors, parts, strict=True):
      tensor.copy_(part.view_as(tensor))

  def broadcast(self, tensors: Sequence[torch.Tensor]) -> None:
    """See `Communicator`."""
    with self._contact():
      for tensor in tensors:
        distributed.broadcast(tensor, 0, group=self._group)

  def moments(self, values: torch.Tensor) -> Moments:
    """See `Communicator`."""
    wide = values.double()
    total = torch.stack([wide.new_tensor(len(wide)), wide.sum()])
    count, mean = self._sum(total)[0], total[1] / total[0].clamp(min=1)
    squares = self._sum((wide - mean).square().sum())
    std = (squares / (count - 1).clamp(min=1)).sqrt()
    return Moments(int(count), mean.to(values.dtype), std.to(values.dtype))

  def any(self, *flags: bool) -> tuple[bool, ...]:
    """See `Communicator`."""
    counts = self._sum(torch.tensor(flags).int()).tolist()
    return tuple(count > 0 for count in counts)

  def gather(self, rows: torch.Tensor) -> torch.Tensor:
    """See `Communicator`."""
    lengths = self._lengths(len(rows))
    padded = rows.new_zeros(max(lengths), *rows.shape[1:])
    padded[: len(rows)] = rows
    parts = [torch.empty_like(padded) for _ in lengths]
    with self._contact():
      distributed.all_gather(parts, padded, group=self._group)
    return torch.cat(
      [part[:length] for part, length in zip(parts, lengths, strict=True)]
    )

  def _lengths(self, mine: int) -> list[int]:
    lengths = torch.zeros(self.size, dtype=torch.int64)
    lengths[self.rank] = mine
    return self._sum(lengths).tolist()

  def collect(self, payload: bytes) -> list[bytes]:
    """See `Communicator`."""
    lengths = self._lengths(len(payload))
    padded = _padded(payload, max(lengths))
    parts = None
    if self.rank == 0:
      parts = [torch.empty_like(padded) for _ in lengths]
    with self._contact():
      distributed.gather(padded, parts, 0, group=self._group)
    return [
      part[:length].numpy().tobytes()
      for part, length in zip(parts or [], lengths, strict=bool(parts))
    ]

  def scatter(self, payloads: Sequence[bytes]) -> bytes:
    """See `Communicator`."""
    lengths = torch.zeros(self.size, dtype=torch.int64)
    if self.rank == 0:
      lengths += torch.tensor([len(payload) for payload in payloads])
    self.broadcast([lengths])
    most = int(lengths.max())
    mine, parts = torch.empty(most, dtype=torch.uint8), None
    if self.rank == 0:
      parts = [_padded(payload, most) for payload in payloads]
    with self._contact():
      distributed.scatter(mine, parts, 0, group=self._group)
    return mine[: lengths[self.rank]].numpy().tobytes()


def _padded(payload: bytes, length: int) -> torch.Tensor:
  padded = np.zeros(length, dtype=np.uint8)
  padded[: len(payload)] = np.frombuffer(payload, dtype=np.uint8)
  return torch.from_numpy(padded)


@contextlib.contextmanager
def connect(device: torch.device | None = None) -> Iterator[Communicator]:
  """Connects to the other ranks, until the context ends.

  Args:
    device: on which tensors may be, besides the CPU.

  Yields:
    `LOCAL` where there are no others, with `torchrun` or without.

  Raises:
    ConnectionError: the others do not answer.
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
    communicator = Torch()
    yield communicator
    communicator.any(False)  # Who leaves early looks dead to the others.
  finally:
    distributed.destroy_process_group()


def find_device(name: str) -> torch.device:
  """Returns the device that this rank computes on.

  Args:
    name: 'cpu' or 'cuda'; ranks on one machine get a GPU each.

  Raises:
    ValueError: there is no such device.
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
  """Returns how many cores each rank on this machine may use."""
  cores = os.cpu_count() or 1
  return max(cores // int(os.environ.get('LOCAL_WORLD_SIZE', '1')), 1)


def rank_seed(seed: int, rank: int) -> int:
  """Returns a seed for what differs by rank; rank 0 keeps `seed`, in [0, 2^32).

  Seeds of several ranks lie apart: one and the next would not do, because parts
  of an agent already use the numbers that follow `seed`.
  """
  if not rank:
    return seed
  return int(np.random.SeedSequence((seed, rank)).generate_state(1)[0])


def from_first(communicator: Communicator, make: Callable[[], str]) -> str:
  """Calls `make` at rank 0 alone; returns its text at every rank.

  Raises:
    ValueError: at the other ranks, where `make` raises anything at rank 0.
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
