"""Videos of roll-outs: rendered, captioned and encoded."""

import dataclasses
import math
import os
import pathlib
from typing import Any, NamedTuple, Sequence, TYPE_CHECKING

import numpy as np
import tqdm

from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.viewer import captions
from dmc_multimode.viewer import gl
from dmc_multimode.viewer import video

if TYPE_CHECKING:
  from dmc_multimode import pretrained
  from dmc_multimode.viewer import rollout as rollout_lib


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
  """Camera, size and speed of a video.

  Attributes:
    camera: one of `camera.VIEWS`, or a camera of the model.
    width: pixels, even.
    height: pixels, even.
    ghost: whether the reference is drawn.
    slow_motion: seconds of video per second of simulation.
  """

  camera: str = 'side'
  width: int = 640
  height: int = 480
  ghost: bool = True
  slow_motion: float = 1.0

  def __post_init__(self) -> None:
    video.check_size(self.width, self.height)
    if not (math.isfinite(self.slow_motion) and 0 < self.slow_motion <= 100):
      raise ValueError(
        f'slow_motion must be within 0 and 100, got {self.slow_motion}.'
      )


class Outcome(NamedTuple):
  """Outcome of one command of the schedule.

  Attributes:
    mode: name of the mode.
    duration: seconds that the mode ran; 0 if it was never reached.
    cause: first termination cause during the command, 'none' if it survived.
    speed: distance between its ends over its duration, horizontal, m/s.
    peak: greatest height of the trunk over the support plane at the mode's
      start, metres.
  """

  mode: str
  duration: float
  cause: str
  speed: float
  peak: float

  def __str__(self) -> str:
    """Returns one line for people."""
    if not self.duration:
      return f'{self.mode}: not reached'
    fate = 'survived' if self.cause == 'none' else f'failed ({self.cause})'
    return (
      f'{self.mode}: {fate}, mean speed {self.speed:.2f} m/s, '
      f'peak height {self.peak:.2f} m'
    )


class Recording(NamedTuple):
  """Content of a video.

  Attributes:
    outcomes: of each command.
    steps: control steps.
  """

  outcomes: list[Outcome]
  steps: int


def record(
  policy: 'str | os.PathLike[str] | pretrained.Policy',
  schedule: str | Sequence[tuple[str, float]] | None = None,
  plan: str | os.PathLike[str] | plan_lib.PlanFile | None = None,
  out: str | os.PathLike[str] = 'video.mp4',
  arena: str = 'flat',
  seed: int = 0,
  config: RecordingConfig | None = None,
  clock_rate: float = 1.0,
  physics_timestep: float | None = None,
  terminate: bool = False,
  quiet: bool = False,
) -> Recording:
  """Records a policy that follows a schedule or a plan on a track.

  Args:
    policy: name of a shipped policy, a folder, or a policy.
    schedule: 'MODE:SECONDS,MODE:SECONDS,...' or such pairs.
    plan: instead of a schedule, a plan or its file, which also has track, seed
      and pushes.
    out: the video, an .mp4 or a .gif file; missing folders are made.
    arena: name of the track.
    seed: of the terrain and of the initial state's noise.
    config: of the video.
    clock_rate: rate of the phase clock, 1 being the references' own.
    physics_timestep: seconds; the policy's own if None.
    terminate: ends the video at a termination of the episode.
    quiet: hides the progress bar.

  Raises:
    FileNotFoundError: there is no such policy or plan.
    ValueError: not one of schedule and plan is given; a mode, arena or camera
      is unknown; or a number is out of bounds.
    OSError: there is no OpenGL, or the video cannot be written.
  """
  path = video.check_path(out)
  if schedule is not None and plan is None:
    what = _scheduled(schedule, arena, seed)
  elif plan is not None and schedule is None:
    what = _planned(plan)
  else:
    raise ValueError('Say what to record: a schedule or a plan.')
  gl.choose_backend()
  # These import dm_control, which reads the choice.
  from dmc_multimode import pretrained
  from dmc_multimode.viewer import rollout as rollout_lib

  if isinstance(policy, (str, os.PathLike)):
    policy = pretrained.load(policy)
  rollout_config = rollout_lib.RolloutConfig(
    **what,
    clock_rate=clock_rate,
    physics_timestep=physics_timestep,
    terminate=terminate,
  )
  return film(policy, rollout_config, config or RecordingConfig(), path, quiet)


def _scheduled(
  schedule: str | Sequence[tuple[str, float]], arena: str, seed: int
) -> dict[str, Any]:
  """Returns the roll-out's fields that follow from a schedule."""
  if isinstance(schedule, str):
    names, durations = schedule_lib.parse(schedule)
  else:
    names = [name for name, _ in schedule]
    durations = [seconds for _, seconds in schedule]
  return {
    'modes': tuple(names),
    'durations': tuple(durations),
    'arena': arena,
    'seed': seed,
  }


def _planned(
  plan: str | os.PathLike[str] | plan_lib.PlanFile,
) -> dict[str, Any]:
  """Returns the roll-out's fields that follow from a plan."""
  if not isinstance(plan, plan_lib.PlanFile):
    plan = plan_lib.PlanFile.read(plan)
  names, durations = plan.plan.segments()
  return {
    'modes': tuple(names),
    'durations': tuple(durations),
    **plan.course._asdict(),
    'imitation': False,
  }


def film(
  policy: 'pretrained.Policy',
  rollout_config: 'rollout_lib.RolloutConfig',
  config: RecordingConfig,
  out: pathlib.Path,
  quiet: bool = False,
) -> Recording:
  """Rolls out and writes the video; call `gl.choose_backend` before.

  There is one frame a control step. The file is written atomically.

  Args:
    policy: to record.
    rollout_config: of the roll-out.
    config: of the video.
    out: the video, an .mp4 or a .gif file.
    quiet: hides the progress bar.

  Raises:
    ValueError: a mode, arena or camera is unknown, or a number out of bounds.
    OSError: the video cannot be written.
  """
  # These import dm_control, which reads MUJOCO_GL.
  from dmc_multimode.viewer import camera as camera_lib
  from dmc_multimode.viewer import rollout as rollout_lib

  rollout = rollout_lib.Rollout(policy, rollout_config)
  camera_lib.prepare(rollout.task, config.width, config.height)
  physics = rollout.start()
  start = physics.data.qpos[:3].copy()
  camera = camera_lib.Camera(
    physics,
    rollout.task,
    config.camera,
    config.width,
    config.height,
    config.ghost,
  )
  rate = 1 / (rollout.task.control_timestep * config.slow_motion)
  bar = tqdm.tqdm(
    rollout.steps(),
    'recording',
    rollout.num_steps,
    unit='frame',
    disable=quiet,
  )
  steps: list[rollout_lib.Step] = []
  caption = captions.Captions(rollout)
  with bar, video.open_writer(out, rate) as append:
    for step in bar:
      steps.append(step)
      append(caption.draw(camera.render(), step))
  return Recording(outcomes(rollout_config, start, steps), len(steps))


def outcomes(
  config: 'rollout_lib.RolloutConfig',
  start: np.ndarray,
  steps: Sequence['rollout_lib.Step'],
) -> list[Outcome]:
  """Returns the outcome of every command.

  Args:
    config: of the roll-out.
    start: initial position of the trunk, metres, [3].
    steps: all of them.
  """
  result = []
  before, began = start, 0.0
  for command, mode in enumerate(config.modes):
    mine = [step for step in steps if step.command == command]
    if not mine:
      result.append(Outcome(mode, 0.0, 'none', 0.0, 0.0))
      continue
    duration = mine[-1].time - began
    way = np.linalg.norm((mine[-1].position - before)[:2])
    cause = next((s.cause for s in mine if s.cause != 'none'), 'none')
    peak = max(step.rise for step in mine)
    result.append(Outcome(mode, duration, cause, float(way) / duration, peak))
    before, began = mine[-1].position, mine[-1].time
  return result
