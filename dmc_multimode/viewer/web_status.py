"""Texts and the timeline of modes on the page, as HTML."""

import html
import itertools
from typing import Sequence

from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.viewer import captions
from dmc_multimode.viewer import session as session_lib

_ROW, _NAME, _WIDTH = 18, 104, 330  # Pixels of the timeline.
_PER_CHARACTER = 7.0  # Pixels of a name, at most.


def status(
  state: session_lib.LiveState, session: session_lib.LiveSession, take: str = ''
) -> str:
  """Returns the status.

  Args:
    state: after the last step.
    session: whose state it is.
    take: progress of a recording; empty for none.
  """
  step, survival = state.step, state.survival
  lines = [
    f'<b style="color:{mode_colour(session, step.mode)}">'
    f'{_running(state.running)}</b>{_source(state, session)}',
    f'trunk z {step.position[2]:.2f} m, {step.height:.2f} m over the ground; '
    f'{step.speed:.2f} m/s; reward {step.reward:.2f}',
    f'up for {survival.up:.0f} s, falls: {survival.falls}, '
    f'{survival.falls_per_minute:.1f} a minute',
  ]
  if state.searching:
    done = state.searching
    lines.append(f'planning: {done.search}, knot {done.done} of {done.total}')
  elif state.plan:
    lines.append(f'plan: {describe(state.plan.plan)}')
  if take:
    lines.append(f'<span style="color:#c92a2a">&#9679;</span> {take}')
  return (
    '<div id="dmm-status" style="padding: 0 1em; font-size: 0.9em; '
    f'min-height: 6em">{"<br>".join(lines)}</div>'
  )


def notice(text: str) -> str:
  """Returns a notice that can be dismissed; an empty place for none."""
  if text:
    text = (
      f'<div class="dmm-notice" role="status"><span>{html.escape(text)}</span>'
      '<button class="dmm-dismiss" title="Dismiss (Escape)" '
      'aria-label="dismiss">&times;</button></div>'
    )
  return (
    '<div id="dmm-notice" style="padding: 0 1em 0.5em; font-size: 0.9em; '
    f'min-height: 2.2em">{text}</div>'
  )


def mode_colour(session: session_lib.LiveSession, mode: str) -> str:
  """Returns the CSS colour of a mode, that of captions."""
  return f'rgb{captions.colour(session.modes.index(mode))}'


def _running(name: str) -> str:
  """Returns a mode or blend for people."""
  parts = [part.partition('*') for part in name.split('+')]
  if len(parts) == 1:
    return html.escape(name)
  return ' + '.join(
    f'{html.escape(mode)} {float(share):.0%}' for mode, _, share in parts
  )


def _source(
  state: session_lib.LiveState, session: session_lib.LiveSession
) -> str:
  """Returns who commands, unless it is a person."""
  if session.autopilot:
    return ' (autopilot)'
  return ' (plan)' if state.replaying else ''


def describe(plan: plan_lib.ModePlan) -> str:
  """Returns a plan in one line."""
  parts = zip(*plan.segments(), strict=True)
  return ', '.join(f'{name} {seconds:g} s' for name, seconds in parts)


def timeline(modes: Sequence[int], names: Sequence[str], length: int) -> str:
  """Returns a picture of which mode ran when: a row a mode, with its name.

  Args:
    modes: index of the mode of each of the last control steps.
    names: of all modes.
    length: number of control steps that have place.
  """
  height = _ROW * len(names)
  parts = []
  for i, name in enumerate(names):
    fits = min(_NAME - 6, _PER_CHARACTER * len(name))
    parts.append(
      f'<rect x="{_NAME}" y="{_ROW * i + 2}" width="{_WIDTH - _NAME}" '
      f'height="{_ROW - 4}" fill="#f1f3f5"/>'
      f'<text x="{_NAME - 6}" y="{_ROW * i + 13}" text-anchor="end" '
      f'textLength="{fits:.0f}" lengthAdjust="spacingAndGlyphs">'
      f'{html.escape(name)}</text>'
    )
  scale = (_WIDTH - _NAME) / length
  x = _WIDTH - scale * len(modes)
  for mode, run in itertools.groupby(modes):
    wide = scale * sum(1 for _ in run)
    parts.append(
      f'<rect x="{x:.1f}" y="{_ROW * mode + 2}" width="{wide:.1f}" '
      f'height="{_ROW - 4}" fill="rgb{captions.colour(mode)}"/>'
    )
    x += wide
  return (
    f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" '
    'aria-label="modes that ran" style="width:100%;padding:0 0.6em 0.5em;'
    f'box-sizing:border-box;font:12px sans-serif">{"".join(parts)}</svg>'
  )
