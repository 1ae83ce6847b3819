"""Videos of roll-outs: rendered, captioned and encoded."""

import dataclasses
import itertools
import os
import pathlib
from typing import (
  Annotated,
  Any,
  Iterator,
  Mapping,
  NamedTuple,
  Sequence,
  TYPE_CHECKING,
)

import numpy as np
import pydantic

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.pretrained import folder
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import progress_bar
from dmc_multimode.viewer import captions
from dmc_multimode.viewer import gl
from dmc_multimode.viewer import video

if TYPE_CHECKING:
  from dmc_multimode import pretrained
  from dmc_multimode.viewer import reference_rollout
  from dmc_multimode.viewer import rollout as rollout_lib
  from dmc_multimode.walkers import robot as robot_lib

_CYCLES = 2  # Of each mode of a reference.
_SlowMotion = Annotated[float, pydantic.Field(ge=0.01, le=100)]


@config_lib.dataclass
class RecordingConfig:
  """Camera, size and speed of a video.

  Attributes:
    camera: 'side', 'front' or 'overview', which follow the robot, or a camera
      of the model; 'side' by default.
    width: pixels, even; 640 by default.
    height: pixels, even; 480 by default.
    ghost: whether the reference is drawn; it is by default.
    slow_motion: seconds of video per second of simulation, 0.01 to 100; 1 by
      default.
  """

  camera: str = 'side'
  width: int = 640
  height: int = 480
  ghost: bool = True
  slow_motion: _SlowMotion = 1.0

  def __post_init__(self) -> None:
    video.check_size(self.width, self.height)


class Outcome(NamedTuple):
  """Outcome of one command of the schedule.

  Attributes:
    mode: name of the mode.
    duration: seconds that the mode ran; 0 if it was never reached.
    cause: first termination cause during the command, 'none' if it survived;
      empty for a reference, which no termination ends.
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
    fate = 'survived, ' if self.cause == 'none' else f'failed ({self.cause}), '
    return (
      f'{self.mode}: {fate * bool(self.cause)}mean speed {self.speed:.2f} m/s, '
      f'peak height {self.peak:.2f} m'
    )


class Recording(NamedTuple):
  """Content of a video.

  Shows the film where it is the result of a notebook's cell.

  Attributes:
    outcomes: of each command.
    steps: control steps.
    out: the film's file.
    compared: of the policy beside, if there is one.
  """

  outcomes: list[Outcome]
  steps: int
  out: pathlib.Path
  compared: 'Recording | None' = None

  def _repr_html_(self) -> str:
    """Returns the film as HTML, for notebooks."""
    return video.to_html(self.out)


def record(
  policy: 'str | os.PathLike[str] | pretrained.Policy | None' = None,
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
  compare: 'str | os.PathLike[str] | pretrained.Policy | None' = None,
  robot: 'str | os.PathLike[str] | robot_lib.Robot | None' = None,
  reference: 'str | os.PathLike[str] | mode_set_lib.ModeSet | None' = None,
) -> Recording:
  """Records a policy that follows a schedule or a plan on a track.

  With a `reference` in the place of a policy, its modes alone: a box, which is
  the trunk, moves through their keyframes, as before a training.

  Args:
    policy: name of a shipped policy, a folder, or a policy.
    schedule: 'MODE:SECONDS,MODE:SECONDS,...' or such pairs; by default of a
      reference two cycles of each mode.
    plan: instead of a schedule, a plan or its file, which also has track, seed
      and pushes.
    out: the video, an .mp4 or a .gif file; missing folders are made.
    arena: name of the track: flat, gap, plateau, block, block_down, gap_block,
      stairs, stepping_stones, slope, rough, parkour, obstacle_course or
      gaps_and_blocks; or several, joined by +, one of which is drawn.
    seed: of the terrain and of the initial state's noise.
    config: of the video: camera, size and speed.
    clock_rate: rate of the phase clock, 1 being the references' own.
    physics_timestep: seconds; `constants.PHYSICS_TIMESTEP` if None.
    terminate: ends the video at a termination of the episode.
    quiet: hides the progress bar.
    compare: another policy to show beside it, with the same schedule and
      camera, each in its own task; or an .mp4 file that was recorded before, in
      this size and at this frame rate, such as one of an earlier version.
    robot: that the policy must have been trained for, or its file; that of a
      reference, by default the mini biped.
    reference: a mode file, names of the library's modes, or a `ModeSet`.

  Raises:
    FileNotFoundError: there is no such policy or plan.
    ValueError: not one of schedule and plan is given, nor one of policy and
      reference; a mode, arena or camera
      is unknown; or a number is out of bounds.
    OSError: there is no OpenGL, or the video cannot be written.
  """
  path = video.check_path(out)
  if (policy is None) == (reference is None):
    raise ValueError('Say what to record: a policy or a reference.')
  if reference is not None:
    if plan is not None or compare is not None:
      raise ValueError('A reference has a schedule, and no plan or comparison.')
    modes = _reference_modes(reference, robot)
    if schedule is None:
      schedule = [(m.name, _CYCLES * m.duration) for m in modes.motions]
    return _film_reference(
      modes,
      {**scheduled(schedule, arena, seed), 'clock_rate': clock_rate},
      robot,
      config or RecordingConfig(),
      path,
      quiet,
    )
  assert policy is not None
  if schedule is not None and plan is None:
    what = scheduled(schedule, arena, seed)
    known = _mode_set(policy)
  elif plan is not None and schedule is None:
    known = _mode_set(policy)
    what = planned(plan, known)
  else:
    raise ValueError('Say what to record: a schedule or a plan.')
  earlier = None
  if isinstance(compare, (str, os.PathLike)):
    if str(compare).endswith(video.SUFFIX):
      earlier, compare = pathlib.Path(compare), None
  others = [] if compare is None else [_mode_set(compare)]
  for each in [known, *others]:
    blended = mode_set_lib.with_blends(each, what['modes'])
    for name in what['modes']:
      blended.index(name)  # Raises, before slow imports.
  gl.choose_backend()
  # It imports dm_control, which reads the choice.
  from dmc_multimode.viewer import rollout as rollout_lib

  rollout_config = rollout_lib.RolloutConfig(
    **what,
    clock_rate=clock_rate,
    physics_timestep=physics_timestep,
    terminate=terminate,
  )
  config = config or RecordingConfig()
  if compare is None:
    policies = {'': find_policy(policy, robot)}
    return film_beside(policies, rollout_config, config, path, quiet, earlier)[
      0
    ]
  names = [
    str(each) if isinstance(each, (str, os.PathLike)) else title
    for each, title in ((policy, 'first'), (compare, 'second'))
  ]
  if names[0] == names[1]:
    raise ValueError(f'{names[0]} cannot be compared with itself.')
  policies = dict(
    zip(names, (find_policy(policy, robot), find_policy(compare)), strict=True)
  )
  first, second = film_beside(policies, rollout_config, config, path, quiet)
  return first._replace(compared=second)


def _reference_modes(
  reference: 'str | os.PathLike[str] | mode_set_lib.ModeSet',
  robot: 'str | os.PathLike[str] | robot_lib.Robot | None',
) -> mode_set_lib.ModeSet:
  from dmc_multimode.modes import library
  from dmc_multimode.walkers import robot as robot_lib

  if isinstance(reference, mode_set_lib.ModeSet):
    return reference
  height = robot_lib.find(robot).stand_height
  return library.mode_set(reference, stand_height=height)


def _film_reference(
  modes: mode_set_lib.ModeSet,
  what: dict[str, Any],
  robot: 'str | os.PathLike[str] | robot_lib.Robot | None',
  config: RecordingConfig,
  path: pathlib.Path,
  quiet: bool,
) -> Recording:
  """Records modes without a policy; see `record`."""
  for name in what['modes']:
    mode_set_lib.with_blends(modes, [name]).index(name)
  gl.choose_backend()
  # These import dm_control, which reads the choice.
  from dmc_multimode.suite import multimode_biped
  from dmc_multimode.viewer import reference_rollout
  from dmc_multimode.viewer import rollout as rollout_lib

  # As the keyframes have it, not as a body that comes from rest can follow it.
  task = dataclasses.replace(
    multimode_biped.config_for(robot), feasible_references=False
  )
  shown = reference_rollout.Reference(modes, task)
  config = dataclasses.replace(config, ghost=True)
  return film_beside(
    {'': shown}, rollout_lib.RolloutConfig(**what), config, path, quiet
  )[0]


def _mode_set(
  policy: 'str | os.PathLike[str] | pretrained.Policy',
) -> mode_set_lib.ModeSet:
  if isinstance(policy, (str, os.PathLike)):
    return folder.mode_set(policy)
  return policy.mode_set


def find_policy(
  policy: 'str | os.PathLike[str] | pretrained.Policy',
  robot: 'str | os.PathLike[str] | robot_lib.Robot | None' = None,
) -> 'pretrained.Policy':
  """Returns a policy, which may be given by its name or folder; see `record`.

  Raises:
    FileNotFoundError: there is no such policy.
    ValueError: it was trained for another robot.
  """
  from dmc_multimode import pretrained
  from dmc_multimode.pretrained import policy as policy_lib

  name = 'the policy'
  if isinstance(policy, (str, os.PathLike)):
    policy, name = pretrained.load(policy), str(policy)
  if robot is not None:
    policy_lib.check_robot(policy, robot, name)
  return policy


def scheduled(
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


def planned(
  plan: str | os.PathLike[str] | plan_lib.PlanFile,
  known: mode_set_lib.ModeSet,
) -> dict[str, Any]:
  """Returns the roll-out's fields that follow from a plan, with its rest.

  It ends a second or so after the robot stands, however long the plan rests.
  """
  if not isinstance(plan, plan_lib.PlanFile):
    plan = plan_lib.PlanFile.read(plan)
  names, durations = plan.plan.segments()
  rest = known.names[plan_lib.rest_mode(known)]
  tail = plan_lib.REST
  if names[-1] == rest:  # In the rest nothing happens any more, but for pushes.
    names, durations = names[:-1], durations[:-1]
    pushed = max((push.time for push in plan.course.pushes), default=0.0)
    tail += max(pushed - sum(durations), 0.0)
  return {
    'modes': (*names, rest),
    'durations': (*durations, tail),
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
  return film_beside({'': policy}, rollout_config, config, out, quiet)[0]


def film_beside(
  policies: 'Mapping[str, pretrained.Policy | reference_rollout.Reference]',
  rollout_config: 'rollout_lib.RolloutConfig',
  config: RecordingConfig,
  out: pathlib.Path,
  quiet: bool = False,
  earlier: pathlib.Path | None = None,
) -> list[Recording]:
  """Rolls out several policies, and writes one video of them side by side.

  Each is in its own task. A picture stays when its roll-out has ended.

  Args:
    policies: by the names to show; '' shows none. Or references instead.
    rollout_config, config, out, quiet: as for `film`; the size is that of one
      policy's picture.
    earlier: a video to show beside them, on the right.

  Raises:
    ValueError: as `film`, or the policies' control steps are of two lengths, or
      the earlier video has another size.
    OSError: the video cannot be written, or the earlier one not read.
  """
  count = len(policies) + (earlier is not None)
  video.check_size(config.width * count, config.height)
  shots = [
    _Shot(policy, name, rollout_config, config)
    for name, policy in policies.items()
  ]
  periods = {shot.rollout.task.control_timestep for shot in shots}
  if len(periods) > 1:
    raise ValueError('The policies act at different periods.')
  sources = [shot.frames() for shot in shots]
  if earlier:
    sources.append(video.read_frames(earlier))
  bar = progress_bar.Bar(
    itertools.zip_longest(*sources),
    'recording',
    max(shot.rollout.num_steps for shot in shots),
    unit='frame',
    disable=quiet,
  )
  size = config.height, config.width, 3
  shown = [np.zeros(size, dtype=np.uint8) for _ in sources]
  rate = 1 / (periods.pop() * config.slow_motion)
  video.check_rate(rate)
  with bar, video.open_writer(out, rate) as append:
    for frames in bar:
      pairs = zip(frames, shown, strict=True)
      shown = [old if new is None else new for new, old in pairs]
      if shown[-1].shape != size:
        raise ValueError(f'{earlier} has another size: record it in this one.')
      append(np.concatenate(shown, axis=1))
  return [
    Recording(
      outcomes(rollout_config, shot.start, shot.steps), len(shot.steps), out
    )
    for shot in shots
  ]


class _Shot:
  """One policy's roll-out before a camera.

  Attributes:
    rollout: the roll-out.
    start: initial position of the trunk, metres, [3].
    steps: made so far.
  """

  def __init__(
    self,
    policy: 'pretrained.Policy | reference_rollout.Reference',
    name: str,
    rollout_config: 'rollout_lib.RolloutConfig',
    config: RecordingConfig,
  ):
    # These import dm_control, which reads MUJOCO_GL.
    from dmc_multimode.viewer import camera as camera_lib
    from dmc_multimode.viewer import reference_rollout
    from dmc_multimode.viewer import rollout as rollout_lib

    self.rollout: rollout_lib.Rollout
    if isinstance(policy, reference_rollout.Reference):
      self.rollout = reference_rollout.ReferenceRollout(policy, rollout_config)
    else:
      self.rollout = rollout_lib.Rollout(policy, rollout_config)
    camera_lib.prepare(self.rollout.task, config.width, config.height)
    physics = self.rollout.start()
    self.start = physics.data.qpos[:3].copy()
    self.steps: list[rollout_lib.Step] = []
    self._camera = camera_lib.Camera(
      physics,
      self.rollout.task,
      config.camera,
      config.width,
      config.height,
      config.ghost,
    )
    self._caption = captions.Captions(self.rollout, name, config.ghost)

  def frames(self) -> Iterator[np.ndarray]:
    """Rolls out; yields a frame a control step, uint8 [H, W, 3]."""
    for step in self.rollout.steps():
      self.steps.append(step)
      yield self._caption.draw(self._camera.render(), step)


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
