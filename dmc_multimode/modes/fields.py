"""Reference motions as plain data: dictionaries, lists, numbers and text.

Every error carries the path of the value that is wrong, so that a reader of
files can turn it into a line. `files.py` documents the fields themselves.
"""

import re
import reprlib
from typing import Any, Iterable, Mapping, Sequence

import numpy as np
from scipy.spatial import transform

from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib

MAX_KEYFRAMES = 1000
MAX_DURATION = 60.0  # Seconds.
MAX_DISTANCE = 100.0  # Metres from the anchor, along each axis.

_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,63}')
_REQUIRED = ('name', 'kind', 'duration', 'keyframes')
_OPTIONAL = ('step', 'takeoff', 'mirror', 'half_cycle_symmetric')
_KEYFRAME_REQUIRED = ('phase', 'position')
_KEYFRAME_OPTIONAL = ('orientation', 'euler', 'contacts')

Path = tuple[str | int, ...]  # Where a value stands, as ('keyframes', 0).


class FieldError(ValueError):
  """A value is wrong; `path` says which one, the message why.

  Attributes:
    path: keys and indices that lead to the value.
  """

  def __init__(self, path: Path, message: str):
    super().__init__(message)
    self.path = path

  def spell(self) -> str:
    """Returns the path as people write it: keyframes[2].position."""
    words = (f'[{k}]' if isinstance(k, int) else f'.{k}' for k in self.path)
    return ''.join(words).lstrip('.') or 'mode'


def to_dict(motion: motion_lib.ReferenceMotion) -> dict[str, Any]:
  """Returns a motion as plain data, as `motion` reads it."""
  keyframes: list[dict[str, Any]] = []
  for i, phase in enumerate(motion.phases.tolist()):
    keyframe: dict[str, Any] = {
      'phase': phase,
      'position': motion.positions[i].tolist(),
      'orientation': motion.orientations[i].tolist(),
    }
    if motion.contacts is not None:
      keyframe['contacts'] = [int(c) for c in motion.contacts[i]]
    keyframes.append(keyframe)
  result: dict[str, Any] = {
    'name': motion.name,
    'kind': motion.kind,
    'duration': float(motion.duration),
    'keyframes': keyframes,
    'takeoff': float(motion.takeoff),
    'mirror': motion.mirror,
    'half_cycle_symmetric': bool(motion.half_cycle_symmetric),
  }
  if motion.ledge is not None:
    step = {'edge': motion.ledge.edge, 'height': motion.ledge.height}
    result['step'] = {key: float(value) for key, value in step.items()}
  return result


def motions(data: Any) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Builds the modes of one file; raises FieldError."""
  if not (isinstance(data, Mapping) and 'modes' in data):
    return (motion(data, ()),)
  _check_fields(data, (), ('modes',), ())
  items = data['modes']
  if not isinstance(items, list) or not items:
    raise FieldError(('modes',), 'modes must be a list of at least one mode.')
  found: dict[str, motion_lib.ReferenceMotion] = {}
  for i, item in enumerate(items):
    one = motion(item, ('modes', i))
    if one.name in found:
      where = ('modes', i, 'name')
      raise FieldError(where, f'mode {one.name!r} is given twice.')
    found[one.name] = one
  return tuple(found.values())


def motion(data: Any, path: Path) -> motion_lib.ReferenceMotion:
  """Builds one mode; raises FieldError at the value that is wrong."""
  _check_fields(data, path, _REQUIRED, _OPTIONAL)
  name = _name(data, path)
  kind = data['kind']
  if kind not in motion_lib.KINDS:
    kinds = ', '.join(motion_lib.KINDS)
    raise FieldError((*path, 'kind'), f'kind must be one of {kinds}.')
  frames = _keyframes(data['keyframes'], (*path, 'keyframes'))
  try:
    return motion_lib.ReferenceMotion(
      name=name,
      kind=kind,
      duration=_duration(data['duration'], (*path, 'duration')),
      **frames,
      ledge=_step(data.get('step'), (*path, 'step')),
      takeoff=_number(data.get('takeoff', 0.0), (*path, 'takeoff'), 0.0, 1.0),
      mirror=_mirror(data, path),
      half_cycle_symmetric=_flag(data, path, 'half_cycle_symmetric'),
    )
  except FieldError:
    raise
  except ValueError as error:  # What only the motion as a whole can tell.
    raise FieldError((*path, 'keyframes'), str(error)) from None


def _keyframes(data: Any, path: Path) -> dict[str, Any]:
  """Returns the arrays of a motion: phases, positions and so on."""
  if not isinstance(data, Sequence) or isinstance(data, str) or len(data) < 2:
    raise FieldError(path, 'keyframes must be a list of at least two.')
  if len(data) > MAX_KEYFRAMES:
    message = f'{len(data)} keyframes; at most {MAX_KEYFRAMES} are allowed.'
    raise FieldError(path, message)
  for i, item in enumerate(data):
    _check_fields(item, (*path, i), _KEYFRAME_REQUIRED, _KEYFRAME_OPTIONAL)
  positions = [
    _vector(x['position'], (*path, i, 'position'), 3, MAX_DISTANCE)
    for i, x in enumerate(data)
  ]
  return {
    'phases': np.array(_phases(data, path)),
    'positions': np.array(positions),
    'orientations': np.array(
      [_orientation(item, (*path, i)) for i, item in enumerate(data)]
    ),
    'contacts': _contacts(data, path),
  }


def _phases(data: Sequence[Any], path: Path) -> list[float]:
  """Returns the keyframes' phases, which rise from 0 to 1."""
  phases: list[float] = []
  for i, item in enumerate(data):
    where = (*path, i, 'phase')
    phase = _number(item['phase'], where, 0.0, 1.0)
    if i == 0 and phase != 0:
      raise FieldError(where, f'the first phase must be 0, not {phase}.')
    if phases and phase <= phases[-1]:
      message = f'phase {phase} does not rise above {phases[-1]} before it.'
      raise FieldError(where, message)
    if i == len(data) - 1 and phase != 1:
      raise FieldError(where, f'the last phase must be 1, not {phase}.')
    phases.append(phase)
  return phases


def _orientation(item: Mapping[str, Any], path: Path) -> np.ndarray:
  """Returns a keyframe's quaternion (w, x, y, z), [4]."""
  if 'orientation' in item and 'euler' in item:
    raise FieldError(
      (*path, 'euler'), 'give either orientation or euler, not both.'
    )
  if 'euler' in item:
    angles = _vector(item['euler'], (*path, 'euler'), 3, 360.0)
    turn = transform.Rotation.from_euler('xyz', angles, degrees=True)
    return turn.as_quat(scalar_first=True)
  if 'orientation' not in item:
    return np.array([1.0, 0.0, 0.0, 0.0])
  where = (*path, 'orientation')
  quaternion = np.array(_vector(item['orientation'], where, 4, 1e3))
  if np.linalg.norm(quaternion) < 1e-3:
    raise FieldError(where, 'orientation must not be zero.')
  return quaternion


def _contacts(data: Sequence[Any], path: Path) -> np.ndarray | None:
  """Returns the feet's contacts, [K, 2], or None where no keyframe has any."""
  if not any('contacts' in item for item in data):
    return None
  rows: list[list[float]] = []
  for i, item in enumerate(data):
    if 'contacts' not in item:
      message = 'contacts are missing here; give them in all keyframes or none.'
      raise FieldError((*path, i), message)
    where, row = (*path, i, 'contacts'), item['contacts']
    valid = isinstance(row, Sequence) and len(row) == motion_lib.NUM_FEET
    if not valid or any(foot not in (0, 1) for foot in row):
      message = 'contacts must be [left, right], each 0 or 1.'
      raise FieldError(where, message)
    rows.append([float(foot) for foot in row])
  return np.array(rows)


# Single values.


def _check_fields(
  data: Any, path: Path, required: Iterable[str], optional: Iterable[str]
) -> None:
  """Raises FieldError unless `data` maps all required, no unknown fields."""
  known = (*required, *optional)
  if not isinstance(data, Mapping):
    message = f'expected the fields {", ".join(known)} here.'
    raise FieldError(path, message)
  for key in data:
    if key not in known:
      message = f'unknown field {reprlib.repr(key)}; known are '
      raise FieldError((*path, key), message + f'{", ".join(known)}.')
  for key in required:
    if key not in data:
      raise FieldError(path, f'the field {key!r} is missing.')


def _name(data: Mapping[str, Any], path: Path) -> str:
  name = data['name']
  if not (isinstance(name, str) and _NAME.fullmatch(name)):
    raise FieldError(
      (*path, 'name'),
      'name must be at most 64 letters, digits and _, a letter first.',
    )
  if name in library.SETS:
    message = f'{name!r} is the name of a mode set; choose another.'
    raise FieldError((*path, 'name'), message)
  return name


def _mirror(data: Mapping[str, Any], path: Path) -> str:
  mirror = data.get('mirror', '')
  if not isinstance(mirror, str) or (mirror and not _NAME.fullmatch(mirror)):
    raise FieldError((*path, 'mirror'), 'mirror must be the name of a mode.')
  return mirror


def _flag(data: Mapping[str, Any], path: Path, field: str) -> bool:
  value = data.get(field, False)
  if not isinstance(value, bool):
    raise FieldError((*path, field), f'{field} must be true or false.')
  return value


def _number(value: Any, path: Path, low: float, high: float) -> float:
  """Returns a finite number within [low, high]."""
  number = isinstance(value, (int, float)) and not isinstance(value, bool)
  if not number or not low <= value <= high:
    raise FieldError(
      path,
      f'expected a number from {low:g} to {high:g}, got {reprlib.repr(value)}.',
    )
  return float(value)


def _duration(value: Any, path: Path) -> float:
  duration = _number(value, path, 0.0, MAX_DURATION)
  if duration < 1e-3:
    raise FieldError(path, 'duration must be positive, in seconds.')
  return duration


def _vector(value: Any, path: Path, size: int, bound: float) -> list[float]:
  """Returns `size` numbers, none of them beyond `bound` in magnitude."""
  if not isinstance(value, list) or len(value) != size:
    message = f'expected a list of {size} numbers, got {reprlib.repr(value)}.'
    raise FieldError(path, message)
  return [
    _number(item, (*path, i), -bound, bound) for i, item in enumerate(value)
  ]


def _step(value: Any, path: Path) -> motion_lib.Ledge | None:
  if value is None:
    return None
  _check_fields(value, path, ('edge', 'height'), ())
  edge, height = (
    _number(value[key], (*path, key), -MAX_DISTANCE, MAX_DISTANCE)
    for key in ('edge', 'height')
  )
  return motion_lib.Ledge(edge=edge, height=height)
