r"""Records a video of a policy that follows a mode schedule.

  python -m dmc_multimode.bin.record --policy=quickstart \
    --schedule=walk_forward:2,leap_forward:3 --arena=flat --out=video.mp4

  python -m dmc_multimode.bin.record --policy=pi2 --plan=plan.json \
    --out=video.mp4

  python -m dmc_multimode.bin.record --reference=bow.yaml --schedule=bow:4 \
    --out=bow.mp4

shows the keyframes of modes, before there is a policy: the trunk as a box.

A file with the suffix .gif is a repeating GIF with fewer frames a second. The
translucent box is the reference. After a fall the video continues, with the
cause in the frame, unless --terminate is given.
"""

from typing import Sequence

from absl import flags

from dmc_multimode import viewer
from dmc_multimode.arenas import layouts
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags

_POLICY = config_flags.define_path(
  'policy', None, 'Name of a shipped policy, or folder of a policy or a run.'
)
_REFERENCE = config_flags.define_path(
  'reference',
  None,
  'Instead of a policy a mode file, or names of modes: keyframes alone.',
)
_SCHEDULE = flags.DEFINE_string(
  'schedule', 'walk_forward:2,leap_forward:3', 'MODE:SECONDS,MODE:SECONDS,...'
)
_ARENA = flags.DEFINE_string('arena', 'flat', f'{", ".join(layouts.NAMES)}.')
_PLAN = config_flags.define_path(
  'plan', None, 'A file that `plan` wrote; says schedule, arena, seed, pushes.'
)
_OUT = config_flags.define_path(
  'out', None, 'The video to write, an .mp4 or a .gif file.'
)
_CAMERA = flags.DEFINE_string(
  'camera', 'side', 'side, front, overview, or any camera of the model.'
)
_WIDTH = flags.DEFINE_integer('width', 640, 'Of the frames, pixels; even.')
_HEIGHT = flags.DEFINE_integer('height', 480, 'Of the frames, pixels; even.')
_CLOCK_RATE = flags.DEFINE_float(
  'clock_rate', 1.0, 'Of the modes; 1 is theirs.'
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the terrain and the initial state.')
_PHYSICS_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, 'Seconds; 0.005 by default.'
)
_GHOST = flags.DEFINE_bool('ghost', True, 'Draw the reference.')
_TERMINATE = flags.DEFINE_bool(
  'terminate', False, 'Stop where an episode would end early.'
)
_COMPARE = config_flags.define_path(
  'compare',
  None,
  'Another policy to show beside, or an .mp4 file that was recorded before.',
)
_ROBOT = config_flags.define_robot()
_SLOW_MOTION = flags.DEFINE_float('slow_motion', 1.0, 'Times slower than life.')


def main(argv: Sequence[str]) -> None:
  """Records the video; prints the outcomes. `argv` holds no flags."""
  del argv
  if not _POLICY.value and not _REFERENCE.value:
    raise ValueError('Say which policy to record: --policy=NAME_OR_FOLDER.')
  unsaid = _REFERENCE.value and not flags.FLAGS['schedule'].present
  for name in ('schedule', 'arena', 'seed', 'clock_rate'):
    if _PLAN.value and flags.FLAGS[name].present:
      raise ValueError(f'--plan says what --{name} would: give one of them.')
  recording = viewer.record(
    _POLICY.value,
    None if _PLAN.value or unsaid else _SCHEDULE.value,
    _PLAN.value,
    _OUT.value or '',
    _ARENA.value,
    _SEED.value,
    viewer.RecordingConfig(
      camera=_CAMERA.value,
      width=_WIDTH.value,
      height=_HEIGHT.value,
      ghost=_GHOST.value,
      slow_motion=_SLOW_MOTION.value,
    ),
    clock_rate=_CLOCK_RATE.value,
    physics_timestep=_PHYSICS_TIMESTEP.value,
    terminate=_TERMINATE.value,
    compare=_COMPARE.value,
    robot=_ROBOT.value or None,
    reference=_REFERENCE.value,
  )
  for outcome in recording.outcomes:
    print(outcome)
  if recording.compared:
    print(f'{_COMPARE.value}:')
    for outcome in recording.compared.outcomes:
      print(outcome)
  print(f'wrote {_OUT.value} ({recording.steps} control steps)')


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
