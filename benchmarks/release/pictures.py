"""Renders every picture and film of README.md and docs, and the tour's outputs.

    python -m benchmarks.release.pictures           # All, which takes a while.
    python -m benchmarks.release.pictures --only=pi2.gif,plan.png

Films, frames and plans are of pi2, the default; the figures that compare
policies are of those that docs/REPRODUCTION.md names. The page of VIEW.md is
not among them: a browser takes it. The tour takes the extra `docs`, and six
minutes of trainings: it runs when --only names it.
"""

import functools
import io
import pathlib
import subprocess
import sys
import tempfile
from typing import Any, Callable, Iterable, Iterator, Mapping, Sequence

from absl import flags
import numpy as np
import PIL.Image
import PIL.ImageSequence

import dmc_multimode as dmm
from dmc_multimode import pretrained
from dmc_multimode import viewer
from dmc_multimode.bin import app
from dmc_multimode.evaluation import figures
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.utils import constants
from dmc_multimode.utils import files
from dmc_multimode.viewer import recording
from dmc_multimode.viewer import video

POLICY = 'pi2'
# Walk, leap, onto the block that launch calls for, leap on top, stand.
SCHEDULE = 'walk_forward:2.4,leap_forward:2.4,launch:2,leap_forward:2.4,idle:2'
_MOMENTS = (1.2, 3.05, 5.45, 7.45, 11.0)  # Seconds, one of each command.
_COMPARED = 'idle:1,walk_forward:2.4,leap_forward:1.2,launch:2,idle:1'
_SIZE = 360, 270  # Pixels of a film and of a frame.
_SMALL = 240, 200  # Pixels of one of two films beside each other.
_LONG = 320, 180  # Pixels of a long film: all together are small.
_COLOURS = 56  # Of a frame of a film.
_NOTE = 'translucent box: where the reference wants the trunk'

_ONLY = flags.DEFINE_list('only', [], 'Pictures to render; all by default.')
_OUT = flags.DEFINE_string('out', 'docs', 'Folder to write to.')
flags.disclaim_key_flags()

# Picture -> (its file, the command that draws it).
_COMMANDS: Mapping[str, tuple[str, str]] = {
  'encoding.png': (
    'encoding.png',
    'dmc_multimode.bin.train_encoder --modes=pi2 --out={out}',
  ),
  **{
    f'{name}_{kind}.png': (
      f'{kind}.png',
      f'dmc_multimode.bin.evaluate --policy={policy} --episodes=1 {more} '
      '--figures={out}',
    )
    # The paper's figures are of the paper's observation, but for pi1's heights.
    for name, policy, kind, more in (
      ('pi2', 'pi2_paper', 'heights', ''),
      ('pi2', 'pi2_paper', 'sequence', ''),
      ('pi2', 'pi2_paper', 'contacts', ''),
      ('pi1', 'pi1', 'heights', ''),
      ('pi3', 'pi3', 'contacts', ''),
      ('pi_all', 'pi_all', 'heights', '--seed=1'),
    )
  },
  **{
    f'{name}_returns.png': (
      'returns.png',
      'dmc_multimode.bin.curves --out={out} '
      f'--run=adaptive={{shipped}}/{name}_paper/training.csv '
      f'--run=uniform={{shipped}}/{name}_uniform/training.csv',
    )
    for name in ('pi1', 'pi2')
  },
  'aliasing.png': (
    'aliasing.png',
    'benchmarks.paper.aliasing --policy=pi2_18m --policy=pi2_one_hot '
    '--figures={out}',
  ),
  'collapse.png': (
    'aliasing.png',
    'benchmarks.paper.aliasing --policy=pi1_21m --policy=pi1_uniform '
    '--modes=idle,leap_left --figures={out}',
  ),
  'blending.png': (
    'blending.png',
    'benchmarks.paper.blending --policy=pi1 --figures={out}',
  ),
  'obstacle_sizes.png': (
    'obstacle_sizes.png',
    'benchmarks.paper.obstacle_sizes --policy=pi2 --seeds=3 --seconds=6 '
    '--figure={out}/obstacle_sizes.png',
  ),
  'switching.png': (
    'switching.png',
    'benchmarks.paper.switching --policy=pi2_paper --before=unimodal_walk '
    '--after=unimodal_launch --figures={out}',
  ),
}


def _film(path: pathlib.Path, policy: str = POLICY, **what: Any) -> None:
  """Records a policy into a GIF."""
  width, height = _SIZE
  config = viewer.RecordingConfig(width=width, height=height)
  dmm.record(policy, out=path, config=config, quiet=True, **what)
  thin(path)


def thin(path: pathlib.Path) -> None:
  """Drops every second frame of a GIF, for a small repository."""
  kept: list[PIL.Image.Image] = []
  durations: list[float] = []
  with PIL.Image.open(path) as film:
    for i, frame in enumerate(PIL.ImageSequence.Iterator(film)):
      if i % 2:
        durations[-1] += frame.info['duration']
        continue
      kept.append(frame.convert('RGB'))
      durations.append(frame.info['duration'])
  kept = video.in_one_palette(kept, _COLOURS)
  content = io.BytesIO()
  kept[0].save(
    content,
    'gif',
    save_all=True,
    append_images=kept[1:],
    duration=durations,
    loop=0,
  )
  files.write(path, content.getvalue())


@functools.cache
def _plan(arena: str, planner: str = 'beam') -> plan_lib.PlanResult:
  """Returns what pi2 is commanded across a track.

  Raises:
    ValueError: it does not get there, and is no picture of a success.
  """
  found = dmm.plan(POLICY, arena=arena, seed=0, planner=planner, quiet=True)
  if not found.success:
    raise ValueError(f'The plan across {arena} does not reach its goal.')
  return found


def _frames(
  policy: str, config: viewer.RolloutConfig, size: tuple[int, int] = _SIZE
) -> Iterator[tuple[np.ndarray, Any]]:
  """Yields frame and step of every control step."""
  viewer.choose_backend()
  from dmc_multimode.viewer import camera

  rolled = viewer.Rollout(dmm.load_policy(policy), config)
  camera.prepare(rolled.task, *size)
  eye = viewer.Camera(rolled.start(), rolled.task, 'side', *size)
  for step in rolled.steps():
    yield eye.render(), step


def _write(path: pathlib.Path, frames: Iterable[np.ndarray]) -> None:
  """Writes the frames of control steps into a GIF."""
  with video.open_writer(path, 1 / constants.CONTROL_TIMESTEP) as append:
    for frame in frames:
      append(frame)
  thin(path)


def _shots(
  config: viewer.RolloutConfig, moments: Sequence[float]
) -> Iterator[tuple[np.ndarray, Any]]:
  """Yields frame and step at these times, seconds."""
  left = list(moments)
  # Every step is drawn: the view follows the robot.
  for frame, step in _frames(POLICY, config):
    if left and step.time > left[0] - constants.CONTROL_TIMESTEP / 2:
      del left[0]
      yield frame, step


def _rollout(schedule: str) -> viewer.RolloutConfig:
  """Returns the roll-out of a schedule."""
  return viewer.RolloutConfig(**recording.scheduled(schedule, 'flat', 0))


def _compared(path: pathlib.Path) -> None:
  """Films pi2_paper and pi2 beside each other, under the same commands."""
  both = [
    _frames(name, _rollout(_COMPARED), _SMALL) for name in ('pi2_paper', POLICY)
  ]
  _write(
    path, (np.hstack([f for f, _ in pair]) for pair in zip(*both, strict=True))
  )


def _strip(
  path: pathlib.Path, config: viewer.RolloutConfig, moments: Sequence[float]
) -> None:
  """Draws frames side by side, each with its mode, its time and two heights."""
  drawn, (axes,) = figures.empty(1, len(moments), 2.2, 2.4)
  drawn.set_layout_engine(None)  # The constrained one crops titles here.
  drawn.subplots_adjust(0.01, 0.25, 0.99, 0.88, wspace=0.04)
  for axis, (frame, step) in zip(axes, _shots(config, moments), strict=True):
    axis.imshow(frame)
    axis.set(xticks=[], yticks=[])
    axis.set_title(f'{step.mode}, {step.time:.1f} s', fontsize='medium')
    axis.set_xlabel(
      f'over ground {step.height:.2f} m\nover world {step.position[2]:.2f} m',
      fontsize='small',
    )
  note = f'heights of the trunk; {_NOTE}'
  drawn.supxlabel(note, fontsize='small', y=0.02)
  figures.save(path, drawn)


def _modes(path: pathlib.Path) -> None:
  """Draws a moment of each of pi2's modes."""
  _strip(path, _rollout(SCHEDULE), _MOMENTS)


def _carried_out(found: plan_lib.PlanResult) -> viewer.RolloutConfig:
  """Returns the roll-out of a plan; it ends soon after the robot stands."""
  known = dmm.load_policy(POLICY).mode_set
  return viewer.RolloutConfig(**recording.planned(found.file(), known))


def _plan_frames(path: pathlib.Path) -> None:
  """Draws five moments of the plan across the gap and onto the block."""
  found = _plan('gap_block')
  config, end = _carried_out(found), sum(found.plan.segments()[1])
  _strip(path, config, np.linspace(0.15 * end, end + 0.9, 5).tolist())


def _plan_figure(path: pathlib.Path) -> None:
  """Draws the plan itself."""
  figures.save(path, dmm.draw_plan(_plan('gap_block')))


def _parkour(path: pathlib.Path) -> None:
  """Films pi2 over 9 m of gaps and blocks, commanded by its selector."""
  config = _carried_out(_plan('gaps_and_blocks', 'selector'))
  _write(path, (frame for frame, _ in _frames(POLICY, config, _LONG)))


def _command(name: str, path: pathlib.Path) -> None:
  """Writes the picture that a command draws."""
  made, words = _COMMANDS[name]
  files.write(path, _drawn_by(words)[made])


@functools.cache
def _drawn_by(words: str) -> dict[str, bytes]:
  """Runs a command; returns all pictures that it draws, by name.

  Raises:
    ChildProcessError: it failed.
  """
  shipped = pathlib.Path(pretrained.__file__).parent
  with tempfile.TemporaryDirectory() as folder:
    given = words.format(out=folder, shipped=shipped).split()
    done = subprocess.run(
      [sys.executable, '-m', *given], stdout=subprocess.DEVNULL
    )
    if done.returncode:
      raise ChildProcessError(f'`{" ".join(given)}` failed.')
    drawn = pathlib.Path(folder).glob('*.png')
    return {picture.name: picture.read_bytes() for picture in drawn}


def _tour(path: pathlib.Path) -> None:
  """Runs the notebook in a kernel, and stores its outputs."""
  import nbclient  # Of the extra `docs`.
  import nbformat

  notebook = nbformat.read(path, as_version=4)
  with tempfile.TemporaryDirectory() as folder:
    resources = {'metadata': {'path': folder}}
    nbclient.NotebookClient(
      notebook, timeout=None, resources=resources
    ).execute()
  for cell in notebook.cells:
    cell.metadata.pop('execution', None)  # When, which changes every time.
    if cell.cell_type == 'code':
      # Bars of progress, in thousands of parts.
      cell.outputs = [o for o in cell.outputs if o.get('name') != 'stderr']
  nbformat.write(notebook, path)


PICTURES: Mapping[str, Callable[[pathlib.Path], None]] = {
  'pi2.gif': functools.partial(_film, schedule=SCHEDULE),
  'before_after.gif': _compared,
  'parkour.gif': _parkour,
  # Of the extra `robots`.
  'go1.gif': functools.partial(
    _film,
    policy='go1_quickstart',
    schedule='trot_forward:2.4,pronk_forward:1.9,stand:0.8',
  ),
  'berkeley.gif': functools.partial(
    _film,
    policy='berkeley_quickstart',
    schedule='walk_forward:2.4,leap_forward:2.4,idle:0.8',
  ),
  'pi2.png': _modes,
  'plan_frames.png': _plan_frames,
  'plan.png': _plan_figure,
  **{name: functools.partial(_command, name) for name in _COMMANDS},
}
_ASKED_FOR = {'tour.ipynb': _tour}


def main(argv: Sequence[str]) -> None:
  """Renders; prints what and how large. `argv` holds no flags."""
  del argv
  known = {**PICTURES, **_ASKED_FOR}
  for name in _ONLY.value:
    if name not in known:
      raise ValueError(f'--only={name}: pictures are {", ".join(known)}.')
  out = files.output_folder('out', _OUT.value)
  if out is None:
    raise ValueError('Say where to write: --out=FOLDER.')
  for name in _ONLY.value or PICTURES:
    known[name](out / name)
    print(f'{out / name}: {(out / name).stat().st_size:,} bytes', flush=True)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
