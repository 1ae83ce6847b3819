"""Pages of the site that are written elsewhere: a hook of MkDocs.

README.md, CONTRIBUTING.md and CHANGELOG.md lie outside of `docs`; the tour is a
notebook; the examples are programs; the cards of the shipped policies lie
beside their weights; and the reference comes from docstrings, one page a
package, of what the package exports.
"""

# Of the extra `docs`: not always there to be checked against.
# mypy: disable-error-code="import-not-found"

import ast
import base64
import json
import pathlib
import re
from typing import Any, Iterator, Mapping, NamedTuple

from mkdocs.structure import files as files_lib

_ROOT = pathlib.Path(__file__).parents[1]
_PACKAGE = 'dmc_multimode'
_OUTSIDE = re.compile(r'\[([^\]]*)\]\(\.\./[^)]*\)')  # A link out of `docs`.
# A link from the root to what lies beside `docs`: CITATION.cff.
_BESIDE = re.compile(r'\]\((?!docs/|https?:|#|CONTRIBUTING\.md|CHANGELOG\.md)')
# Links out of `docs` to what the site has as pages.
_EXAMPLE = re.compile(r'\]\(\.\./examples/(\w+)\.py\)')
_PAGES = {
  '](../examples)': '](EXAMPLES.md)',
  '](../dmc_multimode/pretrained)': '](POLICIES.md)',
  '](tour.ipynb)': '](tour.md)',
}
# Page of the reference -> its packages; what is not here is no public surface.
REFERENCE: Mapping[str, tuple[str, ...]] = {
  'package': ('',),
  'modes': ('modes', 'modes.encoder'),
  'arenas': ('arenas',),
  'walkers': ('walkers',),
  'suite': ('suite', 'suite.reaching', 'suite.wrappers'),
  'suite_imitation': ('suite.imitation',),
  'agents': ('agents',),
  'agents_ppo': ('agents.ppo',),
  'planner': ('planner',),
  'pretrained': ('pretrained',),
  'viewer': ('viewer',),
  'evaluation': ('evaluation',),
  'experiments': ('experiments',),
  'deployment': ('deployment',),
}
# A module that a package exports is a table of its names: they have details in
# the code, and a page stays one that people read.
_SUMMARY = """
::: {name}
    options:
      heading_level: 3
      members: false
      summary:
        functions: true
        classes: true
"""
_WHOLE = """
::: {name}
    options:
      heading_level: 3
"""


def on_files(files: Any, config: Any) -> Any:
  """Adds the pages; called by MkDocs once it has found its files."""
  tour, pictures = _tour(json.loads((_ROOT / 'docs/tour.ipynb').read_text()))
  pages: dict[str, str | bytes] = {
    'index.md': _read('README.md'),
    'CONTRIBUTING.md': _read('CONTRIBUTING.md'),
    'CHANGELOG.md': _read('CHANGELOG.md'),
    'tour.md': tour,
    'EXAMPLES.md': _examples(),
    **_cards(),
    **{f'api/{name}.md': page for name, page in _reference().items()},
    **pictures,
  }
  for name, content in pages.items():
    files.append(files_lib.File.generated(config, name, content=content))
  return files


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
  """Makes links to files that the site does not have plain text."""
  del kwargs
  for link, page in _PAGES.items():
    markdown = markdown.replace(link, page)
  markdown = _EXAMPLE.sub(
    lambda link: f'](EXAMPLES.md#{link[1].replace("_", "-")})', markdown
  )
  return _OUTSIDE.sub(r'\1', markdown)


def _read(name: str) -> str:
  """Returns a page that lies beside `docs`, its links as seen from inside."""
  text = _BESIDE.sub('](../', (_ROOT / name).read_text())
  return text.replace('](docs/', '](')


def _examples() -> str:
  """Returns the page of the examples: what each is for, and its code."""
  parts = [
    '# Examples\n\nEach is a program of `examples/` in the repository. They '
    'are not in the wheel: copy one from here, and `python NAME.py` runs it.\n'
  ]
  for path in sorted((_ROOT / 'examples').glob('*.py')):
    code = path.read_text()
    title = path.stem.replace('_', ' ').capitalize()
    about = (ast.get_docstring(ast.parse(code)) or '').partition('\n')[0]
    parts.append(
      f'## {title}\n\n`{path.name}`: {about}\n\n```python\n{code}```\n'
    )
  return '\n'.join(parts)


def _cards() -> dict[str, str]:
  """Returns the cards of the shipped policies, and the page that lists them."""
  cards, rows = {}, []
  for path in sorted((_ROOT / _PACKAGE / 'pretrained').glob('*/README.md')):
    name = path.parent.name
    metrics = json.loads(path.with_name('metrics.json').read_text())
    cards[f'policies/{name}.md'] = path.read_text()
    cells = [
      f'[{name}](policies/{name}.md)',
      ', '.join(metrics['modes']),
      *(f'{metrics[k]["mean"]:.3f}' for k in ('mra_modes', 'mra_transitions')),
    ]
    rows.append(f'| {" | ".join(cells)} |')
  head = (
    '# Shipped policies\n\nEach has a card with scores, training and limits. '
    'MRA is the mean normalised return, 1 for perfect tracking.\n\n'
    '| policy | modes | MRA modes | MRA transitions |\n|---|---|---|---|'
  )
  return {'POLICIES.md': '\n'.join([head, *rows, '']), **cards}


def _tour(notebook: Mapping[str, Any]) -> tuple[str, dict[str, bytes]]:
  """Returns the notebook as a page, and its pictures by their names."""
  parts: list[str] = []
  pictures: dict[str, bytes] = {}
  for cell in notebook['cells']:
    text = ''.join(cell['source'])
    if cell['cell_type'] == 'markdown':
      parts.append(text)
      continue
    body = [f'```python\n{text}\n```', *_outputs(cell, pictures)]
    if text.startswith('# @title Solution'):
      folded = '\n\n'.join(body).replace('\n', '\n    ')
      body = [f'??? note "Solution"\n\n    {folded}']
    parts += body
  note = 'As a notebook: <a href="tour.ipynb" download>tour.ipynb</a>.'
  return '\n\n'.join([parts[0], note, *parts[1:]]), pictures


def _outputs(
  cell: Mapping[str, Any], pictures: dict[str, bytes]
) -> Iterator[str]:
  """Yields a cell's outputs in Markdown; pictures are added to `pictures`."""
  for output in cell.get('outputs', ()):
    data = output.get('data', {})
    if output['output_type'] == 'stream':
      yield f'```text\n{"".join(output["text"]).rstrip()}\n```'
    elif 'image/png' in data:
      name = f'tour_{len(pictures)}.png'
      pictures[name] = base64.b64decode(''.join(data['image/png']))
      yield f'![What the cell draws]({name})'
    elif 'text/html' in data:
      yield ''.join(data['text/html'])


class _Export(NamedTuple):
  """Describes a name that a package exports.

  Attributes:
    name: in the package.
    home: the module where it is defined, and its name there; '' for what the
      package defines itself.
    is_module: whether it is a module.
  """

  name: str
  home: str
  is_module: bool


def _reference() -> dict[str, str]:
  """Returns the pages of the reference by their names.

  Each object is described once: functions of the facade there, all else in the
  first package that exports it. Other places link to that.
  """
  trees: dict[str, ast.Module] = {}
  homes: dict[str, tuple[str, str]] = {}  # Where an object is described.
  order = [(page, each) for page, all_ in REFERENCE.items() for each in all_]
  for page, package in [*order, order[0]]:  # Classes of the facade come last.
    full = f'{_PACKAGE}.{package}'.rstrip('.')
    path = _ROOT.joinpath(*full.split('.'), '__init__.py')
    trees[full] = ast.parse(path.read_text())
    is_first = not package and not homes
    for export in _exports(full, trees[full]):
      if not (is_first and export.name[0].isupper()):
        homes.setdefault(export.home, (page, f'{full}.{export.name}'))
  pages: dict[str, str] = {}
  for page, package in order:
    full = f'{_PACKAGE}.{package}'.rstrip('.')
    level = '##' if page in pages else '#'
    about = ast.get_docstring(trees[full]) or ''
    if not package:  # The rest stands on the first page.
      about = (
        about.partition('\n')[0] + '\n\nIn use: [Start](../index.md#use-it).'
      )
    parts = [f'{level} {full}\n\n{about}\n']
    for export in _exports(full, trees[full]):
      where, name = homes[export.home]
      if name != f'{full}.{export.name}':
        link = f'{where}.md' if where != page else ''
        parts.append(f'- `{export.name}`: [`{name}`]({link}#{name})')
      else:
        form = _SUMMARY if export.is_module else _WHOLE
        parts.append(form.format(name=name))
    pages[page] = '\n'.join([pages.get(page, ''), *parts]).lstrip()
  return pages


def _exports(package: str, tree: ast.Module) -> Iterator[_Export]:
  """Yields what `__all__` of a package names, but for constants."""
  values: dict[str, Any] = {}
  imported: dict[str, str] = {}
  defined = set()
  for node in ast.walk(tree):
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
      with_name = node.targets[0].id
      if with_name in ('__all__', '_HOMES'):
        values[with_name] = ast.literal_eval(node.value)
    elif isinstance(node, ast.ImportFrom):
      for alias in node.names:
        imported[alias.asname or alias.name] = f'{node.module}.{alias.name}'
    elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
      defined.add(node.name)
  folder = _ROOT.joinpath(*package.split('.'))
  for name in values.get('__all__', ()):
    is_module = (folder / f'{name}.py').exists() or (folder / name).is_dir()
    if is_module and name not in values.get('_HOMES', {}):
      yield _Export(name, f'{package}.{name}', True)
    elif name in imported:
      yield _Export(name, imported[name], False)
    elif name in defined:
      yield _Export(name, f'{package}.{name}', False)
