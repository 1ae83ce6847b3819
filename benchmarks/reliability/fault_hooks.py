"""Faults inside a training, installed in the process that trains.

Every function here changes the running process for good, and is meant for a
child of `fault_runs` alone.
"""

import functools
import hashlib
import math
import os
import random
import signal
import time
from typing import Any, Callable, Mapping

import numpy as np
import torch

from dmc_multimode.agents import checkpointing
from dmc_multimode.agents import runner
from dmc_multimode.pretrained import policy as policy_lib
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import core as imitation_core

Loop = runner.TrainingLoop


def digest(tensors: Mapping[str, Any]) -> str:
  """Returns a hash of all names, types, shapes and bits."""
  found = hashlib.sha256()
  for name in sorted(tensors):
    value = np.ascontiguousarray(torch.as_tensor(tensors[name]).cpu().numpy())
    found.update(f'{name} {value.dtype} {value.shape}'.encode())
    found.update(value.tobytes())
  return found.hexdigest()[:16]


def journal(path: str) -> None:
  """Notes each iteration with a hash of everything, and each checkpoint.

  Lines: `at STEPS HASH` after an iteration, `saved STEPS`. What is written
  survives the death of the process.
  """
  file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
  note = lambda text: os.write(file, f'{text}\n'.encode())
  run = Loop.run

  def noted_run(
    self: Loop, config: Any, logger: Any, save: Any, *rest: Any
  ) -> None:
    learn = self._learner.step

    def learned(*args: Any) -> Any:
      metrics = learn(*args)
      note(f'at {self.steps} {digest(self.state()[0])}')
      return metrics

    def saved() -> None:
      save()
      note(f'saved {self.steps}')

    setattr(self._learner, 'step', learned)  # noqa: B010
    run(self, config, logger, saved, *rest)

  setattr(Loop, 'run', noted_run)  # noqa: B010


def checkpoint_every(seconds: float) -> None:
  """Checkpoints more often than the command would."""
  often = functools.partial(runner.TrainingConfig, checkpoint_seconds=seconds)
  setattr(runner, 'TrainingConfig', often)  # noqa: B010


def die_in_checkpoint(call: int, share: float) -> None:
  """Kills this process before one of the fsyncs and renames of checkpoints.

  Only a share of the file has been written if `call` is an fsync.
  """
  inside, count = [False], [0]

  def entering(function: Callable[..., Any]) -> Callable[..., Any]:
    def wrapped(*args: Any) -> Any:
      inside[0] = True
      try:
        return function(*args)
      finally:
        inside[0] = False

    return wrapped

  def deadly(function: Callable[..., Any]) -> Callable[..., Any]:
    def wrapped(*args: Any) -> Any:
      if inside[0]:
        if count[0] == call:
          if wrapped is os.fsync:
            os.ftruncate(args[0], int(share * os.fstat(args[0]).st_size))
          os.kill(os.getpid(), signal.SIGKILL)
        count[0] += 1
      return function(*args)

    return wrapped

  for owner in (checkpointing.Checkpointer, policy_lib.Policy):
    setattr(owner, 'save', entering(owner.save))  # noqa: B010
  os.fsync, os.replace = deadly(os.fsync), deadly(os.replace)


def _before_collecting(change: Callable[[Loop, int], Any]) -> None:
  """Calls `change` with the loop and the iteration that it begins."""
  collect = Loop._collect

  def changed(self: Loop, *args: Any) -> Any:
    change(self, self.iterations + 1)
    return collect(self, *args)

  setattr(Loop, '_collect', changed)  # noqa: B010


def slow(seconds: float, iteration: int | None = None) -> None:
  """Delays one rollout, or all, by `seconds`."""

  def wait(loop: Loop, now: int) -> None:
    if iteration in (None, now):
      time.sleep(seconds)

  _before_collecting(wait)


def world_goes_nan(iteration: int, world: int) -> None:
  """Makes the state of a world NaN before an iteration."""

  def poison(loop: Loop, now: int) -> None:
    if now == iteration:
      loop._environment.qvel[world, 3] = math.nan  # type: ignore[attr-defined]

  _before_collecting(poison)


def worlds_go_nan(iteration: int) -> None:
  """Makes the states of all worlds NaN before every step of an iteration."""
  step, current = batched_env.BatchedImitation.step, [0]

  def poisoned(self: Any, actions: np.ndarray) -> Any:
    if current[0] == iteration:
      self.qvel[:, 3] = math.nan
    return step(self, actions)

  _before_collecting(lambda loop, now: current.__setitem__(0, now))
  setattr(batched_env.BatchedImitation, 'step', poisoned)  # noqa: B010


def reward_goes_nan(iteration: int) -> None:
  """Makes one reward of an iteration NaN."""
  advance, armed = imitation_core.ImitationCore.advance, [False]

  def poisoned(self: Any, *args: Any) -> imitation_core.Outcome:
    outcome = advance(self, *args)
    if armed[0]:
      outcome.reward[0] = math.nan
      armed[0] = False
    return outcome

  _before_collecting(lambda loop, now: armed.__setitem__(0, now == iteration))
  setattr(imitation_core.ImitationCore, 'advance', poisoned)  # noqa: B010


def as_user(user: int) -> None:
  """Gives up being root, to whom no file is read-only."""
  os.setgid(user)
  os.setuid(user)


def clock_jumps(seed: int) -> None:
  """Makes the clock on the wall jump by years, the other leap by hours."""
  jumps, wall, monotonic = random.Random(seed), time.time, time.monotonic
  leapt = [0.0]

  def jumping() -> float:
    return max(wall() + jumps.uniform(-1, 1) * 365 * 86400, 0.0)

  def leaping() -> float:
    leapt[0] += 3600.0 * (jumps.random() < 0.1)
    return monotonic() + leapt[0]

  time.time, time.monotonic = jumping, leaping
