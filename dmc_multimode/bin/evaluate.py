"""Evaluates a policy: every mode, every transition, no exploration.

python -m dmc_multimode.bin.evaluate --policy=quickstart --out=report.json

--html=report.html writes a page with tables, a heat map of the transitions,
figures, and a short video of every mode, which nothing disturbs. --payload=2,
--action_delay=0.03 and their like fix the disturbances of all robots, one by
one. Under `torchrun` in place of `python`, several processes share the
episodes.
"""

import functools
import json
import pathlib
from typing import Any, Sequence, TYPE_CHECKING

from absl import flags

from dmc_multimode.agents import distributed
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.experiments import launch
from dmc_multimode.utils import files
from dmc_multimode.viewer import gl

if TYPE_CHECKING:
  from dmc_multimode import pretrained
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


def _evaluate(no_videos: str, communicator: distributed.Communicator) -> None:
  """Evaluates the policy; rank 0 reports."""
  # These import dm_control, which reads MUJOCO_GL.
  from dmc_multimode import pretrained
  from dmc_multimode.evaluation import scores

  out = files.output_file('out', _OUT.value)
  page = files.output_file('html', _HTML.value)
  folder = files.output_folder('figures', _FIGURES.value)
  rates, disturbed = _rates(), _disturbed()
  policy = pretrained.load(_POLICY.value, robot=_ROBOT.value or None)
  encoder_seed = _encoder_seed(_POLICY.value)
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
  if communicator.rank == 0:
    _report(policy, values, out, page, folder, no_videos)


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
  policy: 'pretrained.Policy',
  values: dict[str, Any],
  out: pathlib.Path | None,
  page: pathlib.Path | None,
  folder: pathlib.Path | None,
  no_videos: str,
) -> None:
  """Prints and writes the report, figures and page."""
  from dmc_multimode.evaluation import figures
  from dmc_multimode.evaluation import report
  from dmc_multimode.evaluation import scores

  report.show(values)
  if out:
    out.parent.mkdir(parents=True, exist_ok=True)
    files.write(out, json.dumps(values, indent=1).encode())
    print(f'The report is in {out}')
  if not (folder or page):
    return
  evaluator = scores.make_evaluator(
    policy, _SEED.value, _TIMESTEP.value, disturbed=_disturbed()
  )
  drawn = report.draw(evaluator, values)
  if folder:
    for name, figure in drawn.items():
      figures.save(folder / name, figure)
    print(f'The figures are in {folder}')
  if page:
    videos = {}
    if no_videos:
      print(f'No videos: {no_videos}')
    else:
      videos = report.film(
        policy, evaluator.config, _SEED.value, _CLOCK_RATE.value
      )
    title = f'Evaluation of {_POLICY.value}'
    report.write_page(page, title, values, drawn, videos, no_videos)
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
