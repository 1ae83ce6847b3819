"""Runs a selector on the endless track, in the page's session without a page.

    python -m benchmarks.reliability.autopilot --selector=DIR --minutes=10

Prints falls and metres a minute of simulated time. After a fall the robot lies
for a moment, and is put on new ground.
"""

import functools
import time
from typing import Sequence

from absl import flags
import torch

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.bin import app
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import events
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar
from dmc_multimode.viewer import session as session_lib

_POLICY = common.define_policy()
_SELECTOR = common.define_selector()
_MINUTES = flags.DEFINE_float('minutes', 10.0, 'Of simulated time.', 0.0)
_DIFFICULTY = flags.DEFINE_float('difficulty', 0.5, 'Of the track.', 0.0, 1.0)
_PUSH_SPEED = flags.DEFINE_float('push_speed', 0.0, 'Of pushes, m/s.', 0.0)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the track.', 0)
_OUT = common.define_out()

_COLUMNS = (
  'name | minutes:.1f | falls:d | a minute=falls_per_minute:.2f | '
  'metres a minute=metres_per_minute:.1f | of real time=real_time_factor:.1f'
)


def run(
  session: session_lib.LiveSession, minutes: float, progress: progress_bar.Bar
) -> common.Row:
  """Returns what happens in so many minutes of simulated time."""
  period = session.robot.task.control_timestep
  steps = max(round(60 * minutes / period), 1)
  falls, way, began = 0, 0.0, time.perf_counter()
  x, was_down = session.robot.position[0], False
  for _ in range(steps):
    state = session.step()
    falls += state.down and not was_down
    if not state.down and not was_down:
      way += max(float(state.step.position[0] - x), 0.0)
    x, was_down = state.step.position[0], state.down
    progress.update()
  seconds = time.perf_counter() - began
  return {
    'minutes': steps * period / 60,
    'falls': falls,
    'falls_per_minute': falls / (steps * period / 60),
    'metres_per_minute': way / (steps * period / 60),
    'real_time_factor': steps * period / seconds,
  }


def main(argv: Sequence[str]) -> None:
  """Runs, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  torch.set_num_threads(1)
  selector = steering.load(
    steering.SteeringConfig(_SELECTOR.value), _POLICY.value
  )
  session = session_lib.LiveSession(
    pretrained.load(_POLICY.value),
    session_lib.ENDLESS,
    _SEED.value,
    disturbed=events.fixed(push_speed=_PUSH_SPEED.value),
    selector=selector,
    difficulty=_DIFFICULTY.value,
  )
  session.set_autopilot(True)
  with progress_bar.Bar(unit='step') as progress:
    row = run(session, _MINUTES.value, progress)
  row['name'] = f'difficulty {_DIFFICULTY.value:g}'
  common.print_table(_COLUMNS, [row])
  common.write_report(
    out,
    {
      'benchmark': 'autopilot',
      'table': [row],
      'policy': _POLICY.value,
      'seed': _SEED.value,
      'push_speed': _PUSH_SPEED.value,
    },
  )


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
