"""Users' own modes: YAML or JSON files to reference motions and back.

A file holds one mode, or several under `modes:`. Its fields are those of
`motion_lib.ReferenceMotion`, with the keyframes as a list:

  name: hop_in_place
  kind: periodic             # or transient, or steady
  duration: 0.6              # seconds
  keyframes:
    - {phase: 0.0, position: [0, 0, 0.5], contacts: [1, 1]}
    - {phase: 0.5, position: [0, 0, 0.6], contacts: [0, 0]}
    - {phase: 1.0, position: [0, 0, 0.5], contacts: [1, 1]}

A keyframe may turn the base by `orientation: [w, x, y, z]` or by
`euler: [roll, pitch, yaw]` in degrees (rotations about the fixed x, y and z
axes in this order); it is upright otherwise. Optional per mode: `step: {edge,
height}`, `takeoff`, `mirror`, `half_cycle_symmetric`.

Nothing in a file is executed, and every error names the file and the line.
"""

import json
import os
import re
import reprlib
from typing import Any, Mapping, NoReturn

import yaml

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import fields
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.utils import files

MAX_BYTES = 1_000_000

_MAX_DEPTH = 20  # Nesting of a file; a mode needs 5 levels.
_NUMBER = re.compile(r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?')
_NOT_FINITE = re.compile(r'[-+]?\.?(inf|nan)', re.IGNORECASE)
_TAGS = frozenset(
  f'tag:yaml.org,2002:{kind}'
  for kind in ('map', 'seq', 'str', 'int', 'float', 'bool', 'null')
)


class ModeFileError(ValueError):
  """A mode cannot be read; the message is one line: what, where and why."""


def load(
  path: str | os.PathLike[str],
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Reads the modes of a YAML or JSON file, in their order there.

  Raises:
    ModeFileError: the file cannot be read or is not a valid mode file; the
      message begins with `FILE:LINE:` wherever there is a line to point at.
  """
  text = _read(path)
  data, lines = _parse(path, text)
  try:
    return fields.motions(data)
  except fields.FieldError as error:
    known = (error.path[:n] for n in range(len(error.path), -1, -1))
    line = next(lines[prefix] for prefix in known if prefix in lines)
    _fail(path, line, str(error))


def motion_to_dict(motion: motion_lib.ReferenceMotion) -> dict[str, Any]:
  """Returns a motion as plain data, as a mode file would hold it."""
  return fields.to_dict(motion)


def motion_from_dict(data: Mapping[str, Any]) -> motion_lib.ReferenceMotion:
  """Returns the motion that `motion_to_dict` wrote, exactly.

  Raises:
    ModeFileError: a field is missing, unknown or wrong; the message names it.
  """
  try:
    return fields.motion(data, ())
  except fields.FieldError as error:
    raise ModeFileError(f'{error.spell()}: {error}') from None


def mode_set_to_dict(mode_set: mode_set_lib.ModeSet) -> dict[str, Any]:
  """Returns a mode set as plain data: its modes, and their latents."""
  return {
    'modes': [motion_to_dict(motion) for motion in mode_set.motions],
    'latents': mode_set.latents.tolist(),
  }


def mode_set_from_dict(data: Mapping[str, Any]) -> mode_set_lib.ModeSet:
  """Returns the mode set that `mode_set_to_dict` wrote, exactly.

  Raises:
    KeyError: the modes or their latents are missing.
    TypeError, ValueError, OverflowError: they are wrong.
  """
  motions = tuple(motion_from_dict(motion) for motion in data['modes'])
  names = tuple(motion.name for motion in motions)
  codebook = codebook_lib.Codebook(names, data['latents'])
  return mode_set_lib.ModeSet(motions, codebook)


# Text to plain data, with the line of every value.


def _fail(path: str | os.PathLike[str], line: int, message: str) -> NoReturn:
  raise ModeFileError(f'{os.fspath(path)}:{line}: {message}') from None


def _read(path: str | os.PathLike[str]) -> str:
  """Returns the text of a file; raises ModeFileError where there is none."""
  name = os.fspath(path)
  try:
    content = files.read_bounded(path, MAX_BYTES)
  except (OSError, ValueError) as error:  # Too large, or a NUL in the name.
    reason = getattr(error, 'strerror', None) or str(error)
    raise ModeFileError(f'{name}: cannot be read ({reason}).') from None
  try:
    return content.decode('utf-8-sig')
  except UnicodeDecodeError as error:
    line = content.count(b'\n', 0, error.start) + 1
    _fail(path, line, 'not UTF-8 text.')


def _parse(
  path: str | os.PathLike[str], text: str
) -> tuple[Any, dict[fields.Path, int]]:
  """Returns a file's plain data, and the line on which each value begins."""
  if os.fspath(path).lower().endswith('.json'):
    _check_json(path, text)
    text = text.replace('\t', ' ')  # Legal between JSON's tokens, not YAML's.
  try:
    node = yaml.compose(text, Loader=_Loader)
  except yaml.MarkedYAMLError as error:
    mark = error.problem_mark or error.context_mark
    line = mark.line + 1 if mark else 1
    _fail(path, line, f'{error.problem or error.context}.')
  except yaml.reader.ReaderError as error:
    line = text.count('\n', 0, error.position) + 1
    _fail(path, line, f'character U+{error.character:04X} is not allowed.')
  except ValueError as error:  # An escape such as "\UFFFFFFFF".
    _fail(path, 1, f'not YAML ({reprlib.repr(str(error))}).')
  if node is None:
    _fail(path, 1, 'the file is empty.')
  lines: dict[fields.Path, int] = {(): node.start_mark.line + 1}
  try:
    return _plain(node, (), lines), lines
  except fields.FieldError as error:
    _fail(path, lines[error.path], str(error))


def _check_json(path: str | os.PathLike[str], text: str) -> None:
  """Raises ModeFileError where a file is not JSON, in JSON's own words."""
  try:
    json.loads(text)
  except json.JSONDecodeError as error:
    _fail(path, error.lineno, f'not JSON: {error.msg}.')
  except ValueError:  # Python refuses integers of more than 4300 digits.
    _fail(path, 1, 'holds a number that is too long.')
  except RecursionError:
    _fail(path, 1, 'nested too deeply.')


class _Loader(yaml.SafeLoader):
  """Composes nodes with their lines; refuses aliases and deep nesting."""

  _depth = 0

  def compose_node(self, parent: Any, index: Any) -> Any:
    event: Any = self.peek_event()
    if self.check_event(yaml.AliasEvent):
      raise yaml.composer.ComposerError(
        problem='aliases (*name) are not supported',
        problem_mark=event.start_mark,
      )
    if self._depth >= _MAX_DEPTH:
      raise yaml.composer.ComposerError(
        problem='nested too deeply', problem_mark=event.start_mark
      )
    self._depth += 1
    node = super().compose_node(parent, index)
    self._depth -= 1
    return node


def _plain(
  node: yaml.Node, path: fields.Path, lines: dict[fields.Path, int]
) -> Any:
  """Returns a node's value without calling a constructor; fills `lines`.

  Raises:
    fields.FieldError: a key is not text or is given twice, or a value has a
      tag such as !!python/name.
  """
  if node.tag not in _TAGS:
    # Only ISO dates get a tag of their own unasked: they are text here.
    if not (isinstance(node, yaml.ScalarNode) and 'timestamp' in node.tag):
      raise fields.FieldError(
        path, f'{reprlib.repr(node.tag)} is not allowed here.'
      )
  if isinstance(node, yaml.SequenceNode):
    for i, item in enumerate(node.value):
      lines[(*path, i)] = item.start_mark.line + 1
    return [_plain(x, (*path, i), lines) for i, x in enumerate(node.value)]
  if isinstance(node, yaml.ScalarNode):
    return _scalar(node)
  result: dict[str, Any] = {}
  for key_node, value_node in node.value:
    key = key_node.value
    line = key_node.start_mark.line + 1
    if not isinstance(key, str):
      lines[path] = line
      raise fields.FieldError(path, 'a field name must be plain text.')
    lines[(*path, key)] = line
    if key in result:
      raise fields.FieldError(
        (*path, key), f'{reprlib.repr(key)} is given twice.'
      )
    result[key] = _plain(value_node, (*path, key), lines)
  return result


def _scalar(node: yaml.ScalarNode) -> str | float | bool | None:
  """Returns text, number, boolean or None; quoted values are text."""
  text: str = node.value
  if node.style is not None:
    return text
  if text.lower() in ('true', 'false'):
    return text.lower() == 'true'
  if text.lower() in ('', '~', 'null'):
    return None
  if _NOT_FINITE.fullmatch(text):
    return float(text.replace('.', ''))
  return float(text) if _NUMBER.fullmatch(text) else text
