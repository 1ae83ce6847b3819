"""A headless Chromium for tests, which draws in software."""

import contextlib
import importlib.util
import pathlib
import shutil
from typing import Any, Iterator

import pytest

PATIENCE = 300.0  # Seconds for a page, drawn in software on a busy machine.
# As root it has no sandbox.
_CHROMIUM = ['--no-sandbox', '--enable-unsafe-swiftshader']
_CHROMIUM += ['--use-angle=swiftshader']


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
  """Yields a browser of Playwright; skips the test where there is none."""
  for module in ('viser', 'mjviser'):
    if not importlib.util.find_spec(module):
      pytest.skip(f'no {module}: the page takes the extra `view`')
  api = pytest.importorskip(
    'playwright.sync_api', reason='no playwright: it is in the extra `browser`'
  )
  with api.sync_playwright() as playwright:
    own = pathlib.Path(playwright.chromium.executable_path)
    path = own if own.exists() else shutil.which('chromium')
    if not path:
      pytest.skip(
        'no Chromium: apt-get install chromium, or playwright install chromium'
      )
    browser = playwright.chromium.launch(executable_path=path, args=_CHROMIUM)
    yield browser
    browser.close()


def new_page(browser: Any, width: int, height: int) -> Any:
  """Returns an empty page of so many pixels, with cookies of its own."""
  page = browser.new_page(viewport={'width': width, 'height': height})
  page.set_default_timeout(1000 * PATIENCE)
  return page
