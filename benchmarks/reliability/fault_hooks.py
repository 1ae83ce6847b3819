"""What a training suffers from within: installed in the process that trains.

Every function here changes the running process for good, and is meant for a
child of `fault_process` alone.
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

  Lines: `at STEPS HASH` after an iteration, `saving STEPS`, `saved STEPS`. What
  is written survives the death of the process.
  """
  file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
  note = lambda text: os.write(file, f'{text}\n'.encode())
  step = runner.TrainingLoop.run

  def run(self: Loop, config: Any, logger: Any, save: Any, *rest: Any) -> None:
    learn = self._learner.step

    def learned(buffers: Any, steps: int) -> dict[str, float]:
      metrics = learn(buffers, steps)
      note(f'at {self.steps} {digest(self.state()[0])}')
      return metrics

    def noted() -> None:
      note(f'saving {self.steps}')
      save()
      note(f'saved {self.steps}')

    setattr(self._learner, 'step', learned)  # noqa: B010
    step(self, config, logger, noted, *rest)

  runner.TrainingLoop.run = run  # type: ignore[assignment,method-assign]


def checkpoint_every(seconds: float) -> None:
  """Checkpoints more often than the binary would."""
  often = functools.partial(runner.TrainingConfig, checkpoint_seconds=seconds)
  setattr(runner, 'TrainingConfig', often)  # noqa: B010


def _in_checkpoints(call: Callable[[str, Any], None]) -> None:
  """Lets `call` see what is about to reach the disk: fsyncs and renames."""
  inside = [False]

  def entering(function: Callable[..., Any]) -> Callable[..., Any]:
    def wrapped(*args: Any) -> Any:
      inside[0] = True
      try:
        return function(*args)
      finally:
        inside[0] = False

    return wrapped

  def seen(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def wrapped(*args: Any) -> Any:
      if inside[0]:
        call(name, args[0])
      return function(*args)

    return wrapped

  checkpointer, policy = checkpointing.Checkpointer, policy_lib.Policy
  checkpointer.save = entering(checkpointer.save)  # type: ignore[method-assign]
  policy.save = entering(policy.save)  # type: ignore[method-assign]
  os.fsync = seen('fsync', os.fsync)
  os.replace = seen('replace', os.replace)


def die_in_checkpoint(call: int, share: float) -> None:
  """Kills this process, as `kill -9` does, in the middle of a checkpoint.

  Args:
    call: before which fsync or rename of a checkpoint or its policy, of all of
      them.
    share: of a file whose fsync that is, how much has been written.
  """
  count = [0]

  def die(name: str, what: Any) -> None:
    if count[0] == call:
      if name == 'fsync':
        os.ftruncate(what, int(share * os.fstat(what).st_size))
      os.kill(os.getpid(), signal.SIGKILL)
    count[0] += 1

  _in_checkpoints(die)


def stall(iteration: int) -> None:
  """Stays in one rollout, as a long one would."""
  _before_learning(iteration, iteration, lambda _: time.sleep(300))


def slow(seconds: float) -> None:
  """Lets every rollout take so much longer."""
  _before_learning(0, 1_000_000, lambda _: time.sleep(seconds))


def _before_learning(
  first: int, last: int, change: Callable[[Loop], Any]
) -> None:
  """Calls `change` with the loop before it collects those iterations."""
  collect = runner.TrainingLoop._collect

  def changed(self: Loop) -> None:
    if first <= self.iterations + 1 <= last:
      change(self)
    collect(self)

  runner.TrainingLoop._collect = changed  # type: ignore[method-assign]


def world_goes_nan(iteration: int, worlds: list[int]) -> None:
  """Makes the state of some worlds NaN before an iteration."""

  def poison(loop: Loop) -> None:
    loop._environment.qvel[worlds, 3] = math.nan  # type: ignore[attr-defined]

  _before_learning(iteration, iteration, poison)


def worlds_go_nan(iteration: int) -> None:
  """Makes the states of all worlds NaN before every step of an iteration."""
  step, now = batched_env.BatchedImitation.step, [0]

  def poisoned(self: Any, actions: np.ndarray) -> Any:
    if now[0] == iteration:
      self.qvel[:, 3] = math.nan
    return step(self, actions)

  def note(loop: Loop) -> None:
    now[0] = loop.iterations + 1

  _before_learning(0, 1_000_000, note)
  batched_env.BatchedImitation.step = poisoned  # type: ignore[method-assign]


def as_user(user: int) -> None:
  """Gives up being root, to whom no file is read-only."""
  os.setgid(user)
  os.setuid(user)


def reward_goes_nan(iteration: int) -> None:
  """Makes one reward of an iteration NaN."""
  advance = imitation_core.ImitationCore.advance
  armed = [False]

  def arm(loop: Loop) -> None:
    armed[0] = True

  def poisoned(self: Any, *args: Any) -> imitation_core.Outcome:
    outcome = advance(self, *args)
    if armed[0]:
      armed[0] = False
      outcome.reward[0] = math.nan
    return outcome

  _before_learning(iteration, iteration, arm)
  setattr(imitation_core.ImitationCore, 'advance', poisoned)  # noqa: B010


def clock_jumps(seed: int) -> None:
  """Lets the clock on the wall jump by years, the other one forwards by hours.

  The first can do so in either direction, whenever somebody sets it; POSIX lets
  the second, which never goes back, at most stand still or leap (a machine that
  was suspended).
  """
  jumps, wall, monotonic = random.Random(seed), time.time, time.monotonic
  leapt = [0.0]

  def jumping() -> float:
    return max(wall() + jumps.uniform(-1, 1) * 365 * 86400, 0.0)

  def leaping() -> float:
    leapt[0] += 3600.0 * (jumps.random() < 0.1)
    return monotonic() + leapt[0]

  time.time, time.monotonic = jumping, leaping
