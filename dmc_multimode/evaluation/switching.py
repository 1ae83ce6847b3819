"""Survival of random switches: many commands, one after the other.

Transitions have one switch each, at moments of Algorithm 1. Here a robot gets
another mode every 0.5 to 2 s for 20 s, and obeys at once, whatever it is doing,
or holds a command until it is on the ground, as the task's gate has it. It
survives if it does not fall.
"""

from typing import Any

import numpy as np

from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.modes import mode_set as mode_set_lib
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
  random_state = np.random.RandomState(evaluator.seed)
  schedule = random_schedule(mode_set, episodes, SECONDS, random_state)
  for name, gated in (('any_moment', False), ('from_ground', True)):
    gate = free.changed(commands_from_ground=gated)
    found = gate.run(schedule, f'switches {name}')
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
  random_state: np.random.RandomState,
) -> schedule_lib.ModeSchedule:
  """Returns `count` schedules of random modes, a new one every 0.5 to 2 s.

  Args:
    mode_set: of at least two modes.
    count: of schedules.
    seconds: that each lasts.
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
    starts[:, i] = starts[:, i - 1] + intervals
  starts[starts >= seconds] = np.inf
  return schedule_lib.ModeSchedule(modes, starts, np.ones(count))
