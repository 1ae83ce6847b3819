"""Survival of random switches: many commands, one after the other.

Transitions have one switch each, at moments of Algorithm 1. Here a robot gets
another mode every 0.5 to 2 s for 20 s, whatever it is doing, or only when its
reference is on the ground. It survives if it does not fall.
"""

from typing import Any

import numpy as np

from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import reference as reference_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import terminations

SECONDS = 20.0
EPISODES = 256
_LEAST, _MOST = 0.5, 2.0  # Seconds between commands.


def evaluate(
  evaluator: evaluator_lib.Evaluator, episodes: int = EPISODES
) -> dict[str, Any]:
  """Returns the share of robots that switches do not fell, as JSON values.

  By `any_moment` and `from_ground`: `survival`, and `falls` by the mode that
  ran. Empty for a policy of one mode.

  Args:
    evaluator: of the policy.
    episodes: of each kind.
  """
  mode_set = evaluator.mode_set
  if len(mode_set) < 2:
    return {}
  free = evaluator.changed(
    time_limit=SECONDS,
    limits=terminations.falls_alone(evaluator.config.limits),
  )
  result: dict[str, Any] = {'seconds': SECONDS, 'episodes': episodes}
  for name, waits in (('any_moment', False), ('from_ground', True)):
    # The same modes and intervals for both.
    random_state = np.random.RandomState(evaluator.seed)
    schedule = random_schedule(mode_set, episodes, SECONDS, waits, random_state)
    found = free.run(schedule, f'switches {name}')
    worlds = np.flatnonzero(~found.survived)
    last = found.traces['mode'][found.lengths[worlds] - 1, worlds]
    counts = np.bincount(last, minlength=len(mode_set))
    falls = zip(mode_set.names, counts.tolist(), strict=True)
    result[name] = {
      'survival': float(found.survived.mean()),
      'falls': {mode: count for mode, count in falls if count},
    }
  return result


def random_schedule(
  mode_set: mode_set_lib.ModeSet,
  count: int,
  seconds: float,
  from_ground: bool,
  random_state: np.random.RandomState,
) -> schedule_lib.ModeSchedule:
  """Returns `count` schedules of random modes, a new one every 0.5 to 2 s.

  Args:
    mode_set: of at least two modes.
    count: of schedules.
    seconds: that each lasts.
    from_ground: postpones commands as `schedule.transitions` does.
    random_state: source of modes and intervals.
  """
  knots = int(np.ceil(seconds / _LEAST))
  modes = np.zeros((count, knots), dtype=np.int64)
  starts = np.full((count, knots), np.inf)
  modes[:, 0] = random_state.randint(len(mode_set), size=count)
  starts[:, 0] = 0.0
  for i in range(1, knots):
    # Any mode but the one that runs.
    others = random_state.randint(1, len(mode_set), size=count)
    modes[:, i] = (modes[:, i - 1] + others) % len(mode_set)
    intervals = random_state.uniform(_LEAST, _MOST, count)
    if from_ground:
      intervals = _postponed(mode_set.bank, modes[:, i - 1], intervals)
    starts[:, i] = starts[:, i - 1] + intervals
  starts[starts >= seconds] = np.inf
  return schedule_lib.ModeSchedule(modes, starts, np.ones(count))


def _postponed(
  bank: reference_lib.ReferenceBank, modes: np.ndarray, seconds: np.ndarray
) -> np.ndarray:
  """Postpones commands, `seconds` after those of `modes`, to the ground, [B].

  By the rule of `schedule.transitions`.
  """
  cycles = seconds / bank.durations[modes]
  phases = np.where(bank.transient[modes], np.minimum(cycles, 1), cycles % 1)
  cycles += bank.grounded(modes, phases, schedule_lib.PUSH_OFF) - phases
  # A jump is not left before its end.
  cycles = np.maximum(cycles, bank.touchdowns[modes] > 0)
  return cycles * bank.durations[modes]
