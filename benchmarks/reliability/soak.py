"""Runs what users run for long, and watches memory and warnings.

    python -m benchmarks.reliability.soak --out=soak.json

Three parts, each of which a 0 leaves out:

- `--steps` control steps of BatchedImitation on random parkour tracks, a new
  one in each episode, under a shipped policy and Algorithm 1;
- `--minutes` of the Composer task under the same policy, episode by episode;
- `--recordings` videos, one after the other, in one process.

Memory is the process's resident set, read along the way; it has grown by what
its median in the last fifth of the part is over that in the second fifth (the
first one warms up), which may be `--most_growth` MiB. Warnings are Python's and
MuJoCo's. OpenGL contexts are counted by asking the garbage collector; file
descriptors and threads, of which the drawing library has its own, by the
system. Ends with 3 where something grew or warned.
"""

import contextlib
import functools
import gc
import os
import pathlib
import tempfile
import time
from typing import Any, Callable, Iterator, Sequence
import warnings

from absl import flags
import mujoco
import numpy as np
import torch

import dmc_multimode
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar
from dmc_multimode.viewer import gl

_POLICY = config_flags.define_path(
  'policy', 'pi2', 'Name of a shipped policy, or a folder.'
)
_STEPS = flags.DEFINE_integer(
  'steps', 1_000_000, 'Control steps of all worlds together.', 0
)
_NUM_WORLDS = flags.DEFINE_integer(
  'num_worlds', 512, 'Worlds that are stepped together.', 1
)
_THREADS = flags.DEFINE_integer(
  'threads', len(os.sched_getaffinity(0)), 'Of the physics.', lower_bound=1
)
_MINUTES = flags.DEFINE_float('minutes', 10.0, 'Of the Composer task.', 0.0)
_RECORDINGS = flags.DEFINE_integer('recordings', 200, 'Videos.', 0)
_MOST_GROWTH = flags.DEFINE_float('most_growth', 8.0, 'MiB in a part.', 0.0)
_SEED = flags.DEFINE_integer('seed', 0, 'Of everything.', 0)
_OUT = config_flags.define_path('out', None, 'JSON file to write.')

_MIB = 1 << 20
_LOOKS = 50  # At the memory, in a part.
_SIZE = 64  # Pixels of a recording.

_COLUMNS = (
  'part | done=amount | seconds:.0f | MiB early=memory_early:.1f | '
  'late=memory_late:.1f | growth:.1f | warnings:d | files=descriptors:d | '
  'threads:d | contexts:d'
)

Row = dict[str, Any]


@contextlib.contextmanager
def _listening(heard: list[str]) -> Iterator[None]:
  """Collects the warnings of Python and of MuJoCo."""
  mujoco.set_mju_user_warning(heard.append)
  try:
    with warnings.catch_warnings(record=True) as caught:
      warnings.simplefilter('always')
      yield
    heard += [f'{w.category.__name__}: {w.message}' for w in caught]
  finally:
    mujoco.set_mju_user_warning(None)


def _resident() -> float:
  """Returns the resident set, MiB."""
  pages = int(pathlib.Path('/proc/self/statm').read_text('ascii').split()[1])
  return pages * os.sysconf('SC_PAGE_SIZE') / _MIB


def _run(name: str, total: float, advance: Callable[[], float]) -> Row:
  """Advances until `total` is reached; returns the row of the table."""
  done, began = 0.0, time.monotonic()
  memory: list[float] = []
  heard: list[str] = []
  with _listening(heard), progress_bar.Bar(total=total, desc=name) as bar:
    while done < total:
      step = advance()
      done += step
      bar.update(min(step, total - bar.n))
      if done * _LOOKS >= len(memory) * total:
        gc.collect()
        memory.append(_resident())
  fifth = max(len(memory) // 5, 1)
  early = float(np.median(memory[fifth : 2 * fifth]))
  late = float(np.median(memory[-fifth:]))
  contexts = [type(x) is mujoco.MjrContext for x in gc.get_objects()]
  return {
    'part': name,
    'amount': f'{done:,.0f}',
    'seconds': time.monotonic() - began,
    'memory_early': early,
    'memory_late': late,
    'growth': late - early,
    'warnings': len(heard),
    'first_warnings': heard[:5],
    'descriptors': len(os.listdir('/proc/self/fd')),
    'threads': len(os.listdir('/proc/self/task')),
    'contexts': sum(contexts),
  }


def soak_worlds(policy: Any) -> Row:
  """Steps BatchedImitation on random tracks."""
  worlds = dmc_multimode.make_worlds(
    policy,
    _NUM_WORLDS.value,
    _SEED.value,
    policy.config,
    'parkour',
    _THREADS.value,
  )
  seen = [worlds.reset()]

  def advance() -> float:
    seen[0] = worlds.step(policy.select_action(seen[0])).observation
    return float(worlds.num_worlds)

  return _run('BatchedImitation, steps', _STEPS.value, advance)


def soak_composer(policy: Any) -> Row:
  """Steps the Composer task for so many minutes."""
  from dmc_multimode.suite import multimode_biped

  task = multimode_biped.make_task(policy.mode_set, config=policy.config)
  environment = multimode_biped.make_environment(task, random=_SEED.value)
  timestep, now = [environment.reset()], [time.monotonic()]

  def advance() -> float:
    if timestep[0].last():
      timestep[0] = environment.reset()
    action = policy.actor.select_action(timestep[0].observation)
    timestep[0] = environment.step(action)
    before, now[0] = now[0], time.monotonic()
    return now[0] - before

  return _run('Composer, seconds', 60 * _MINUTES.value, advance)


def soak_recordings(policy: Any) -> Row:
  """Makes one video after the other."""
  from dmc_multimode.viewer import recording

  what = [(policy.mode_set.names[0], 0.12)]
  config = recording.RecordingConfig(width=_SIZE, height=_SIZE)
  with tempfile.TemporaryDirectory() as folder:
    out = pathlib.Path(folder) / 'video.mp4'

    def advance() -> float:
      recording.record(policy, what, out=out, config=config, quiet=True)
      if not out.stat().st_size:
        raise ValueError('An empty video.')
      out.unlink()
      return 1.0

    return _run('recordings', _RECORDINGS.value, advance)


def _problems(rows: Sequence[Row]) -> list[str]:
  """Returns what must not be, a line each."""
  found = []
  for row in rows:
    if row['growth'] > _MOST_GROWTH.value:
      found.append(f'{row["part"]}: memory grew by {row["growth"]:.1f} MiB.')
    found += [f'{row["part"]}: {text}' for text in row['first_warnings']]
    if row['contexts'] > 1:
      found.append(f'{row["part"]}: {row["contexts"]} contexts are left.')
  return found


def main(argv: Sequence[str]) -> int:
  """Runs the parts, prints, writes."""
  del argv
  if _RECORDINGS.value:
    gl.choose_backend()  # Before anything imports dm_control, as this does:
  from benchmarks import common

  out = files.output_file('out', _OUT.value)
  torch.set_num_threads(1)
  parts = (
    (_STEPS.value, soak_worlds),
    (_MINUTES.value, soak_composer),
    (_RECORDINGS.value, soak_recordings),
  )
  policy = dmc_multimode.load_policy(_POLICY.value)
  rows = [part(policy) for wanted, part in parts if wanted]
  common.print_table(_COLUMNS, rows)
  problems = _problems(rows)
  print('\n'.join(problems) or 'Nothing grew, nothing warned.')
  report: Row = {'benchmark': 'soak', 'table': rows, 'problems': problems}
  for flag in (_POLICY, _NUM_WORLDS, _THREADS, _SEED):
    report[flag.name] = flag.value
  common.write_report(out, report)
  return app.EXIT_UNSOLVED if problems else 0


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
