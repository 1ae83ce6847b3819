"""Feeds wrong files to the parsers: only documented errors may come out.

    python -m benchmarks.reliability.fuzz --cases=20000 --out=fuzz.json

hypothesis changes files that a parser reads: spans are cut, copied or replaced
by words that mean something to a parser, and values of JSON by others. A case
is refused where the documented error came out, with a message of one line; it
has escaped where anything else did. hypothesis then looks for the smallest file
that leads there, which is printed. Ends with 3 if anything escaped.
"""

import copy
import functools
import json
import pathlib
import tempfile
import time
from typing import Any, Callable, Iterator, Mapping, NamedTuple, Sequence

from absl import flags
import hypothesis
from hypothesis import strategies as st

from benchmarks import common
from dmc_multimode.bin import app
from dmc_multimode.modes import codebook
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import mode_set
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.utils import files

_CASES = flags.DEFINE_integer('cases', 20_000, 'Over all parsers.', 100)
_SEED = flags.DEFINE_integer('seed', 0, 'Of all cases.', 0)
_OUT = common.define_out()

_LONGEST = 2_000  # Characters of a documented message.

_COLUMNS = (
  'file | cases:,d | read:,d | refused:,d | escaped:d | slowest s=slowest:.4f'
)

Row = common.Row
Path = tuple[str | int, ...]  # Keys down to a value of JSON.

_MODE = b"""\
name: hop_in_place
kind: periodic
duration: 0.6  # Seconds.
takeoff: 0.25
mirror: hop_in_place
half_cycle_symmetric: true
step: {edge: 0.3, height: -0.1}
keyframes:
  - {phase: 0.0, position: [0, 0, 0.5], contacts: [1, 1]}
  - phase: 5e-1
    position: [0, 0, .6]
    euler: [0, 0, 45]
    contacts: [0, 0]
  - {phase: 1, position: [0, 0, 0.5], orientation: [1, 0, 0, 0],
     contacts: [1, 1]}
"""
_PLAN = {
  'plan': ['idle', 'launch', 'launch', 'idle'],
  'knots': 4,
  'dt': 0.3,
  'arena': 'gap',
  'sizes': {'width': 0.3},
  'seed': 2,
  'pushes': [{'time': 0.6, 'velocity': [0.5, 0, -0.1]}],
}


class Parser(NamedTuple):
  """Reads a file of that name, whose valid content is `valid`, or raises."""

  file: str
  read: Callable[[pathlib.Path], Any]
  error: type[Exception]
  valid: bytes
  share: float


def parsers() -> Mapping[str, Parser]:
  """Returns all parsers by the name of what they read."""
  motions = library.resolve('pi3')
  mode = json.dumps(mode_files.motion_to_dict(motions[0])).encode()
  latents = mode_set.one_hot(motions).codebook.to_json().encode()
  plan = json.dumps(_PLAN).encode()
  error, read = mode_files.ModeFileError, plan_lib.PlanFile.read
  load: Callable[[pathlib.Path], Any] = mode_files.load
  table = {
    'mode file, YAML': ('modes.yaml', load, error, _MODE, 0.2),
    'mode file, JSON': ('modes.json', load, error, mode, 0.05),
    'plan file': ('plan.json', read, ValueError, plan, 0.65),
    'codebook.json': (codebook.FILE, codebook.load, ValueError, latents, 0.1),
  }
  return {name: Parser(*row) for name, row in table.items()}


# Words that mean something to a parser, and numbers that go wrong.
_WORDS = tuple(
  word.encode()
  for word in (
    *'[]{}:,-?&*!|>\'"%@#\n\t .\\',
    *('null', 'true', '.inf', '-.inf', '.nan', 'NaN', 'Infinity', '1e999'),
    *('1e-320', '-0', '0', '1', '9' * 400, '-1e4', '0x10', '1_000', '~'),
    *('!!python/name:os.system', '!!binary', '<<', '---', '...', '\\ud800'),
    *('\x00', '\ufeff', '\u2028', '[' * 40, '[' * 4_000, '{"a":' * 40, 'pi2'),
    *('name', 'kind', 'keyframes', 'phase', 'position', 'modes', 'step'),
    *('plan', 'knots', 'dt', 'arena', 'sizes', 'seed', 'pushes', 'time'),
    *('velocity', 'latents', 'hidden_sizes', 'task', 'gains', 'limits'),
  )
)
_GONE = object()  # Stands for a value that is left out.
_NUMBERS = (10**400, -(10**30), 1e-320, 1e308, 1e4, float('nan'), float('inf'))
_SCALARS = (
  st.none()
  | st.booleans()
  | st.integers()
  | st.floats()
  | st.text(max_size=5)
  | st.sampled_from([*_NUMBERS, '0.3', 'pi2', 'x' * 100_000])
)
_VALUES = st.just(_GONE) | st.recursive(
  _SCALARS,
  lambda inner: (
    st.lists(inner, max_size=4)
    | st.dictionaries(st.sampled_from(['time', 'velocity', 'a']), inner)
  ),
  max_leaves=6,
)


def _edited(valid: bytes, edits: Sequence[tuple[int, int, bytes]]) -> bytes:
  """Returns the file with spans (start, length) replaced by other bytes."""
  for start, length, piece in edits:
    valid = valid[:start] + piece + valid[start + length :]
  return valid


def _edits(valid: bytes) -> st.SearchStrategy[bytes]:
  """Draws a valid file with a few changed spans."""
  place, length = st.integers(0, len(valid)), st.integers(0, 20)
  copied = st.builds(lambda start, n: valid[start : start + n], place, length)
  piece = st.sampled_from(_WORDS) | copied | st.binary(max_size=8)
  edits = st.lists(st.tuples(place, length, piece), min_size=1, max_size=4)
  return edits.map(functools.partial(_edited, valid))


def _paths(data: Any) -> Iterator[Path]:
  """Yields the keys that lead to every value inside `data`."""
  if isinstance(data, (dict, list)):
    for key in data if isinstance(data, dict) else range(len(data)):
      yield (key,)
      yield from ((key, *rest) for rest in _paths(data[key]))


def _revalued(data: Any, changes: Sequence[tuple[Path, Any]]) -> bytes:
  """Returns JSON with the values at some paths replaced, or left out."""
  data = copy.deepcopy(data)
  for (*above, key), value in changes:
    try:
      container = functools.reduce(lambda found, k: found[k], above, data)
      if value is _GONE:
        del container[key]
      else:
        container[key] = copy.deepcopy(value)
    except (KeyError, IndexError, TypeError):
      pass  # An earlier change has taken the place away.
  return json.dumps(data).encode()


def _contents(valid: bytes) -> st.SearchStrategy[bytes]:
  """Draws files that are valid but for a few changes."""
  if not valid.startswith(b'{'):
    return _edits(valid)
  data = json.loads(valid)
  place = st.sampled_from(list(_paths(data)))
  changes = st.lists(st.tuples(place, _VALUES), min_size=1, max_size=3)
  return _edits(valid) | changes.map(functools.partial(_revalued, data))


def feed(name: str, cases: int, seed: int, folder: pathlib.Path) -> Row:
  """Returns what came of so many wrong files for a parser, in a folder."""
  parser, escapes = parsers()[name], dict[str, str]()
  row: Row = {'file': name, 'cases': 0, 'read': 0, 'refused': 0, 'slowest': 0.0}
  path, first = folder / parser.file, time.monotonic()

  @hypothesis.seed(seed)
  @hypothesis.settings(
    max_examples=cases,
    database=None,
    deadline=None,
    phases=(hypothesis.Phase.generate, hypothesis.Phase.shrink),
    suppress_health_check=list(hypothesis.HealthCheck),
  )
  @hypothesis.given(_contents(parser.valid))
  def judge(content: bytes) -> None:
    row['cases'] += 1
    path.write_bytes(content)
    began = time.perf_counter()
    try:
      parser.read(path)
      row['read'] += 1
    except BaseException as error:
      text, is_documented = str(error), isinstance(error, parser.error)
      row['refused'] += is_documented
      if (
        is_documented and len(text.splitlines()) == 1 and len(text) <= _LONGEST
      ):
        return
      # The last one that hypothesis tries is the smallest.
      escapes[f'{type(error).__name__}: {text}'[:300]] = repr(content[:3_000])
      raise
    finally:
      row['slowest'] = max(row['slowest'], time.perf_counter() - began)

  try:
    judge()
  except Exception:
    if not escapes:
      raise
  row |= {'escaped': len(escapes), 'escapes': list(escapes.items())}
  return {**row, 'seconds': time.monotonic() - first}


def main(argv: Sequence[str]) -> int:
  """Feeds all parsers, prints, writes; returns the exit code."""
  del argv
  out, rows = files.output_file('out', _OUT.value), []
  for name, parser in parsers().items():
    with tempfile.TemporaryDirectory() as folder:
      cases = round(_CASES.value * parser.share)
      rows.append(feed(name, cases, _SEED.value, pathlib.Path(folder)))
    for what, content in rows[-1]['escapes']:
      print(f'{name}: {what}\n  {content}', flush=True)
  common.print_table(_COLUMNS, rows)
  report = {'benchmark': 'fuzz', 'table': rows, 'seed': _SEED.value}
  common.write_report(out, report, ['hypothesis'])
  return app.EXIT_UNSOLVED if any(row['escaped'] for row in rows) else 0


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
