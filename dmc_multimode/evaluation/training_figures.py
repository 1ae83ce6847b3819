"""Figures of trainings, from the metrics of runs."""

import csv
import math
import os
import pathlib
from typing import Any, Mapping, Sequence

import matplotlib.figure
import numpy as np

from dmc_multimode.evaluation import figures
from dmc_multimode.utils import files

METRICS_FILE = 'metrics.csv'
_POINTS = 400  # Of a line.
_COLUMNS = 5  # Panels in a row.
_MILLION = 1e6

Curves = Mapping[str, np.ndarray]


def read(path: str | os.PathLike[str]) -> Curves:
  """Returns the columns of a run's metrics by name, [N] each.

  Args:
    path: the file, or the run's folder.

  Raises:
    FileNotFoundError: there is no such file.
    ValueError: the file is not a table of numbers by step.
  """
  path = pathlib.Path(files.expand(path))
  path = path / METRICS_FILE if path.is_dir() else path
  if not path.is_file():
    raise FileNotFoundError(f'{path} does not exist.')
  try:
    with open(path, newline='', encoding='utf-8') as file:
      rows = list(csv.DictReader(file))
  except (csv.Error, UnicodeDecodeError) as error:
    raise ValueError(f'{path} is damaged: {error}.') from error
  if not rows and path.stat().st_size == 0:
    raise ValueError(
      f'{path} has no row yet: the first comes after a few iterations.'
    )
  if not rows or not {'steps', 'mra_modes', 'mra_transitions'} <= set(rows[0]):
    raise ValueError(f'{path} does not hold the metrics of a run.')
  try:
    return {
      name: np.array([float(row[name]) for row in rows]) for name in rows[0]
    }
  except (TypeError, ValueError) as error:
    raise ValueError(f'{path} is damaged: {error}.') from error


def draw_returns(
  groups: Mapping[str, Sequence[Curves]],
) -> matplotlib.figure.Figure:
  """Draws MRA over modes and over transitions along training, by label.

  Adds the lengths of episodes, seconds, if every run has recorded them.
  """
  columns = {'mra_modes': 'modes', 'mra_transitions': 'transitions'}
  if all('seconds' in run for runs in groups.values() for run in runs):
    columns['seconds'] = 'seconds of an episode'
  drawn, (axes,) = figures.empty(1, len(columns), 5.0, 3.2)
  for axis, (column, title) in zip(axes, columns.items(), strict=True):
    for label, runs in groups.items():
      steps, values = _aligned(runs, column)
      (line,) = axis.plot(steps / _MILLION, values.mean(axis=0), label=label)
      axis.fill_between(
        steps / _MILLION,
        values.min(axis=0),
        values.max(axis=0),
        color=line.get_color(),
        alpha=0.2,
        linewidth=0,
      )
    top = None if column == 'seconds' else 1.0
    axis.set(title=title, xlabel='million environment steps', ylim=(0.0, top))
    _explain_blank(axis)
  axes[0].set_ylabel('normalised return, exploring')
  axes[0].legend()
  return drawn


def _explain_blank(axis: Any) -> None:
  """Says in a panel why it shows no line, if it shows none."""
  if any(map(_is_visible, axis.lines)):
    return
  reason = (
    'too short a run:\na line takes a few rows\nof its metrics'
    if axis.lines
    else 'a single mode:\nnothing is drawn at random'
  )
  axis.text(
    0.5, 0.5, reason, ha='center', va='center', transform=axis.transAxes
  )


def _is_visible(line: Any) -> bool:
  """Returns whether a line is longer than a point."""
  x, y = np.asarray(line.get_data(), dtype=float)
  shown = x[np.isfinite(y)]
  return len(shown) > 1 and bool(shown[0] < shown[-1])


def _aligned(
  runs: Sequence[Curves], column: str
) -> tuple[np.ndarray, np.ndarray]:
  """Returns common steps [N] and the runs' values there, [R, N]."""
  first = max(run['steps'][0] for run in runs)
  last = min(run['steps'][-1] for run in runs)
  steps = np.linspace(first, last, _POINTS)
  values = [np.interp(steps, run['steps'], run[column]) for run in runs]
  return steps, np.stack(values)


def draw_sampling(run: Curves) -> matplotlib.figure.Figure:
  """Draws the probabilities of initial modes, and of final modes by these."""
  names = [name.removeprefix('p/') for name in run if name.startswith('p/')]
  panels = {'initial mode': [name for name in names if '->' not in name]}
  for name in names:
    initial, arrow, _ = name.partition('->')
    if arrow:
      panels.setdefault(f'final mode after {initial}', []).append(name)
  columns = min(len(panels), _COLUMNS)
  drawn, axes = figures.empty(
    math.ceil(len(panels) / columns), columns, 3.2, 2.6
  )
  for axis, (title, members) in zip(axes.flat, panels.items(), strict=False):
    for name in members:
      steps, values = _smoothed(run['steps'], run[f'p/{name}'])
      axis.plot(
        steps / _MILLION, values, label=name.partition('->')[-1] or name
      )
    axis.set(title=title, xlabel='million environment steps', ylim=(0.0, 1.0))
    _explain_blank(axis)
  for axis in axes.flat[len(panels) :]:
    axis.remove()
  axes[0, 0].set_ylabel('probability, running mean')
  if names:
    axes[0, 0].legend(fontsize='x-small')
  return drawn


def _smoothed(
  steps: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Returns running means over a twentieth of the rows, two at least."""
  width = min(max(len(steps) // 20, 2), len(steps))
  mean = lambda x: np.convolve(x, np.full(width, 1 / width), 'valid')
  return mean(steps), mean(values)
