"""Reports of an evaluation: tables, figures and an HTML page.

The page is self-contained: figures and videos are embedded. One of two policies
is of `comparison`.
"""

import base64
import json
import pathlib
import tempfile
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

import jinja2
import matplotlib
import matplotlib.figure
import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import motion_metrics
from dmc_multimode.evaluation import task_summary
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar
from dmc_multimode.viewer import recording
from dmc_multimode.viewer import rollout
from dmc_multimode.viewer import video

MODE_COLUMNS = (
  'mra',
  'survival',
  'velocity',
  'lateral_velocity',
  'height',
  'apex',
  'rise',
  'flight',
  'alternation',
  'single_support',
  'agreement',
  'drift',
  'position_error',
)
_UNITS = {
  'velocity': 'm/s',
  'lateral_velocity': 'm/s',
  'height': 'm',
  'apex': 'm',
  'rise': 'm',
  'flight': 's',
  'drift': 'm',
  'position_error': 'm',
}
_TEMPLATE = 'report.html.j2'
_COLOURS = 'viridis'  # Distinct in grey as well.
_DARK = 0.5  # Luminance below which text is white.
_TITLES = {
  figures.HEIGHTS_FILE: 'Height of the trunk in each mode',
  figures.SEQUENCE_FILE: 'Height through a sequence of modes',
  figures.CONTACTS_FILE: 'Contacts of the feet in each mode',
  figures.CLOCK_RATES_FILE: 'Speed at other rates of the clock',
}
_VIDEO = recording.RecordingConfig(width=320, height=240)
_SECONDS = 3.0  # Seconds of a video, at least.
_AFTER = 1.0  # Seconds of a video after a mode's first cycle.


class Evaluated(NamedTuple):
  """A policy, and what a page shows of it.

  Attributes:
    name: of the policy.
    values: result of `scores.evaluate`.
    images: result of `pictures`.
    videos: result of `film`; may be empty.
    summary: result of `task_summary.describe`.
  """

  name: str
  values: Mapping[str, Any]
  images: Mapping[str, bytes] = {}
  videos: Mapping[str, bytes] = {}
  summary: Sequence[task_summary.Section] = ()


def draw(
  evaluator: evaluator_lib.Evaluator, values: Mapping[str, Any]
) -> dict[str, matplotlib.figure.Figure]:
  """Draws every mode, a sequence of transitions and, if any, clock rates.

  Returns:
    Figures by file name.
  """
  mode_set, timestep = evaluator.mode_set, evaluator.config.control_timestep
  alone = evaluator.run(
    schedule_lib.single(np.arange(len(mode_set))), 'heights'
  )
  schedule, seconds = figures.sequence(mode_set)
  found = evaluator.changed(time_limit=seconds).run(schedule, 'sequence')
  drawn = {
    figures.HEIGHTS_FILE: figures.heights(
      mode_set.names, alone.traces, alone.lengths, timestep
    ),
    figures.SEQUENCE_FILE: figures.transitions(
      mode_set, schedule, found.traces, found.lengths[0], timestep
    ),
    figures.CONTACTS_FILE: figures.contacts(
      mode_set.names, alone.traces, alone.lengths, timestep
    ),
  }
  if values.get('clock_rates'):
    drawn[figures.CLOCK_RATES_FILE] = figures.clock_rates(values['clock_rates'])
  return drawn


def film(
  policy: pretrained.Policy,
  config: task_config.ImitationConfig,
  seed: int,
  clock_rate: float,
) -> dict[str, bytes]:
  """Records every mode of a policy on flat ground; needs OpenGL.

  Args:
    policy: to record.
    config: of the task, for its physics time step.
    seed: of the initial states.
    clock_rate: of the modes.

  Returns:
    MP4 files, bytes, by mode.
  """
  videos = {}
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / f'mode{video.SUFFIX}'
    motions = policy.mode_set.motions
    for motion in progress_bar.Bar(motions, 'videos', unit='video'):
      seconds = max(_SECONDS, motion.duration / clock_rate + _AFTER)
      what = rollout.RolloutConfig(
        (motion.name,),
        (seconds,),
        clock_rate=clock_rate,
        seed=seed,
        physics_timestep=config.physics_timestep,
      )
      recording.film(policy, what, _VIDEO, path, quiet=True)
      videos[motion.name] = path.read_bytes()
  return videos


def write_page(path: pathlib.Path, found: Evaluated, note: str = '') -> None:
  """Writes the page of an evaluation; see `page` and `write`."""
  write(path, page(found, note))


def write(path: pathlib.Path, text: str) -> None:
  """Writes a page, atomically; missing folders are made."""
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write(path, text.encode())


def pictures(
  drawn: Mapping[str, matplotlib.figure.Figure],
) -> dict[str, bytes]:
  """Returns the figures of `draw` as PNG files by their titles."""
  return {_TITLES[name]: figures.png(figure) for name, figure in drawn.items()}


def page(found: Evaluated, note: str = '') -> str:
  """Returns the page as HTML, in which names and values are escaped.

  Args:
    found: of the evaluation.
    note: reason for no videos; empty if there are some.
  """
  values = found.values
  return render(
    _TEMPLATE,
    title=f'Evaluation of {found.name}',
    values={'motion': {}, 'switching': {}, 'clock_rates': {}, **values},
    figures=found.images,
    videos=found.videos,
    note=note,
    summary=found.summary,
    columns=[column_title(name) for name in MODE_COLUMNS],
    mode_rows=[
      (name, *(f'{row[key]:.3f}' for key in MODE_COLUMNS))
      for name, row in values['modes'].items()
    ],
    transition_rows=[
      (name, f'{row["mra"]:.3f}', f'{row["survival"]:.3f}')
      for name, row in values['transitions'].items()
    ],
    criteria=list(_criteria(values)),
    motion_metrics=motion_metrics.TABLE,
    provenance=provenance(values),
  )


def render(template: str, **values: Any) -> str:
  """Returns a template of this folder with values, which are escaped."""
  environment = jinja2.Environment(
    loader=jinja2.PackageLoader(__package__, '.'),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
  )
  environment.filters.update(data=_data, heat=colour, number=number)
  return environment.get_template(template).render(**values)


def column_title(metric: str) -> str:
  """Returns a metric of `MODE_COLUMNS` in words, with its unit."""
  unit = _UNITS.get(metric)
  return metric.replace('_', ' ') + (f' ({unit})' if unit else '')


def provenance(
  values: Mapping[str, Any],
) -> dict[str, list[tuple[str, str]]]:
  """Returns all settings of an evaluation as rows of tables, by caption."""
  measured = ('seed', 'episodes_per_case', 'clock_rate')
  return {
    'Evaluation': list(_flat({key: values[key] for key in measured})),
    'Policy': list(_flat(values['provenance'])),
    'Task': list(_flat(values['task'])),
  }


def _criteria(values: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
  """Yields a row for each acceptance criterion of each mode."""
  for mode, rows in values['acceptance'].items():
    for metric, row in rows.items():
      keys = ('value', 'worst', 'least', 'most')
      yield {
        'name': f'{mode}: {metric}',
        'numbers': [number(row[key]) for key in keys],
        'passed': row['passed'],
      }


def number(value: float | None) -> str:
  """Returns three decimals, nothing for None."""
  return '' if value is None else f'{value:.3f}'


def _data(content: bytes, kind: str) -> str:
  """Returns a file's content as a data URI."""
  return f'data:{kind};base64,{base64.b64encode(content).decode()}'


def colour(share: float, colours: str = _COLOURS) -> str:
  """Returns the CSS style of a cell for a value in [0, 1]."""
  red, green, blue, _ = matplotlib.colormaps[colours](share, bytes=True)
  luminance = (0.2126 * red + 0.7152 * green + 0.0722 * blue) / 255
  ink = '#fff' if luminance < _DARK else '#000'
  return f'background:#{red:02x}{green:02x}{blue:02x};color:{ink}'


def _flat(
  values: Mapping[str, Any], prefix: str = ''
) -> Iterator[tuple[str, str]]:
  """Yields nested values as rows of a table."""
  for key, value in values.items():
    if isinstance(value, Mapping):
      yield from _flat(value, f'{prefix}{key}.')
    else:
      text = value if isinstance(value, str) else json.dumps(value)
      yield f'{prefix}{key}', text


def _heads(name: str) -> tuple[str, str]:
  """Returns the name of a column of ten characters, on two lines."""
  first, _, second = name.rpartition('_')
  if not first and len(name) > 9:
    first, second = f'{name[:5]}-', name[5:]
  return first, second


def show(values: Mapping[str, Any]) -> None:
  """Prints the report as tables."""
  for heads in zip(*map(_heads, ('mode', *MODE_COLUMNS)), strict=True):
    print(f'{heads[0]:16}' + ''.join(f'{head:>10}' for head in heads[1:]))
  for name, row in values['modes'].items():
    print(f'{name:16}' + ''.join(f'{row[key]:10.3f}' for key in MODE_COLUMNS))
  print(
    f'\n{"criterion":32}{"value":>10}{"worst":>10}{"least":>10}{"most":>10}'
    f'{"passed":>8}'
  )
  for row in _criteria(values):
    numbers = ''.join(f'{number:>10}' for number in row['numbers'])
    print(f'{row["name"]:32}{numbers}{"yes" if row["passed"] else "NO":>8}')
  print(f'\n{"transition":36}{"mra":>10}{"survival":>10}')
  for name, row in values['transitions'].items():
    print(f'{name:36}{row["mra"]:10.3f}{row["survival"]:10.3f}')
  _show_motion(values)
  for kind in ('any_moment', 'from_ground'):
    if kind in values.get('switching', {}):
      print(f'switches, {kind}: {_switches(values["switching"][kind])}')
  for rate, row in values.get('clock_rates', {}).items():
    speeds = ', '.join(
      f'{name} {found["velocity"]:.2f} m/s ({found["survival"]:.2f})'
      for name, found in row.items()
    )
    print(f'clock rate {rate}: {speeds}')
  for kind in ('modes', 'transitions'):
    mra = values[f'mra_{kind}']
    print(
      f'MRA over {kind}: {mra["mean"]:.3f} +- {mra["std"]:.3f}, survival '
      f'{values[f"survival_{kind}"]:.3f}'
    )


def _show_motion(values: Mapping[str, Any]) -> None:
  """Prints the motion metrics, a line for each and a column for each mode."""
  modes = values.get('motion', {})
  if not modes:
    return
  print(f'\n{"motion":32}' + ''.join(f'{name[-13:]:>14}' for name in modes))
  for metric in motion_metrics.TABLE:
    title = f'{metric.name} {metric.unit}'
    cells = (f'{number(row[metric.name]):>14}' for row in modes.values())
    print(f'{title:32}' + ''.join(cells))


def _switches(found: Mapping[str, Any]) -> str:
  """Returns the survival of random switches and the modes of falls."""
  falls = ', '.join(f'{mode} {count}' for mode, count in found['falls'].items())
  return f'survival {found["survival"]:.3f}' + (falls and f', falls: {falls}')
