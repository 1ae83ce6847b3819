"""Counts what the source is like: lengths, docstrings, annotations, comments.

    python -m benchmarks.release.style dmc_multimode benchmarks tests

The same counts can be made of any other project's folder, to compare with.
"""

import ast
import io
import pathlib
import re
import sys
import tokenize
from typing import Iterator, NamedTuple, Sequence

import numpy as np

# First words of a docstring that say nothing of what the code does.
ODD_WORDS = re.compile(r'(What|How|Where|Whether|Is|Has|Lets|Who|Why)\b')
_Function = ast.FunctionDef | ast.AsyncFunctionDef


class Figures(NamedTuple):
  """Counts over the modules of a folder.

  Attributes:
    files: how many modules.
    file_lines: their lengths.
    function_lines: lengths of all functions.
    documented: of each public function and class, whether it has a docstring.
    annotated: of each function, whether its return value is annotated.
    comment_lines: how many lines have a comment of their own.
    odd: places of docstrings that begin with one of `ODD_WORDS`.
  """

  files: int
  file_lines: list[int]
  function_lines: list[int]
  documented: list[bool]
  annotated: list[bool]
  comment_lines: int
  odd: list[str]


def count(folder: pathlib.Path) -> Figures:
  """Counts over all modules below a folder."""
  figures = Figures(0, [], [], [], [], 0, [])
  comments = 0
  for path in sorted(folder.rglob('*.py')):
    text = path.read_text(encoding='utf-8')
    lines = text.splitlines()
    if not lines:
      continue
    figures.file_lines.append(len(lines))
    comments += sum(1 for _ in _comments(text))
    for node in ast.walk(ast.parse(text)):
      if isinstance(node, _Function):
        figures.function_lines.append(_length(node))
        figures.annotated.append(node.returns is not None)
      if isinstance(
        node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
      ):
        if not node.name.startswith('_'):
          figures.documented.append(ast.get_docstring(node) is not None)
      figures.odd.extend(_odd(path, node))
  return figures._replace(files=len(figures.file_lines), comment_lines=comments)


def _length(node: _Function) -> int:
  return (node.end_lineno or node.lineno) - node.lineno + 1


def _odd(path: pathlib.Path, node: ast.AST) -> Iterator[str]:
  if isinstance(
    node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module
  ):
    docstring = ast.get_docstring(node) or ''
    if ODD_WORDS.match(docstring):
      line = getattr(node, 'lineno', 1)
      yield f'{path}:{line}: {docstring.splitlines()[0]}'


def _comments(text: str) -> Iterator[tokenize.TokenInfo]:
  """Yields the comments that have a line of their own."""
  for token in tokenize.generate_tokens(io.StringIO(text).readline):
    if token.type == tokenize.COMMENT and token.line.lstrip().startswith('#'):
      yield token


def _quantiles(lengths: Sequence[int]) -> str:
  median, ninety = np.percentile(lengths, (50, 90))
  return f'{median:.0f} / {ninety:.0f} / {max(lengths)}'


def main(folders: Sequence[str]) -> None:
  """Prints a column for each folder."""
  found = [count(pathlib.Path(folder)) for folder in folders]
  share = lambda flags: f'{100 * np.mean(flags or [False]):.0f} %'
  rows = {
    '': list(folders),
    'files': [str(f.files) for f in found],
    'lines': [f'{sum(f.file_lines):,}' for f in found],
    'lines a file, median / p90 / max': [
      _quantiles(f.file_lines) for f in found
    ],
    'lines a function, median / p90 / max': [
      _quantiles(f.function_lines) for f in found
    ],
    'functions over 40 lines': [
      share([n > 40 for n in f.function_lines]) for f in found
    ],
    'public functions and classes documented': [
      share(f.documented) for f in found
    ],
    'return annotations': [share(f.annotated) for f in found],
    'lines that are comments': [
      f'{100 * f.comment_lines / sum(f.file_lines):.1f} %' for f in found
    ],
    'odd first words of docstrings': [str(len(f.odd)) for f in found],
  }
  for name, values in rows.items():
    print(f'| {name:42} | ' + ' | '.join(f'{v:>14}' for v in values) + ' |')
  for figures in found:
    for place in figures.odd:
      print(place)


if __name__ == '__main__':
  main(sys.argv[1:] or ['dmc_multimode', 'benchmarks', 'tests'])
