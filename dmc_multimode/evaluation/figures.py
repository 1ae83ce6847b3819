"""The paper's figures of a policy: heights, contacts, speeds."""

import io
import pathlib
from typing import Any, Mapping, Sequence

from matplotlib.backends import backend_agg
import matplotlib.figure
import numpy as np

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.utils import files

HEIGHTS_FILE, SEQUENCE_FILE = 'heights.png', 'sequence.png'
CONTACTS_FILE, CLOCK_RATES_FILE = 'contacts.png', 'clock_rates.png'

# The paper's sequence of transitions.
_ORDER = ('walk_forward', 'launch', 'leap_forward', 'idle')
_SECONDS = 2.4  # Seconds of each mode; two cycles of a leap.
_FEET = {
  2: ('left', 'right'),
  4: ('front left', 'front right', 'hind left', 'hind right'),
}
_COLUMNS = 4  # Panels in a row.
_LABELS = {'reference': 'reference', 'position': 'robot'}


def empty(
  rows: int, columns: int, width: float, height: float
) -> tuple[matplotlib.figure.Figure, Any]:
  """Returns a figure without display, and its axes, [rows, columns].

  Args:
    rows, columns: of axes.
    width, height: of each, inches.
  """
  result = matplotlib.figure.Figure(
    figsize=(width * columns, height * rows), layout='constrained'
  )
  backend_agg.FigureCanvasAgg(result)
  return result, result.subplots(rows, columns, squeeze=False)


def save(path: pathlib.Path, drawn: matplotlib.figure.Figure) -> None:
  """Writes a figure as PNG."""
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write(path, png(drawn))


def png(drawn: matplotlib.figure.Figure) -> bytes:
  """Returns a figure as PNG, bytes."""
  content = io.BytesIO()
  drawn.savefig(content, format='png', dpi=120)
  return content.getvalue()


def heights(
  names: Sequence[str],
  measured: Mapping[str, np.ndarray],
  lengths: np.ndarray,
  timestep: float,
) -> matplotlib.figure.Figure:
  """Draws the heights of trunk and reference, one axis a mode.

  Args:
    names: of the modes, one an episode, B.
    measured: result of `BatchedImitation.measure` by step, [T, B, ...].
    lengths: control steps of the episodes, [B].
    timestep: seconds of a control step.
  """
  drawn, panels = _panels(names, 2.6)
  for i, (axis, length) in enumerate(zip(panels, lengths, strict=True)):
    times = timestep * np.arange(1, length + 1)
    for key, style in (('reference', 'C3--'), ('position', 'C0')):
      height = measured[key][:length, i, 2]
      axis.plot(times, height, style, label=_LABELS[key])
    axis.sharey(panels[0])
  panels[0].set_ylabel('height of the trunk (m)')
  panels[0].legend(fontsize='small')
  return drawn


def contacts(
  names: Sequence[str],
  measured: Mapping[str, np.ndarray],
  lengths: np.ndarray,
  timestep: float,
) -> matplotlib.figure.Figure:
  """Draws when each foot is on the ground, and when it should be.

  Args:
    names: of the modes, one an episode, B.
    measured: result of `BatchedImitation.measure` by step, [T, B, ...].
    lengths: control steps of the episodes, [B].
    timestep: seconds of a control step.
  """
  feet = _FEET[measured['contact'].shape[-1]]
  drawn, panels = _panels(names, 0.9 * len(feet))
  rows = [
    (foot, key)
    for foot in range(len(feet))
    for key in ('position', 'reference')
  ]
  keys = {'position': 'contact', 'reference': 'reference_contact'}
  for i, (axis, length) in enumerate(zip(panels, lengths, strict=True)):
    for y, (foot, key) in enumerate(rows):
      on = measured[keys[key]][:length, i, foot].astype(int)
      edges = np.flatnonzero(np.diff(on, prepend=0, append=0)) * timestep
      spans = np.stack([edges[::2], edges[1::2] - edges[::2]], axis=1)
      colour = 'C0' if key == 'position' else 'C3'
      axis.broken_barh(spans.tolist(), (-y - 0.4, 0.8), color=colour)
    labels = [f'{feet[foot]}, {_LABELS[key]}' for foot, key in rows]
    axis.set_yticks(-np.arange(len(rows)), labels, fontsize='small')
  return drawn


def clock_rates(
  values: Mapping[str, Mapping[str, Mapping[str, float]]],
) -> matplotlib.figure.Figure:
  """Draws the speed of every mode over the rate of its clock.

  Args:
    values: result of `scores.evaluate_clock_rates`.
  """
  rates = [float(rate) for rate in values]
  names = list(next(iter(values.values())))
  drawn, panels = _panels(names, 2.6)
  for axis, name in zip(panels, names, strict=True):
    for key, style, label in (
      ('reference', 'C3--', 'reference'),
      ('velocity', 'C0o-', 'robot'),
    ):
      speeds = [row[name][key] for row in values.values()]
      axis.plot(rates, speeds, style, label=label)
    axis.set_xlabel('clock rate')
    axis.sharey(panels[0])
  panels[0].set_ylabel('speed (m/s)')
  panels[0].legend(fontsize='small')
  return drawn


def _panels(
  names: Sequence[str], height: float
) -> tuple[matplotlib.figure.Figure, list[Any]]:
  """Returns a figure and its axes over time, one a mode, in rows.

  Args:
    names: of the modes.
    height: of each, inches.
  """
  columns = min(len(names), _COLUMNS)
  drawn, axes = empty(-(-len(names) // columns), columns, 2.6, height)
  for axis in axes.flat[len(names) :]:
    axis.remove()
  for axis, name in zip(axes.flat, names, strict=False):
    axis.set(title=name, xlabel='time (s)')
  return drawn, list(axes.flat[: len(names)])


def sequence(
  mode_set: mode_set_lib.ModeSet,
) -> tuple[schedule_lib.ModeSchedule, float]:
  """Returns a schedule through the paper's transitions, and its seconds.

  Of a policy without at least two of their modes, through all that it has.
  """
  names = [name for name in _ORDER if name in mode_set.names]
  if len(names) < 2:
    names = list(mode_set.names)
  motions = mode_set.subset(names).motions
  durations = [
    motion.duration if motion.kind == motion_lib.TRANSIENT else _SECONDS
    for motion in motions
  ]
  schedule = schedule_lib.from_names(mode_set, names, durations)
  return schedule, sum(durations)


def transitions(
  mode_set: mode_set_lib.ModeSet,
  schedule: schedule_lib.ModeSchedule,
  measured: Mapping[str, np.ndarray],
  length: int,
  timestep: float,
) -> matplotlib.figure.Figure:
  """Draws one world's height through a schedule, with the ground and commands.

  Args:
    mode_set: the modes.
    schedule: of one world.
    measured: result of `BatchedImitation.measure` by step, [T, 1, ...].
    length: control steps of the episode.
    timestep: seconds of a control step.
  """
  drawn, ((axis,),) = empty(1, 1, 8.0, 3.0)
  times = timestep * np.arange(1, length + 1)
  ground = measured['support'][:length, 0]
  axis.fill_between(times, ground, step='mid', color='0.85', label='ground')
  for key, style in (('reference', 'C3--'), ('position', 'C0')):
    axis.plot(times, measured[key][:length, 0, 2], style, label=_LABELS[key])
  for mode, start in zip(schedule.modes[0], schedule.starts[0], strict=True):
    axis.axvline(start, color='0.5', linewidth=0.8)
    axis.annotate(
      mode_set.names[mode],
      (start, 1.0),
      (2, 4),
      xycoords=('data', 'axes fraction'),
      textcoords='offset points',
      fontsize='small',
    )
  axis.set(xlabel='time (s)', ylabel='height (m)', ylim=(0.0, None))
  axis.legend(fontsize='small', loc='lower left')
  return drawn
