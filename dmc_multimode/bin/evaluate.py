"""Evaluates a policy: every mode, every transition, no exploration.

python -m dmc_multimode.bin.evaluate --policy=quickstart --out=report.json

--html=report.html writes a page with tables, a heat map of the transitions,
figures, a short video of every mode, which nothing disturbs, and the task in
words; with --compare=POLICY it shows that policy beside. --payload=2,
--action_delay=0.03 and their like fix the disturbances of all robots, one by
one. Under `torchrun` in place of `python`, several processes share the
episodes.
"""

import functools
import json
import pathlib
from typing import Any, Mapping, NamedTuple, Sequence, TYPE_CHECKING

from absl import flags

from dmc_multimode.agents import distributed
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import launch
from dmc_multimode.utils import files
from dmc_multimode.viewer import gl

if TYPE_CHECKING:
  from dmc_multimode import pretrained
  from dmc_multimode.evaluation import report as report_lib
  from dmc_multimode.suite.imitation import config as task_config
  from dmc_multimode.suite.imitation import events

_POLICY = config_flags.define_path(
  'policy', None, 'Name of a shipped policy, or a folder.', required=True
)
_OUT = config_flags.define_path(
  'out', None, 'JSON file to write the report to.'
)
_HTML = config_flags.define_path(
  'html', None, 'Page to write the report to, with figures and videos in it.'
)
_COMPARE = config_flags.define_path(
  'compare',
  None,
  'Another policy, likewise, that the page of --html shows beside: both values '
  'of every table, and the difference.',
)
_FIGURES = config_flags.define_path(
  'figures',
  None,
  'Folder to draw into: heights, contacts, a sequence of modes.',
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the initial states.')
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Of each transition at each phase and clip; modes get 4 times.'
)
_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, 'Seconds; 0.005 by default.'
)
_CLOCK_RATES = flags.DEFINE_list(
  'clock_rates', None, 'Also measure how fast the modes go at these.'
)
_CLOCK_RATE = flags.DEFINE_float('clock_rate', 1.0, 'Of the modes.')
_MOTION = flags.DEFINE_bool(
  'motion', True, 'Measure how modes move; half of the time for a small set.'
)
_SWITCHING = flags.DEFINE_bool(
  'switching', False, 'Also command modes at random for 20 s.'
)
_SWITCHING_EPISODES = flags.DEFINE_integer(
  'switching_episodes', 256, 'Robots of each kind of --switching.', 1
)
_ROBOT = config_flags.define_robot()
config_flags.define_disturbances()


def _rates() -> list[float]:
  """Returns the values of --clock_rates."""
  try:
    return [float(rate) for rate in _CLOCK_RATES.value or ()]
  except ValueError as error:
    raise ValueError(f'--clock_rates: {error}.') from error


def _why_no_videos() -> str:
  """Chooses an OpenGL backend; returns the reason for none, or ''.

  Must be called before dm_control is imported.
  """
  try:
    gl.choose_backend()
  except OSError as error:
    return str(error)
  return ''


class _Found(NamedTuple):
  """A policy, and the scores of its evaluation."""

  name: str
  policy: 'pretrained.Policy'
  values: dict[str, Any]


def _evaluate(no_videos: str, communicator: distributed.Communicator) -> None:
  """Evaluates the policies; rank 0 reports."""
  # This imports dm_control, which reads MUJOCO_GL.
  from dmc_multimode import pretrained

  out = files.output_file('out', _OUT.value)
  page = files.output_file('html', _HTML.value)
  folder = files.output_folder('figures', _FIGURES.value)
  names = [_POLICY.value]
  if _COMPARE.value:
    names.append(_COMPARE.value)
    if not page:
      raise ValueError(
        '--compare shows two policies on a page: add --html=FILE'
      )
  # All are loaded before one takes its time.
  policies = [
    pretrained.load(name, robot=_ROBOT.value or None) for name in names
  ]
  found = [
    _Found(name, policy, _scores(name, policy, communicator))
    for name, policy in zip(names, policies, strict=True)
  ]
  if communicator.rank == 0:
    _report(found, out, page, folder, no_videos)


def _scores(
  name: str,
  policy: 'pretrained.Policy',
  communicator: distributed.Communicator,
) -> dict[str, Any]:
  """Returns the scores of a policy."""
  from dmc_multimode.evaluation import scores

  rates, disturbed = _rates(), _disturbed()
  encoder_seed = _encoder_seed(name)
  values = scores.evaluate(
    policy,
    _SEED.value,
    _EPISODES.value,
    _CLOCK_RATE.value,
    rates,
    _TIMESTEP.value,
    communicator=communicator,
    switching_episodes=_SWITCHING.value * _SWITCHING_EPISODES.value,
    with_motion=_MOTION.value,
    disturbed=disturbed,
  )
  values['provenance']['encoder_seed'] = encoder_seed
  return values


def _disturbed() -> 'events.TrainingEvents':
  """Returns the events by the flags of disturbances."""
  from dmc_multimode.suite.imitation import events

  return events.fixed(**config_flags.given_disturbances())


def _encoder_seed(name: str) -> int | None:
  """Returns the seed of the encoder beside a policy, None if there is none."""
  from dmc_multimode.experiments import fine_tuning
  from dmc_multimode.modes.encoder import mode_encoder

  try:
    folder = fine_tuning.find_encoder(name)
  except ValueError:
    return None
  return mode_encoder.load(folder).config.seed


def _report(
  found: Sequence[_Found],
  out: pathlib.Path | None,
  page: pathlib.Path | None,
  folder: pathlib.Path | None,
  no_videos: str,
) -> None:
  """Prints and writes the report, figures and page."""
  from dmc_multimode.evaluation import figures
  from dmc_multimode.evaluation import report
  from dmc_multimode.evaluation import scores

  first = found[0]
  report.show(first.values)
  if out:
    out.parent.mkdir(parents=True, exist_ok=True)
    files.write(out, json.dumps(first.values, indent=1).encode())
    print(f'The report is in {out}')
  if not (folder or page):
    return
  shown = []
  for each in found:
    evaluator = scores.make_evaluator(
      each.policy, _SEED.value, _TIMESTEP.value, disturbed=_disturbed()
    )
    drawn = report.draw(evaluator, each.values)
    if folder and each is first:
      for name, figure in drawn.items():
        figures.save(folder / name, figure)
      print(f'The figures are in {folder}')
    if page:
      images = report.pictures(drawn)
      shown.append(_shown(each, evaluator.config, images, not no_videos))
  if page:
    if no_videos:
      print(f'No videos: {no_videos}')
    _write_page(page, shown, no_videos)


def _shown(
  found: _Found,
  config: 'task_config.ImitationConfig',
  images: Mapping[str, bytes],
  with_videos: bool,
) -> 'report_lib.Evaluated':
  """Returns all that the page shows of a policy."""
  from dmc_multimode.evaluation import report
  from dmc_multimode.evaluation import task_summary

  videos = {}
  if with_videos:
    videos = report.film(found.policy, config, _SEED.value, _CLOCK_RATE.value)
  summary = task_summary.describe(
    found.policy.mode_set, found.policy.config, config
  )
  return report.Evaluated(found.name, found.values, images, videos, summary)


def _write_page(
  page: pathlib.Path, shown: 'Sequence[report_lib.Evaluated]', note: str
) -> None:
  """Writes the page of one policy, or of two side by side."""
  from dmc_multimode.evaluation import comparison
  from dmc_multimode.evaluation import comparison_page
  from dmc_multimode.evaluation import report

  one, *others = shown
  if others:
    comparison.show(one, others[0])
    comparison_page.write_page(page, one, others[0], note)
  else:
    report.write_page(page, one, note)
  print(f'The page is {page}')


def main(argv: Sequence[str]) -> int:
  """Evaluates and reports, with the other ranks if there are any."""
  del argv
  no_videos = _why_no_videos() if _HTML.value else ''
  return launch.run(functools.partial(_evaluate, no_videos))


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
