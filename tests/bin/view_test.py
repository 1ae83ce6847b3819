"""Tests of dmc_multimode.bin.view: its flags, and its page in a browser.

Set VIEW_SCREENSHOT to a file to keep what the page shows in the end. More of
the page is tested in tests/viewer/page_test.py.
"""

import os
import pathlib
import re
import signal
import socket
import time
from typing import Any, Iterator

import pytest

from tests.bin import processes
from tests.viewer import browsers

_WIDTH, _HEIGHT = 960, 640  # Pixels; few of them are drawn on.


@pytest.fixture(scope='module')
def view(
  tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[processes.Binary]:
  binary = processes.Binary('view', tmp_path_factory.mktemp('output'))
  yield binary
  binary.close()


@pytest.fixture
def page() -> Iterator[Any]:
  """An empty page of a headless browser."""
  with browsers.chromium() as browser:
    yield browsers.new_page(browser, _WIDTH, _HEIGHT)


def _url(folder: pathlib.Path) -> str:
  """Waits for the URL that the binary prints."""
  begun = time.monotonic()
  while time.monotonic() - begun < browsers.PATIENCE:
    out = folder / 'stdout0'
    if out.exists() and out.read_text().endswith('\n'):
      return out.read_text().strip()
    time.sleep(0.1)
  raise AssertionError((folder / 'stderr0').read_text())


def test_a_click_on_launch_lands_on_the_block(
  page: Any, tmp_path: pathlib.Path
) -> None:
  view = processes.Binary('view', tmp_path)
  process = view.start('--policy=pi2', '--arena=flat', '--port=0')
  try:
    url = _url(tmp_path)
    assert re.fullmatch(r'http://127\.0\.0\.1:\d+', url)
    page.goto(url)
    status = page.locator('#dmm-status')
    status.get_by_text(re.compile(r'trunk z 0\.(4[5-9]|5[0-5]) m')).wait_for()
    page.get_by_role('button', name='4 launch').click()
    status.get_by_text(re.compile(r'trunk z 0\.(8[5-9]|9[0-5]) m')).wait_for()
    assert page.locator('#dmm-status b', has_text='launch').count() == 1
    page.keyboard.press('r')
    status.get_by_text(re.compile(r'trunk z 0\.(4[5-9]|5[0-5]) m')).wait_for()
    page.locator('#dmm-status b', has_text='idle').wait_for()
    if os.environ.get('VIEW_SCREENSHOT'):
      page.screenshot(path=os.environ['VIEW_SCREENSHOT'])
  finally:
    processes.send(process, signal.SIGINT)
    done = view.wait()
    view.close()
  assert (done.code, done.stderr) == (0, '')


def test_bad_input(view: processes.Binary) -> None:
  with socket.create_server(('127.0.0.1', 0)) as server:
    for flag, message in (
      (f'--port={server.getsockname()[1]}', 'in use'),
      ('--arena=moat', "Unknown arena 'moat'"),
      ('--host=192.0.2.1', 'is no address of this machine'),
    ):
      done = view('--port=0', flag)
      assert done.code == 2, done.stderr
      assert message in done.error


@pytest.mark.parametrize(
  ('flag', 'before', 'message'),
  [
    (
      '--viewer=native',
      "[os.environ.pop(name, None) for name in ('DISPLAY', 'WAYLAND_DISPLAY')]",
      'no display',
    ),
    ('--port=0', "sys.modules['viser'] = None", 'dmc_multimode[view]'),
  ],
)
def test_what_is_missing_is_named(
  view: processes.Binary, flag: str, before: str, message: str
) -> None:
  view.start(flag, before=f'import os, sys; {before}')
  done = view.wait()
  assert done.code == 2
  assert message in done.error
