"""Arrays that enter: converted where they are numbers, refused otherwise.

Engines and policies take what callers hand over through these functions, so
that nothing behind them broadcasts, cuts or rounds it silently.
"""

from typing import Any, Mapping, TypeVar

import numpy as np

_T = TypeVar('_T')
_MOST_NAMED = 8  # Worlds that an error lists.


def numbers(
  values: Any, name: str, shape: tuple[int, ...] | None
) -> np.ndarray:
  """Returns real numbers as an array; no copy of an array is made.

  Args:
    values: array of any real type and layout, tensor on the CPU, or lists.
    name: for the error.
    shape: of the array; any if None.

  Raises:
    ValueError: they are no real numbers, or have another shape.
  """
  try:
    array = np.asarray(values)
  except (RuntimeError, TypeError, ValueError) as error:
    reason = ' '.join(str(error).split())
    raise ValueError(f'{name} must be an array of numbers: {reason}') from None
  if array.dtype.kind not in 'fiu':
    raise ValueError(f'{name} must be real numbers, got {array.dtype}')
  if shape is not None and array.shape != shape:
    raise ValueError(f'{name} must have shape {shape}, got {array.shape}')
  return array


def rows(values: Any, name: str) -> np.ndarray:
  """Returns vectors of numbers as a writable, contiguous float32 array.

  Args:
    values: [..., D], see `numbers`.
    name: for the error.

  Raises:
    ValueError: they are no real numbers, or a single one.
  """
  array = numbers(values, name, None)
  if not array.ndim:
    raise ValueError(f'{name} must be vectors, got one number')
  with np.errstate(over='ignore'):  # Out of float32's range is infinite.
    return np.require(array, np.float32, ['C', 'W'])


def indices(
  values: Any, name: str, shape: tuple[int, ...], count: int
) -> np.ndarray:
  """Returns indices as an int64 array.

  Args:
    values: array or lists of integers.
    name: for the error.
    shape: of the array.
    count: number of things that are indexed.

  Raises:
    ValueError: they are no integers, have another shape, or are not within 0
      and `count` - 1.
  """
  array = numbers(values, name, shape)
  if array.dtype.kind == 'f':
    raise ValueError(f'{name} must be integers, got {array.dtype}')
  if ((array < 0) | (array >= count)).any():
    raise ValueError(f'{name} must be within 0 and {count - 1}, got {array}')
  return array.astype(np.int64, copy=False)


def finite_rows(values: np.ndarray) -> np.ndarray:
  """Returns whether all numbers of each row [B, N] are finite, [B]."""
  # Usually all are finite, and then one sum is enough to know it.
  with np.errstate(over='ignore', invalid='ignore'):
    total = values.sum()
  if np.isfinite(total):
    return np.ones(len(values), dtype=bool)
  return np.isfinite(values).all(axis=1)


def check_worlds(is_valid: np.ndarray, name: str) -> None:
  """Raises ValueError that lists the worlds whose numbers are not finite.

  Args:
    is_valid: whether those of each world are, [B].
    name: of the numbers.
  """
  if is_valid.all():
    return
  worlds = np.flatnonzero(~is_valid).tolist()
  listed = ', '.join(map(str, worlds[:_MOST_NAMED]))
  more = ', ...' if len(worlds) > _MOST_NAMED else ''
  noun = 'world' if len(worlds) == 1 else 'worlds'
  raise ValueError(f'{name} of {noun} {listed}{more} must be finite')


def generator_state(
  random_state: np.random.RandomState,
) -> dict[str, np.ndarray]:
  """Returns the state of a generator as arrays, for `restore_generator`."""
  _, keys, position, has_gauss, gauss = random_state.get_state(legacy=True)
  return {
    'keys': np.asarray(keys),
    'rest': np.array([position, has_gauss, gauss], dtype=np.float64),
  }


def restore_generator(
  random_state: np.random.RandomState, state: Mapping[str, np.ndarray]
) -> None:
  """Restores a `generator_state`; raises KeyError for another."""
  position, has_gauss, gauss = state['rest']
  random_state.set_state(
    ('MT19937', state['keys'], int(position), int(has_gauss), gauss)
  )


def part_of(state: Mapping[str, _T], prefix: str) -> dict[str, _T]:
  """Returns entries whose key starts with `prefix`, prefix removed."""
  return {
    key.removeprefix(prefix): value
    for key, value in state.items()
    if key.startswith(prefix)
  }
