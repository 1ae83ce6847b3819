"""Mode files: reference motions as YAML or JSON.

A file holds one mode, or several under `modes:`. Its fields are those of
`motion.ReferenceMotion`, with the keyframes as a list:

  name: hop_in_place
  kind: periodic             # or transient, or steady
  duration: 0.6              # seconds
  keyframes:
    - {phase: 0.0, position: [0, 0, 0.5], contacts: [1, 1]}
    - {phase: 0.5, position: [0, 0, 0.6], contacts: [0, 0]}
    - {phase: 1.0, position: [0, 0, 0.5], contacts: [1, 1]}

A keyframe may turn the trunk by `orientation: [w, x, y, z]` or by
`euler: [roll, pitch, yaw]` in degrees (rotations about the fixed x, y and z
axes in this order); it is upright otherwise. Optional per mode: `step: {edge,
height}` (a `motion.Ledge`), `takeoff`, `mirror`, `half_cycle_symmetric`.

Lengths are metres and times seconds. With `units: height`, a mode is one for
robots of any size: lengths are in heights h of the standing trunk, and times in
sqrt(h / g), 0.226 s for the mini biped.

Contacts are [left, right], or those of four feet in the robot's order. A mode
begins where a command finds the trunk, about (0, 0, h) and upright: farther off
than 0.7 h or 1 rad every command would be lost at once. A cycle closes:
it ends at the height where it begins, and but for yaw in the same orientation;
a steady mode does not turn either.

Nothing in a file is executed, and every error names the file and the line.
"""

import math
import os
import re
import reprlib
from typing import Annotated, Any, Iterable, Literal, Mapping

import numpy as np
import pydantic

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.utils import constants
from dmc_multimode.utils import files
from dmc_multimode.utils import yaml_lines

MAX_BYTES = 1_000_000
MAX_KEYFRAMES = 1000
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,63}')
_LEAST_NORM = 1e-3  # Least norm of a quaternion before it is normalised.


class ModeFileError(ValueError):
  """A mode file is invalid; the message is one line with place and reason."""


class _FieldError(ValueError):
  """A value at `path` is invalid."""

  def __init__(self, path: yaml_lines.Path, message: str):
    super().__init__(message)
    self.path = path


# The fields of a file, each with its bounds.


def _numbers(size: int, bound: float) -> Any:
  """Returns the type of a list of numbers within +-`bound`."""
  number = Annotated[float, pydantic.Field(ge=-bound, le=bound)]
  return Annotated[
    list[number],
    pydantic.Field(min_length=size, max_length=size),
  ]


def _checked_name(name: str) -> str:
  if not _NAME.fullmatch(name):
    raise ValueError(
      'a name is at most 64 letters, digits and _, a letter first'
    )
  if name in library.SETS:
    raise ValueError(f'{name!r} is the name of a mode set; choose another')
  return name


def _checked_mirror(name: str) -> str:
  if name and not _NAME.fullmatch(name):
    raise ValueError('mirror must be the name of a mode')
  return name


def _checked_contacts(row: Any) -> list[float]:
  valid = isinstance(row, list) and len(row) in motion_lib.FEET_COUNTS
  if not valid or any(foot not in (0, 1) for foot in row):
    raise ValueError(
      'contacts must be [left, right], or those of four feet, each 0 or 1'
    )
  return [float(foot) for foot in row]


_Metres = Annotated[float, pydantic.Field(ge=-100.0, le=100.0)]
_Phase = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]


class _Table(pydantic.BaseModel):
  """Strict table of fields: no unknown fields, conversions, inf or nan.

  Optional fields default to None; `null` in a file is an error.
  """

  model_config = pydantic.ConfigDict(
    strict=True, extra='forbid', allow_inf_nan=False
  )


class _Step(_Table):
  edge: _Metres
  height: _Metres


class _Keyframe(_Table):
  phase: _Phase
  position: _numbers(3, 100.0)  # type: ignore[valid-type]
  orientation: _numbers(4, 1e3) = None  # type: ignore[valid-type]
  euler: _numbers(3, 360.0) = None  # type: ignore[valid-type]
  contacts: Annotated[Any, pydantic.BeforeValidator(_checked_contacts)] = None


class _Mode(_Table):
  name: Annotated[str, pydantic.AfterValidator(_checked_name)]
  kind: Literal['periodic', 'transient', 'steady']
  duration: Annotated[float, pydantic.Field(ge=1e-3, le=60.0)]  # Seconds.
  keyframes: Annotated[
    list[_Keyframe], pydantic.Field(min_length=2, max_length=MAX_KEYFRAMES)
  ]
  step: _Step | None = None
  takeoff: _Phase = 0.0
  mirror: Annotated[str, pydantic.AfterValidator(_checked_mirror)] = ''
  half_cycle_symmetric: bool = False
  units: Literal['metres', 'height'] = 'metres'


class _Modes(_Table):
  modes: Annotated[list[_Mode], pydantic.Field(min_length=1)]


# Reading.


def load(
  path: str | os.PathLike[str],
  stand_height: float = constants.STAND_HEIGHT,
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Reads the modes of a YAML or JSON file, in their order there.

  Args:
    path: of the file.
    stand_height: h of the robot that they are for, metres.

  Raises:
    ModeFileError: the file cannot be read or is not a valid mode file; the
      message begins with `FILE:LINE:` if the error has a line.
  """
  name = files.expand(path)
  try:
    content = files.read_bounded(name, MAX_BYTES)
  except (OSError, ValueError) as error:  # Too large, or a NUL in the name.
    reason = getattr(error, 'strerror', None) or str(error)
    raise ModeFileError(f'{name}: cannot be read ({reason}).') from None
  try:
    return _load(content, name.lower().endswith('.json'), stand_height)
  except yaml_lines.LineError as error:
    raise ModeFileError(f'{name}:{error.line}: {error}') from None


def _load(
  content: bytes, is_json: bool, stand_height: float
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Returns the modes of a file's content; raises LineError."""
  try:
    text = content.decode('utf-8-sig')
  except UnicodeDecodeError as error:
    line = content.count(b'\n', 0, error.start) + 1
    raise yaml_lines.LineError(line, 'not UTF-8 text.') from None
  data, lines = yaml_lines.parse(text, is_json)
  try:
    return _motions(data, stand_height)
  except _FieldError as error:
    known = (error.path[:n] for n in range(len(error.path), -1, -1))
    line = next(lines[prefix] for prefix in known if prefix in lines)
    raise yaml_lines.LineError(line, str(error)) from None


def motion_from_dict(data: Mapping[str, Any]) -> motion_lib.ReferenceMotion:
  """Returns the motion of a `motion_to_dict`, to the bit.

  Raises:
    ModeFileError: a field is missing, unknown or wrong; the message names it.
  """
  try:
    return _motion(_validated(_Mode, data), (), constants.STAND_HEIGHT)
  except _FieldError as error:
    words = (f'[{k}]' if isinstance(k, int) else f'.{k}' for k in error.path)
    place = ''.join(words).lstrip('.') or 'mode'
    raise ModeFileError(f'{place}: {error}') from None


def _motions(
  data: Any, stand_height: float
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Builds the modes of one file; raises _FieldError."""

  def built(mode: _Mode, path: yaml_lines.Path) -> motion_lib.ReferenceMotion:
    motion = _motion(mode, path, stand_height)
    return _started(motion, path, stand_height)

  if not (isinstance(data, dict) and 'modes' in data):
    return (built(_validated(_Mode, data), ()),)
  found: dict[str, motion_lib.ReferenceMotion] = {}
  for i, mode in enumerate(_validated(_Modes, data).modes):
    if mode.name in found:
      message = f'mode {mode.name!r} is given twice.'
      raise _FieldError(('modes', i, 'name'), message)
    found[mode.name] = built(mode, ('modes', i))
  return tuple(found.values())


def _started(
  motion: motion_lib.ReferenceMotion, path: yaml_lines.Path, stand_height: float
) -> motion_lib.ReferenceMotion:
  """Returns the motion; raises _FieldError if its commands would be lost."""
  distance = constants.TRACKING_DISTANCE
  distance *= stand_height / constants.STAND_HEIGHT
  try:
    motion_lib.check_start(motion, distance, stand_height=stand_height)
  except ValueError as error:
    raise _FieldError((*path, 'keyframes', 0), str(error)) from None
  return motion


def _validated(table: type[_Table], data: Any) -> Any:
  """Returns the validated fields; raises _FieldError at the first error."""
  try:
    return table.model_validate(data)
  except pydantic.ValidationError as error:
    problems = error.errors(include_url=False)
  # A misspelt field is missing as well: report the spelling.
  problem = min(problems, key=lambda found: found['type'] != 'extra_forbidden')
  raise _FieldError(problem['loc'], _explain(problem))


def _explain(problem: Mapping[str, Any]) -> str:
  """Returns pydantic's error in the terms of a mode file."""
  path, kind = problem['loc'], problem['type']
  names = [str(key) for key in path if isinstance(key, str)]
  known = ', '.join(_table_at(names).model_fields)
  if kind == 'extra_forbidden':
    return f'unknown field {reprlib.repr(path[-1])}; known are {known}.'
  if kind == 'model_type':
    return f'expected the fields {known} here.'
  if kind == 'missing':
    return f'the field {path[-1]!r} is missing.'
  if kind == 'value_error':
    return problem['msg'].removeprefix('Value error, ') + '.'
  _, says = problem['msg'].split(' ', 1)  # 'Input should be ...'.
  return f'{names[-1]} {says}, got {reprlib.repr(problem["input"])}.'


def _table_at(names: list[str]) -> type[_Table]:
  """Returns the table class for a path of field names."""
  tables: dict[str, type[_Table]] = {'keyframes': _Keyframe, 'step': _Step}
  return next((tables[name] for name in names[::-1] if name in tables), _Mode)


def _motion(
  mode: _Mode, path: yaml_lines.Path, stand_height: float
) -> motion_lib.ReferenceMotion:
  """Builds one mode; raises _FieldError if its keyframes are inconsistent."""
  frames, where = mode.keyframes, (*path, 'keyframes')
  length, time = 1.0, 1.0
  if mode.units == 'height':
    length = stand_height
    time = math.sqrt(stand_height / constants.GRAVITY)
  edge = mode.step and {key: length * at for key, at in dict(mode.step).items()}
  _check_phases([frame.phase for frame in frames], where)
  orientations = [
    _orientation(frame, (*where, i)) for i, frame in enumerate(frames)
  ]
  try:
    return motion_lib.ReferenceMotion(
      name=mode.name,
      kind=mode.kind,
      duration=time * mode.duration,
      phases=np.array([frame.phase for frame in frames]),
      positions=length * np.array([frame.position for frame in frames]),
      orientations=np.array(orientations),
      contacts=_contacts(frames, where),
      ledge=motion_lib.Ledge(**edge) if edge else None,
      takeoff=mode.takeoff,
      mirror=mode.mirror,
      half_cycle_symmetric=mode.half_cycle_symmetric,
    )
  except _FieldError:
    raise
  except ValueError as error:  # Checks of the motion as a whole.
    raise _FieldError(where, str(error)) from None


def _check_phases(phases: list[float], path: yaml_lines.Path) -> None:
  """Raises _FieldError unless phases rise from 0 to 1."""
  last = len(phases) - 1
  for i, phase in enumerate(phases):
    if i == 0 and phase != 0:
      message = f'the first phase must be 0, not {phase}.'
    elif i and phase <= phases[i - 1]:
      message = f'phase {phase} does not rise above {phases[i - 1]} before it.'
    elif i == last and phase != 1:
      message = f'the last phase must be 1, not {phase}.'
    else:
      continue
    raise _FieldError((*path, i, 'phase'), message)


def _orientation(frame: _Keyframe, path: yaml_lines.Path) -> np.ndarray:
  """Returns a keyframe's quaternion (w, x, y, z), not normalised yet, [4]."""
  if frame.orientation is not None and frame.euler is not None:
    raise _FieldError(
      (*path, 'euler'), 'give either orientation or euler, not both.'
    )
  if frame.euler is not None:
    from scipy.spatial import transform  # Late: scipy imports slowly.

    turn = transform.Rotation.from_euler('xyz', frame.euler, degrees=True)
    return turn.as_quat(scalar_first=True)
  if frame.orientation is None:
    return np.array([1.0, 0.0, 0.0, 0.0])
  quaternion = np.array(frame.orientation)
  if np.linalg.norm(quaternion) < _LEAST_NORM:
    raise _FieldError((*path, 'orientation'), 'orientation must not be zero.')
  return quaternion


def _contacts(
  frames: Iterable[_Keyframe], path: yaml_lines.Path
) -> np.ndarray | None:
  """Returns the contacts of the feet, [K, F], or None without any."""
  rows = [frame.contacts for frame in frames]
  if all(row is None for row in rows):
    return None
  for i, row in enumerate(rows):
    if row is None:
      message = 'contacts are missing here; give them in all keyframes or none.'
      raise _FieldError((*path, i), message)
    if len(row) != len(rows[0]):
      message = f'contacts are of {len(row)} feet, before of {len(rows[0])}.'
      raise _FieldError((*path, i, 'contacts'), message)
  return np.array(rows)


# Writing.


def motion_to_dict(motion: motion_lib.ReferenceMotion) -> dict[str, Any]:
  """Returns a motion as plain data, in the form of a mode file."""
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
    ledge = {'edge': motion.ledge.edge, 'height': motion.ledge.height}
    result['step'] = {key: float(value) for key, value in ledge.items()}
  return result


def mode_set_to_dict(mode_set: mode_set_lib.ModeSet) -> dict[str, Any]:
  """Returns a mode set as plain data: modes and latents."""
  return {
    'modes': [motion_to_dict(motion) for motion in mode_set.motions],
    'latents': mode_set.latents.tolist(),
  }


def mode_set_from_dict(data: Mapping[str, Any]) -> mode_set_lib.ModeSet:
  """Returns the mode set of a `mode_set_to_dict`, to the bit.

  Raises:
    KeyError: the modes or their latents are missing.
    TypeError, ValueError, OverflowError: the modes or latents are invalid.
  """
  motions = tuple(motion_from_dict(motion) for motion in data['modes'])
  names = tuple(motion.name for motion in motions)
  codebook = codebook_lib.Codebook(names, data['latents'])
  return mode_set_lib.ModeSet(motions, codebook)
