"""The page's own script in the browser: help, legend, fields and gamepad.

viser's client has no place for them. It does run scripts of the server, which
is how viser itself brings Plotly to the browser; so `install` sends `page.js`.
Without it the page works as before: only what is listed above is missing.
"""

import html
import json
import pathlib
from typing import Mapping, NamedTuple, Sequence

import viser
from viser import _messages as messages

LABEL = 'dmc_multimode'  # Of the panel.
_SCRIPT = pathlib.Path(__file__).with_name('page.js')
_ICON = (
  '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32">'
  '<rect width="32" height="32" rx="7" fill="#1971c2"/>'
  '<rect x="10" y="4" width="12" height="10" rx="2" fill="#fff"/>'
  '<path d="M13 14l-4 6 4 7M19 14l4 6-5 7" fill="none" stroke="#ffd8a8" '
  'stroke-width="3" stroke-linecap="round" stroke-linejoin="round"/></svg>'
)
_STYLE = """
/* Containers of buttons alone, in viser's panel: two beside each other. */
div:has(> div > button[id]):not(:has(> div > :not(button[id]))) {
  display: grid; grid-template-columns: 1fr 1fr; }
div:has(> div > button[id]):not(:has(> div > :not(button[id]))) > div {
  margin: 0 0.25em; padding-bottom: 0.4em; min-width: 0; }
#dmm-legend, #dmm-mirror, #dmm-help > div { font: 13px/1.45 sans-serif;
  background: rgba(255, 255, 255, 0.85); color: #212529; border-radius: 6px; }
#dmm-legend { position: fixed; left: 12px; bottom: 12px; padding: 6px 10px;
  pointer-events: none; z-index: 3; }
#dmm-legend div, #dmm-help .dmm-mark { display: flex; align-items: center;
  gap: 8px; }
.dmm-swatch { display: inline-block; flex: none; width: 18px; height: 12px; }
#dmm-help-button { position: fixed; left: 12px; top: 12px; width: 34px;
  height: 34px; border: 0; border-radius: 50%; z-index: 401; cursor: pointer;
  font: bold 18px sans-serif; color: #fff; background: #1971c2; }
/* Beside the button, not on it. */
.mantine-Notifications-root { left: 56px !important; }
#dmm-help { position: fixed; inset: 0; z-index: 500; display: flex;
  align-items: center; justify-content: center; padding: 10px;
  background: rgba(0, 0, 0, 0.35); }
#dmm-help[hidden] { display: none; }
#dmm-help > div { background: #fff; padding: 14px 20px; max-width: 720px;
  max-height: 94vh; overflow: auto; box-sizing: border-box; }
#dmm-help h2 { font-size: 17px; margin: 0 0 8px; }
#dmm-help h3 { font-size: 14px; margin: 12px 0 4px; }
#dmm-help td { padding: 1px 12px 1px 0; vertical-align: top; }
#dmm-help .dmm-tables { columns: 290px 2; column-gap: 24px; }
#dmm-help section { break-inside: avoid; }
#dmm-help kbd { border: 1px solid #adb5bd; border-radius: 3px; padding: 0 5px;
  background: #f1f3f5; font: 12px monospace; white-space: nowrap; }
.dmm-close { float: right; border: 0; background: none; font-size: 20px;
  cursor: pointer; }
.dmm-notice { background: #fff3bf; color: #212529; border-radius: 4px;
  padding: 2px 6px; display: flex; justify-content: space-between; gap: 8px; }
.dmm-dismiss { border: 0; background: none; cursor: pointer; padding: 0 4px;
  font-size: 15px; line-height: 1.2; align-self: start; }
#dmm-mirror { display: none; }
@media (max-width: 799px) {
  #dmm-legend { display: none; }
  #dmm-mirror { display: block; position: fixed; left: 8px;
    right: 60px; bottom: 12px; max-width: 430px; padding: 6px 10px;
    z-index: 4; } }
@media (max-height: 520px) { #dmm-legend { display: none; } }
@media (max-width: 575px) {
  #dmm-mirror { right: 8px; bottom: 3.9em; max-width: none; } }
"""


class Mark(NamedTuple):
  """A thing in the scene.

  Attributes:
    style: CSS of its sample.
    meaning: in words.
  """

  style: str
  meaning: str


def _rgba(colour: Sequence[float]) -> str:
  *rgb, opacity = colour
  red, green, blue = (round(255 * value) for value in rgb)
  return f'rgba({red},{green},{blue},{opacity:g})'


def legend(
  ghost: Sequence[float], edge: Sequence[float], path: Sequence[int]
) -> list[Mark]:
  """Returns the legend of the scene.

  Args:
    ghost: of the reference, RGBA within 0 and 1.
    edge: of boxes, likewise.
    path: of a plan, RGB within 0 and 255.
  """
  return [
    Mark(
      f'background:{_rgba((*ghost[:3], 0.5))};border:1px solid #1971c2',
      'box: the reference, where the mode wants the trunk',
    ),
    Mark(
      'background:rgba(30,40,50,0.35);border-radius:50%',
      "disc: the robot's place on the ground below it",
    ),
    Mark(
      f'border-top:3px solid {_rgba(edge)};height:0',
      'orange edge: end of a box of the track',
    ),
    Mark(
      f'border-top:2px solid rgb{tuple(path)};height:0',
      'line: way of the trunk in the plan',
    ),
  ]


class Pad(NamedTuple):
  """Control of a gamepad of the standard mapping, and its meaning.

  Attributes:
    control: its name on most pads.
    meaning: for people.
    buttons: index of a button: the key that it presses.
    axes: index of an axis, its sign, and the key.
  """

  control: str
  meaning: str
  buttons: Mapping[int, str] = {}
  axes: Sequence[tuple[int, int, str]] = ()


PAD = (
  Pad('A B X Y', 'modes 1 to 4', {0: '1', 1: '2', 2: '3', 3: '4'}),
  Pad('LB, RB', 'previous, next mode', {4: 'b', 5: 'n'}),
  Pad('LT, RT', 'slower, faster clock', {6: 'z', 7: 'c'}),
  Pad(
    'cross, left stick',
    'pushes',
    {12: 'i', 13: 'k', 14: 'j', 15: 'l'},
    [(1, -1, 'i'), (1, 1, 'k'), (0, -1, 'j'), (0, 1, 'l')],
  ),
  Pad('Back', 'autopilot', {8: 't'}),
  Pad('Start', 'reset', {9: 'r'}),
)


def _rows(rows: Sequence[tuple[str, str]]) -> str:
  cells = (
    f'<tr><td><kbd>{html.escape(key)}</kbd></td>'
    f'<td>{html.escape(meaning)}</td></tr>'
    for key, meaning in rows
  )
  return f'<table>{"".join(cells)}</table>'


def _help(keys: Sequence[tuple[str, str]], marks: Sequence[Mark]) -> str:
  """Returns the content of the help."""
  pad = [(pad.control, pad.meaning) for pad in PAD]
  shown = ''.join(
    f'<div class="dmm-mark">{_sample(mark)}</div>' for mark in marks
  )
  mouse = [
    ('drag', 'turn the view'),
    ('right drag', 'move the view'),
    ('wheel', 'nearer, farther'),
  ]
  return (
    '<div><button class="dmm-close" aria-label="close">&times;</button>'
    '<h2>Driving the robot</h2><div class="dmm-tables">'
    f'<section><h3>Keys</h3>{_rows([*keys, ("? H", "this help")])}</section>'
    f'<section><h3>Gamepad</h3>{_rows(pad)}</section>'
    f'<section><h3>Mouse</h3>{_rows(mouse)}</section>'
    f'<section><h3>In the scene</h3>{shown}</section>'
    '<section><h3>Fields</h3>A field has the keys while you type. Enter, '
    'Escape, a click elsewhere, or two seconds without typing give them back '
    'to the robot.</section></div></div>'
  )


def _sample(mark: Mark) -> str:
  return (
    f'<span class="dmm-swatch" style="{mark.style}"></span>'
    f'{html.escape(mark.meaning)}'
  )


def source(
  title: str, keys: Sequence[tuple[str, str]], marks: Sequence[Mark]
) -> str:
  """Returns the script.

  Args:
    title: of the page.
    keys: and what they do, in words.
    marks: legend of the scene.
  """
  config = {
    'title': title,
    'icon': _ICON,
    'label': LABEL,
    'style': _STYLE,
    'legend': ''.join(f'<div>{_sample(mark)}</div>' for mark in marks),
    'help': _help(keys, marks),
    'pad': {
      'buttons': [item for pad in PAD for item in pad.buttons.items()],
      'axes': [axis for pad in PAD for axis in pad.axes],
    },
  }
  function = _SCRIPT.read_text('utf-8').strip().removesuffix(';')
  return f'({function})({json.dumps(config)});'


def install(server: viser.ViserServer, script: str) -> None:
  """Runs a script in every browser, now or when it connects."""
  server.gui._websock_interface.queue_message(
    messages.RunJavascriptMessage(source=script)
  )
