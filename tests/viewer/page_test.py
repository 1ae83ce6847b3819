"""Tests of the live page in a headless Chromium: keys, tabs, narrow windows.

One server runs for all of them; a test begins with the robot at the start of a
flat track. Set PAGE_SCREENSHOTS to a folder to keep what the pages show.
"""

import os
import pathlib
import re
import subprocess
import sys
from typing import Any, Iterator

import pytest

from tests.viewer import browsers

_WIDTH, _HEIGHT = 820, 400  # Pixels; few of them are drawn on.
# A gamepad whose buttons a test presses.
_PAD = """
window.pad = {mapping: 'standard', axes: [0, 0, 0, 0],
  buttons: Array.from({length: 16}, () => ({pressed: false}))};
navigator.getGamepads = () => [null, window.pad];
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def url() -> Iterator[str]:
  """The address of a page, served by a process of its own."""
  command = [sys.executable, '-m', 'dmc_multimode.bin.view', '--port=0']
  with subprocess.Popen(
    command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
  ) as process:
    assert process.stdout and process.stderr
    yield process.stdout.readline().strip()
    process.terminate()
    assert process.stderr.read() == ''


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
  """A headless browser, for all tests."""
  with browsers.chromium() as found:
    yield found


@pytest.fixture
def page(browser: Any, url: str) -> Iterator[Any]:
  """A page of it, with the robot at rest."""
  page = browsers.new_page(browser, _WIDTH, _HEIGHT)
  _visit(page, url)
  page.keyboard.press('r')
  page.keyboard.press('1')
  page.keyboard.press('Escape')
  _mode(page, 'idle')
  yield page
  folder = os.environ.get('PAGE_SCREENSHOTS')
  if folder:
    name = os.environ['PYTEST_CURRENT_TEST'].split('::')[-1].split(' ')[0]
    page.screenshot(path=pathlib.Path(folder) / f'{name}.png')
  page.close()


def _visit(page: Any, url: str) -> None:
  page.goto(url)
  _status(page).get_by_text('trunk z').wait_for(state='attached')
  page.locator('#dmm-help').wait_for(state='attached')


def _status(page: Any) -> Any:
  return page.locator('#dmm-status')


def _mode(page: Any, mode: str) -> None:
  """Waits until the page shows a mode or blend."""
  _status(page).locator('b', has_text=re.compile(f'^{mode}$')).wait_for()


def _notice(page: Any, text: str) -> None:
  page.locator('#dmm-notice', has_text=text).wait_for()


def _track(page: Any, name: str) -> None:
  _field(page, 'track').click()
  page.get_by_role('option', name=name, exact=True).click()


def _field(page: Any, label: str) -> Any:
  return page.get_by_label(label, exact=True)


def test_title_icon_and_help(page: Any) -> None:
  assert page.title() == 'pi2 - dmc_multimode'
  icon = page.locator('link[rel="icon"]').get_attribute('href')
  assert icon.startswith('data:image/svg+xml') and '1971c2' in icon
  page.keyboard.press('x')
  _notice(page, 'There is no plan')
  page.keyboard.press('?')
  shown = page.get_by_role('dialog', name='Help')
  shown.wait_for()
  for text in ('Gamepad', 'the reference', 'carry the plan out'):
    assert text in shown.inner_text()
  page.keyboard.press('Escape')  # It closes the help, and no more.
  shown.wait_for(state='hidden')
  _notice(page, 'There is no plan')
  assert 'the reference' in page.locator('#dmm-legend').inner_text()


def test_fields_and_keys(page: Any) -> None:
  seed = _field(page, 'seed')
  seed.fill('')
  seed.type('12')
  page.wait_for_timeout(300)
  _mode(page, 'idle')  # Typing commands nothing.
  page.keyboard.press('Enter')
  page.keyboard.press('2')
  _mode(page, 'walk_forward')
  assert seed.input_value() == '12'
  seed.click()
  page.wait_for_timeout(3000)  # Nobody types.
  page.keyboard.press('1')
  _mode(page, 'idle')
  assert seed.input_value() == '12'
  _track(page, 'gap')
  page.keyboard.press('3')
  _mode(page, 'leap_forward')
  assert _field(page, 'track').input_value() == 'gap'
  _track(page, 'flat')


def test_notices_stay_in_odd_orders(page: Any) -> None:
  _track(page, 'gap_block')
  page.keyboard.press('x')  # Nothing to replay yet.
  _notice(page, 'There is no plan')
  page.keyboard.press('p')
  _status(page).get_by_text('planning:').wait_for()
  _notice(page, 'There is no plan')  # While it is planned.
  page.keyboard.press('p')
  _notice(page, 'searched for already')
  _track(page, 'gap')  # Another track ends the search.
  _status(page).get_by_text('planning:').wait_for(state='detached')
  page.keyboard.press('p')
  _notice(page, 'A plan that')
  page.keyboard.press('2')
  _notice(page, 'A plan that')
  page.keyboard.press('x')
  _status(page).get_by_text('(plan)').wait_for()
  page.locator('#dmm-notice .dmm-dismiss').click()
  page.locator('#dmm-notice .dmm-notice').wait_for(state='detached')
  _track(page, 'flat')


def test_two_tabs_and_a_reload(page: Any, browser: Any, url: str) -> None:
  other = browsers.new_page(browser, _WIDTH, _HEIGHT)
  _visit(other, url)
  page.get_by_role('button', name='2 walk_forward').click()
  _mode(other, 'walk_forward')
  rate = page.get_by_role('slider').first
  rate.focus()
  page.keyboard.press('ArrowRight')
  shown = other.get_by_role('slider').first
  assert rate.get_attribute('aria-valuenow') == '1.05'
  other.wait_for_timeout(500)
  assert shown.get_attribute('aria-valuenow') == '1.05'
  _track(other, 'block')
  page.reload()
  _status(page).get_by_text('trunk z').wait_for()
  assert _field(page, 'track').input_value() == 'block'
  page.keyboard.press('1')  # The script is there again.
  _mode(other, 'idle')
  page.keyboard.press('?')
  page.get_by_role('dialog', name='Help').wait_for()
  assert page.locator('#dmm-help').count() == 1
  page.keyboard.press('Escape')
  other.close()
  page.keyboard.press('z')
  _track(page, 'flat')
  page.keyboard.press('2')
  _mode(page, 'walk_forward')


def test_a_blend_and_disturbances(page: Any) -> None:
  sliders = page.get_by_role('slider')
  sliders.nth(2).focus()  # Of the blend: idle and walk_forward.
  page.keyboard.press('ArrowRight')
  _mode(page, r'walk_forward 60% \+ idle 40%')
  friction = sliders.nth(4)
  friction.focus()
  page.keyboard.press('Home')
  # On ice it may have fallen before the page says so.
  _status(page).get_by_text(re.compile(r'up for \d+ s, falls: \d')).wait_for()
  for _ in range(4):
    page.keyboard.press('j')
  many = re.compile('falls: [1-9], [0-9.]+ a minute')
  _status(page).get_by_text(many).wait_for()
  _notice(page, 'It has fallen')
  page.get_by_role('button', name='nominal robot').click()
  page.wait_for_timeout(500)
  assert friction.get_attribute('aria-valuenow') == '0.9'


@pytest.mark.gl
def test_a_recording_is_downloaded(page: Any, tmp_path: pathlib.Path) -> None:
  page.keyboard.press('v')
  _status(page).get_by_text(re.compile(r'recording: [1-9]')).wait_for()
  with page.expect_download() as download:
    page.get_by_role('button', name='V stop and save').click()
    _notice(page, 'are being drawn')
    page.keyboard.press('v')
    _notice(page, 'still being drawn')
  assert download.value.suggested_filename == 'pi2_flat_1.mp4'
  out = tmp_path / 'video.mp4'
  download.value.save_as(out)
  assert out.read_bytes()[4:8] == b'ftyp'
  _notice(page, 'is in your downloads')


def test_a_narrow_window_shows_the_robot(page: Any) -> None:
  page.set_viewport_size({'width': 420, 'height': 700})
  button = page.get_by_role('button', name='2 walk_forward')
  button.wait_for(state='hidden')
  mirror = page.locator('#dmm-mirror')
  mirror.get_by_text('trunk z').wait_for()
  page.keyboard.press('x')
  mirror.get_by_text('There is no plan').wait_for()
  mirror.locator('.dmm-dismiss').click()
  mirror.locator('.dmm-notice').wait_for(state='detached')
  page.get_by_text('dmc_multimode', exact=True).click()
  button.click()
  mirror.locator('b', has_text='walk_forward').wait_for(state='attached')
  page.set_viewport_size({'width': 700, 'height': 500})
  button.wait_for(state='hidden')


def test_a_gamepad_presses_keys(browser: Any, url: str) -> None:
  page = browsers.new_page(browser, _WIDTH, _HEIGHT)
  page.add_init_script(_PAD)
  _visit(page, url)
  press = lambda button: page.evaluate(
    '(button) => { button.pressed = true;'
    ' setTimeout(() => { button.pressed = false; }, 200); }',
    page.evaluate_handle(f'window.pad.buttons[{button}]'),
  )
  press(9)
  press(0)
  _mode(page, 'idle')
  press(5)  # The next mode, once.
  _mode(page, 'walk_forward')
  page.wait_for_timeout(500)
  _mode(page, 'walk_forward')
  press(2)
  _mode(page, 'leap_forward')
  press(0)
  page.close()
