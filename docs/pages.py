"""Pages of the site that are written elsewhere: a hook of MkDocs.

README.md, CONTRIBUTING.md and CHANGELOG.md lie outside of `docs`, and the
reference comes from the docstrings: one page a part of the package, every
module of it in turn.
"""

# Of the extra `docs`: not always there to be checked against.
# mypy: disable-error-code="import-not-found"

import pathlib
import re
from typing import Any, Iterator

from mkdocs.structure import files as files_lib

_ROOT = pathlib.Path(__file__).parents[1]
_PACKAGE = 'dmc_multimode'
_REST = 'package'  # The page of modules that are in no part.
_OUTSIDE = re.compile(r'\[([^\]]*)\]\(\.\./[^)]*\)')  # A link out of `docs`.
# A link from the root to what is no page: CITATION.cff.
_NO_PAGE = re.compile(
  r'\[([^\]]*)\]\((?!docs/|https?:|#|CONTRIBUTING\.md|CHANGELOG\.md)[^)]*\)'
)


def on_files(files: Any, config: Any) -> Any:
  """Adds the pages; called by MkDocs once it has found its files."""
  pages = {
    'index.md': _read('README.md'),
    'CONTRIBUTING.md': _read('CONTRIBUTING.md'),
    'CHANGELOG.md': _read('CHANGELOG.md'),
    **{f'api/{part}.md': page for part, page in _reference().items()},
  }
  for name, content in pages.items():
    files.append(files_lib.File.generated(config, name, content=content))
  return files


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
  """Makes links to files that the site does not have plain text."""
  del kwargs
  return _OUTSIDE.sub(r'\1', markdown)


def _read(name: str) -> str:
  """Returns a page that lies beside `docs`, its links as seen from inside."""
  text = _NO_PAGE.sub(r'\1', (_ROOT / name).read_text())
  return text.replace('](docs/', '](')


def _reference() -> dict[str, str]:
  """Returns the pages of the reference by the part of the package."""
  pages: dict[str, str] = {}
  for part, module in _modules():
    title = _PACKAGE if part == _REST else f'{_PACKAGE}.{part}'
    page = pages.setdefault(part, f'# {title}\n')
    pages[part] = f'{page}\n::: {module}\n'
  return pages


def _modules() -> Iterator[tuple[str, str]]:
  """Yields the part and the name of every module that says what it is."""
  for path in sorted((_ROOT / _PACKAGE).rglob('*.py')):
    if path.read_text().startswith(('"""', 'r"""')):
      folder = path.parent.relative_to(_ROOT)
      part = folder.parts[1] if len(folder.parts) > 1 else _REST
      module = folder if path.name == '__init__.py' else folder / path.stem
      yield part, '.'.join(module.parts)
