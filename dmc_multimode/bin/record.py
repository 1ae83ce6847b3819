r"""Records a policy that follows a schedule of modes, as a video.

  python -m dmc_multimode.bin.record --policy=quickstart \
    --schedule=walk_forward:2,leap_forward:3 --arena=flat --out=video.mp4

The translucent box is the reference. A robot that falls is recorded on, with
the cause in the frame, unless --terminate is given.
"""

import pathlib
from typing import Sequence

from absl import flags

from dmc_multimode.bin import app
from dmc_multimode.bin import gl
from dmc_multimode.bin import video
from dmc_multimode.modes import schedule

_POLICY = flags.DEFINE_string(
  'policy', None, 'Name of a shipped policy, or folder of a policy or a run.'
)
_SCHEDULE = flags.DEFINE_string(
  'schedule', 'walk_forward:2,leap_forward:3', 'MODE:SECONDS,MODE:SECONDS,...'
)
_ARENA = flags.DEFINE_string(
  'arena', 'flat', 'flat, gap, plateau, block, gap_block or parkour.'
)
_OUT = flags.DEFINE_string('out', None, 'The video to write, an .mp4 file.')
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
  'physics_timestep', None, 'Seconds, against the one that was trained with.'
)
_GHOST = flags.DEFINE_bool('ghost', True, 'Draw the reference.')
_TERMINATE = flags.DEFINE_bool(
  'terminate', False, 'Stop where an episode would end early.'
)
_SLOW_MOTION = flags.DEFINE_float('slow_motion', 1.0, 'Times slower than life.')


def main(argv: Sequence[str]) -> None:
  """Checks the input, then rolls out and draws; `argv` holds no flags."""
  del argv
  names, durations = schedule.parse(_SCHEDULE.value)
  policy, out = _checked_paths()
  gl.choose_backend()
  # These import dm_control, which reads the choice.
  from dmc_multimode import pretrained
  from dmc_multimode.bin import recording
  from dmc_multimode.bin import rollout

  recording.record(
    pretrained.load(policy),
    rollout.RolloutConfig(
      modes=tuple(names),
      durations=tuple(durations),
      arena=_ARENA.value,
      clock_rate=_CLOCK_RATE.value,
      seed=_SEED.value,
      physics_timestep=_PHYSICS_TIMESTEP.value,
      terminate=_TERMINATE.value,
    ),
    recording.RecordingConfig(
      camera=_CAMERA.value,
      width=_WIDTH.value,
      height=_HEIGHT.value,
      ghost=_GHOST.value,
      slow_motion=_SLOW_MOTION.value,
    ),
    out,
  )


def _checked_paths() -> tuple[str, pathlib.Path]:
  """Returns policy and video; raises before anything takes long."""
  if not _POLICY.value:
    raise ValueError('Say which policy to record: --policy=NAME_OR_FOLDER.')
  video.check_size(_WIDTH.value, _HEIGHT.value)
  return _POLICY.value, video.check_path(_OUT.value)


def cli() -> None:
  """Runs the binary."""
  app.run(main)


if __name__ == '__main__':
  cli()
