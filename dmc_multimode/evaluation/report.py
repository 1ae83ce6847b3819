"""What is told of an evaluation: tables on the screen, figures, a page."""

import pathlib
import tempfile
from typing import Any, Mapping

import matplotlib.figure
import numpy as np
import tqdm

from dmc_multimode import pretrained
from dmc_multimode.evaluation import evaluator as scoring
from dmc_multimode.evaluation import figures
from dmc_multimode.evaluation import html_report
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import files
from dmc_multimode.viewer import recording
from dmc_multimode.viewer import rollout
from dmc_multimode.viewer import video

_TITLES = {
  figures.HEIGHTS_FILE: 'Height of the trunk in each mode',
  figures.SEQUENCE_FILE: 'Height through a sequence of modes',
  figures.CONTACTS_FILE: 'Contacts of the feet in each mode',
  figures.CLOCK_RATES_FILE: 'Speed at other rates of the clock',
}
_VIDEO = recording.RecordingConfig(width=320, height=240)
_SECONDS = 3.0  # Of a video, and more for modes that take longer.
_AFTER = 1.0  # Seconds for which a video goes on after a mode's first cycle.


def draw(
  evaluator: scoring.Evaluator, values: Mapping[str, Any]
) -> dict[str, matplotlib.figure.Figure]:
  """Draws every mode, a sequence of them, and what `values` has of speeds.

  Returns:
    Figures by the names of their files.
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
  """Films every mode of a policy on flat ground; needs an OpenGL.

  Args:
    policy: what acts.
    config: the task, for the step of its physics.
    seed: of the initial states.
    clock_rate: of the modes.

  Returns:
    MP4 files by the names of the modes.
  """
  videos = {}
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / f'mode{video.SUFFIX}'
    for motion in tqdm.tqdm(policy.mode_set.motions, 'videos', unit='video'):
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


def write_page(
  path: pathlib.Path,
  title: str,
  values: Mapping[str, Any],
  drawn: Mapping[str, matplotlib.figure.Figure],
  videos: Mapping[str, bytes],
  note: str,
) -> None:
  """Writes the page of an evaluation, whole or not at all.

  Args:
    path: of the page; missing folders are made.
    title: of the page.
    values: what `scoring.report` returned, and the policy's `provenance`.
    drawn: what `draw` returned.
    videos: what `film` returned, or none.
    note: why there are none.
  """
  pictures = {_TITLES[name]: figures.png(drawn[name]) for name in drawn}
  page = html_report.make(title, values, pictures, videos, note)
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write(path, page.encode())


def show(values: Mapping[str, Any]) -> None:
  """Prints the report as tables."""
  columns = html_report.MODE_COLUMNS
  print(f'{"mode":16}' + ''.join(f'{name[:9]:>10}' for name in columns))
  for name, row in values['modes'].items():
    print(f'{name:16}' + ''.join(f'{row[key]:10.3f}' for key in columns))
  print(
    f'\n{"promise":32}{"value":>10}{"worst":>10}{"least":>10}{"most":>10}'
    f'{"kept":>6}'
  )
  for name, promises in values['behaviour'].items():
    for metric, row in promises.items():
      least, most = (
        '' if row[key] is None else f'{row[key]:.3f}'
        for key in ('least', 'most')
      )
      print(
        f'{f"{name}: {metric}":32}{row["value"]:10.3f}{row["worst"]:10.3f}'
        f'{least:>10}{most:>10}{"yes" if row["kept"] else "NO":>6}'
      )
  print(f'\n{"transition":36}{"mra":>10}{"survival":>10}')
  for name, row in values['transitions'].items():
    print(f'{name:36}{row["mra"]:10.3f}{row["survival"]:10.3f}')
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
