"""YAML and JSON as plain data, with the line of each value.

Nothing in a text is executed, and values cannot refer to each other: there are
mappings, lists, text, numbers, booleans and null, nested to a bounded depth.
"""

import json
import re
import reprlib
from typing import Any

import yaml

Path = tuple[str | int, ...]  # Path of a value, such as ('keyframes', 0).

_MAX_DEPTH = 20  # Nesting.
# Numbers are those of JSON and a little more: YAML 1.1 takes 1e-3 for text.
_NUMBER = re.compile(r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?')
_NOT_FINITE = re.compile(r'[-+]?\.?(inf|nan)', re.IGNORECASE)
_TAGS = frozenset(
  f'tag:yaml.org,2002:{kind}'
  for kind in ('map', 'seq', 'str', 'int', 'float', 'bool', 'null')
)


class LineError(ValueError):
  """A text is invalid at a line; the message is one line.

  Attributes:
    line: counted from 1.
  """

  def __init__(self, line: int, message: str):
    super().__init__(message)
    self.line = line


def parse(text: str, is_json: bool) -> tuple[Any, dict[Path, int]]:
  """Returns a text's plain data, and the line of each value.

  Args:
    text: of a file.
    is_json: requires JSON, a subset of YAML.

  Raises:
    LineError: the text is invalid, or uses features that are excluded.
  """
  if is_json:
    _check_json(text)
    text = text.replace('\t', ' ')  # Legal in JSON, not in YAML.
  try:
    node = yaml.compose(text, Loader=_Loader)
  except yaml.MarkedYAMLError as error:
    mark = error.problem_mark or error.context_mark
    line = mark.line + 1 if mark else 1
    raise LineError(line, f'{error.problem or error.context}.') from None
  except yaml.reader.ReaderError as error:
    line = text.count('\n', 0, error.position) + 1
    message = f'character U+{error.character:04X} is not allowed.'
    raise LineError(line, message) from None
  except ValueError as error:  # An escape such as "\UFFFFFFFF".
    message = f'not YAML ({reprlib.repr(str(error))}).'
    raise LineError(1, message) from None
  if node is None:
    raise LineError(1, 'the file is empty.')
  lines: dict[Path, int] = {(): node.start_mark.line + 1}
  return _plain(node, (), lines), lines


def _check_json(text: str) -> None:
  """Raises LineError, with the JSON parser's message, for invalid JSON."""
  try:
    json.loads(text)
  except json.JSONDecodeError as error:
    raise LineError(error.lineno, f'not JSON: {error.msg}.') from None
  except ValueError:  # Python refuses integers of more than 4300 digits.
    raise LineError(1, 'holds a number that is too long.') from None
  except RecursionError:
    raise LineError(1, 'nested too deeply.') from None


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


def _plain(node: yaml.Node, path: Path, lines: dict[Path, int]) -> Any:
  """Returns a node's value without calling a constructor; fills `lines`."""
  if node.tag not in _TAGS:
    # Only ISO dates get a tag of their own unasked: they are text here.
    if not (isinstance(node, yaml.ScalarNode) and 'timestamp' in node.tag):
      message = f'{reprlib.repr(node.tag)} is not allowed here.'
      raise LineError(lines[path], message)
  if isinstance(node, yaml.ScalarNode):
    return _scalar(node)
  if isinstance(node, yaml.SequenceNode):
    for i, item in enumerate(node.value):
      lines[(*path, i)] = item.start_mark.line + 1
    return [_plain(x, (*path, i), lines) for i, x in enumerate(node.value)]
  result: dict[str, Any] = {}
  for key_node, value_node in node.value:
    key, line = key_node.value, key_node.start_mark.line + 1
    if not isinstance(key, str):
      raise LineError(line, 'a field name must be plain text.')
    if key in result:
      raise LineError(line, f'{reprlib.repr(key)} is given twice.')
    lines[(*path, key)] = line
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
