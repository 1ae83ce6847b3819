"""Wrong files by the hundred thousand: does only the documented error come out?

    python -m benchmarks.reliability.fuzz --cases=200000 --out=fuzz.json

Two fuzzers feed the parsers of `fuzz_targets`, each with half of the cases:

- atheris, which keeps what reaches code that nothing has reached yet, where it
  is installed (`pip install atheris`; else the other one takes all cases);
- mutations of valid files: spans that are cut, doubled, moved or replaced by
  words that mean something to a parser, and values of JSON replaced by others.

An error is documented where its type is and its message is one line. Ends with
3 if anything else came out, and prints it with the file that led to it.
"""

import copy
import importlib.util
import json
import pathlib
import random
import subprocess
import sys
import tempfile
import time
from typing import Any, Callable, Sequence

from absl import flags
import tqdm

from benchmarks import common
from benchmarks.reliability import fuzz_targets
from dmc_multimode.bin import app

_CASES = flags.DEFINE_integer('cases', 200_000, 'Over all parsers.', 100)
_ATHERIS = flags.DEFINE_float(
  'atheris', 0.5, 'Share of the cases that atheris makes.', 0.0, 1.0
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of all cases.', 0)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')

_MOST_SHOWN = 5  # Escapes of a row.
_LONGEST = 2_000  # Characters of a documented message.

Row = dict[str, Any]


class Judge:
  """Feeds one parser and counts what comes out."""

  def __init__(self, target: fuzz_targets.Target):
    """Will feed `target`."""
    self._target = target
    self.cases = self.read = self.refused = 0
    self.escaped: list[tuple[str, str]] = []
    self.slowest = 0.0

  def feed(self, content: bytes) -> None:
    """Parses one file."""
    self.cases += 1
    began = time.perf_counter()
    try:
      self._target.run(content)
      self.read += 1
    except self._target.errors as error:
      self.refused += 1
      text = str(error)
      if not text or len(text.splitlines()) != 1 or len(text) > _LONGEST:
        self._escape(f'a message of {len(text)} characters: {text}', content)
    except (Exception, RecursionError) as error:  # What must never be.
      self._escape(f'{type(error).__name__}: {error}', content)
    self.slowest = max(self.slowest, time.perf_counter() - began)

  def _escape(self, what: str, content: bytes) -> None:
    self.escaped.append((what[:300], repr(content[:3_000])))

  def row(self, fuzzer: str, name: str, seconds: float) -> Row:
    """Returns what has been counted."""
    return {
      'fuzzer': fuzzer,
      'file': name,
      'cases': self.cases,
      'read': self.read,
      'refused': self.refused,
      'escaped': len(self.escaped),
      'slowest': self.slowest,
      'seconds': seconds,
      'escapes': self.escaped[:_MOST_SHOWN],
    }


def mutated(seed: bytes, source: random.Random) -> bytes:
  """Returns a valid file with a few changes."""
  content = bytearray(seed)
  for _ in range(source.randint(1, 4)):
    start = source.randrange(len(content) + 1)
    end = min(start + int(source.expovariate(0.15)), len(content))
    kind = source.randrange(5)
    if kind == 0:
      del content[start:end]
    elif kind == 1:
      content[start:start] = content[start:end] * source.randint(1, 3)
    elif kind == 2:
      content[start:end] = source.choice(fuzz_targets.WORDS)
    elif kind == 3:
      content[start:end] = bytes(
        source.randrange(256) for _ in range(end - start)
      )
    else:
      other = source.randrange(len(content) + 1)
      content[other:other] = content[start:end]
  return bytes(content)


_VALUES: Sequence[Any] = (
  *(None, True, False, 0, 1, -1, 2, 10**400, -(10**30), 0.5, 1e-320, 1e308),
  *(float('nan'), float('inf'), '', 'a', '0.3', 'pi2', [], {}, [[]], [1, 2]),
  *({'a': 1}, {'time': 1e4, 'velocity': [0, 0, 0]}, [0, 0, 0], [1, 0, 0, 0]),
)


def revalued(seed: bytes, source: random.Random) -> bytes:
  """Returns JSON in which some values are others."""
  data = json.loads(seed)
  for _ in range(source.randint(1, 3)):
    places = _places(data)
    if not places:
      break
    container, key = source.choice(places)
    if source.random() < 0.15:
      del container[key]
    else:
      container[key] = copy.deepcopy(source.choice(_VALUES))
  return json.dumps(data).encode()


def _places(data: Any) -> list[tuple[Any, Any]]:
  """Returns (container, key) of every value inside `data`."""
  places: list[tuple[Any, Any]] = []
  if isinstance(data, (dict, list)):
    for key in list(data) if isinstance(data, dict) else range(len(data)):
      places.append((data, key))
      places += _places(data[key])
  return places


def mutate(name: str, cases: int, seed: int, folder: pathlib.Path) -> Row:
  """Feeds a parser with changed files."""
  target = fuzz_targets.targets(folder)[name]
  judge, source, began = Judge(target), random.Random(seed), time.monotonic()
  for case in tqdm.trange(cases, desc=name, mininterval=5.0):
    valid = source.choice(target.seeds)
    is_json = valid.startswith(b'{')
    change: Callable[[bytes, random.Random], bytes] = mutated
    if is_json and case % 2:
      change = revalued
    judge.feed(change(valid, source))
  return judge.row('mutations', name, time.monotonic() - began)


# Runs in a process of its own: libFuzzer ends it, and instruments imports.
_ATHERIS_MAIN = """
import json, pathlib, sys, time
import atheris
with atheris.instrument_imports(include=['dmc_multimode', 'yaml', 'json']):
  from benchmarks import fuzz
  from benchmarks import fuzz_targets
name, out, cases = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
judge = fuzz.Judge(fuzz_targets.targets(out.parent)[name])
began = time.monotonic()
def feed(content):
  judge.feed(content)
  if judge.cases == cases:
    row = judge.row('atheris', name, time.monotonic() - began)
    out.write_text(json.dumps(row))
atheris.Setup([sys.argv[0], *sys.argv[4:]], feed)
atheris.Fuzz()
"""


def guide(name: str, cases: int, seed: int, folder: pathlib.Path) -> Row:
  """Lets atheris feed a parser."""
  target = fuzz_targets.targets(folder)[name]
  corpus, words, out = (folder / x for x in ('corpus', 'words', 'row.json'))
  corpus.mkdir()
  for i, content in enumerate(target.seeds):
    (corpus / str(i)).write_bytes(content)
  quoted = (
    ''.join(f'\\x{byte:02x}' for byte in word)
    for word in fuzz_targets.WORDS
    if len(word) <= 64
  )
  words.write_text(''.join(f'"{word}"\n' for word in quoted))
  # Some cases more, for those that only read the corpus.
  arguments = (f'-runs={cases + 100}', f'-seed={seed + 1}', f'-dict={words}')
  done = subprocess.run(
    [
      *(sys.executable, '-c', _ATHERIS_MAIN, name, str(out), str(cases)),
      *(*arguments, '-max_len=4096', '-verbosity=0'),
      *(f'-artifact_prefix={folder}/', str(corpus)),
    ],
    capture_output=True,
    text=True,
    errors='replace',
  )
  if not out.exists():
    raise ValueError(f'atheris failed: {done.stderr[-500:]}')
  row: Row = json.loads(out.read_text(encoding='utf-8'))
  return row


def run() -> list[Row]:
  """Runs both fuzzers on all parsers; returns the rows of the table."""
  rows = []
  has_atheris = importlib.util.find_spec('atheris') is not None
  guided = _ATHERIS.value if has_atheris else 0.0
  memory = '/dev/shm' if pathlib.Path('/dev/shm').is_dir() else None
  for name, target in fuzz_targets.targets(pathlib.Path()).items():
    cases = round(_CASES.value * target.share)
    for fuzzer, share in ((guide, guided), (mutate, 1 - guided)):
      if share * cases >= 1:
        with tempfile.TemporaryDirectory(dir=memory) as folder:
          rows.append(
            fuzzer(
              name, round(share * cases), _SEED.value, pathlib.Path(folder)
            )
          )
        _print_row(rows[-1])
  return rows


def _print_row(row: Row) -> None:
  print(
    f'{row["fuzzer"]:10}{row["file"]:18}{row["cases"]:9}{row["read"]:9}'
    f'{row["refused"]:9}{row["escaped"]:9}{1e3 * row["slowest"]:12.1f}',
    flush=True,
  )
  for what, content in row['escapes']:
    print(f'  {what}\n    {content}')


def main(argv: Sequence[str]) -> int:
  """Runs, prints, writes; returns whether nothing escaped."""
  del argv
  out = common.out_path(_OUT.value)
  print(
    f'{"fuzzer":10}{"file":18}{"cases":>9}{"read":>9}{"refused":>9}'
    f'{"escaped":>9}{"slowest ms":>12}'
  )
  rows = run()
  escaped = sum(row['escaped'] for row in rows)
  print(f'{sum(row["cases"] for row in rows):,} cases, {escaped} escaped.')
  common.write_report(
    out, {'benchmark': 'fuzz', 'table': rows, 'seed': _SEED.value}, ['atheris']
  )
  return app.EXIT_UNSOLVED if escaped else 0


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
