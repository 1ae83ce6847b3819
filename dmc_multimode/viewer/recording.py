"""A roll-out as a video: the physics, drawn, captioned and encoded."""

import dataclasses
import math
import pathlib
from typing import NamedTuple

import numpy as np
import tqdm

from dmc_multimode import pretrained
from dmc_multimode.viewer import camera as scene
from dmc_multimode.viewer import captions as overlay
from dmc_multimode.viewer import robot
from dmc_multimode.viewer import rollout as rollout_lib
from dmc_multimode.viewer import video

_SHOWN = 0.6  # Seconds for which a push is written into the frames.


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
  """How a roll-out is drawn.

  Attributes:
    camera: one of `scene.VIEWS`, or a camera of the model.
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


def record(
  policy: pretrained.Policy,
  rollout_config: rollout_lib.RolloutConfig,
  config: RecordingConfig,
  out: pathlib.Path,
) -> None:
  """Films a policy and prints how each command went; see `film`."""
  filmed = film(policy, rollout_config, config, out)
  for outcome in filmed.outcomes:
    print(outcome)
  print(f'wrote {out} ({filmed.steps} frames)')


class Filmed(NamedTuple):
  """What a video shows.

  Attributes:
    outcomes: how each command went.
    steps: control steps.
  """

  outcomes: list[rollout_lib.Outcome]
  steps: int


def film(
  policy: pretrained.Policy,
  rollout_config: rollout_lib.RolloutConfig,
  config: RecordingConfig,
  out: pathlib.Path,
  quiet: bool = False,
) -> Filmed:
  """Rolls out and writes the video.

  A frame a control step; the file appears when it is complete.

  Args:
    policy: what acts.
    rollout_config: what it does.
    config: how that is drawn.
    out: the video, an .mp4 or a .gif file.
    quiet: whether there is no progress bar.

  Raises:
    ValueError: a mode, arena or camera is unknown, or a number out of bounds.
    OSError: the video cannot be written.
  """
  rollout = rollout_lib.Rollout(policy, rollout_config)
  scene.prepare(rollout.task, config.width, config.height)
  physics = rollout.start()
  start = physics.data.qpos[:3].copy()
  camera = scene.Camera(
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
  steps: list[robot.Step] = []
  captions = Captions(rollout)
  with bar, video.open_writer(out, rate) as append:
    for step in bar:
      steps.append(step)
      append(captions.draw(camera.render(), step))
  outcomes = rollout_lib.outcomes(rollout_config, start, steps)
  return Filmed(outcomes, len(steps))


class Captions:
  """Writes what a step led to into its frame."""

  def __init__(self, rollout: rollout_lib.Rollout):
    """Captions the steps of `rollout`, in their order."""
    self._rollout = rollout
    self._names = rollout.task.mode_set.names
    self._timeline = overlay.Timeline(
      rollout.schedule.modes[0].tolist(), rollout.ends.tolist()
    )
    self._warning = ''

  def draw(self, frame: np.ndarray, step: robot.Step) -> np.ndarray:
    """Returns the frame of a step with its caption, uint8 [H, W, 3]."""
    if step.cause != 'none' and not self._warning:
      self._warning = f'failed at {step.time:.2f} s: {step.cause}'
    pushes = tuple(
      f'pushed by ({push.velocity[0]:g}, {push.velocity[1]:g}) m/s'
      for push in self._rollout.pushes
      if 0 < step.time - push.time <= _SHOWN
    )
    caption = overlay.Caption(
      self._names.index(step.mode),
      step.mode,
      (
        f'time {step.time:.2f} s',
        f'height {step.height:.2f} m',
        f'speed {step.speed:.2f} m/s',
        f'reward {step.reward:.2f}',
        *pushes,
      ),
      self._warning,
    )
    total = self._rollout.num_steps * self._rollout.task.control_timestep
    return overlay.draw(frame, caption, self._timeline, step.time / total)
