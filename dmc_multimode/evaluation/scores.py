"""Scores of a policy: modes, transitions and acceptance criteria.

MRA is the mean normalised return of Krishna and Nguyen, Table II: the share of
the highest reward that an episode earns, 1 being the most.
"""

import itertools
import os
from typing import Any, Mapping, Sequence

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.agents import distributed
from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import episodes as evaluation_episodes
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import gait_metrics
from dmc_multimode.evaluation import motion
from dmc_multimode.evaluation import switching
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import terminations

MODE_FACTOR = 4  # Ratio of episodes of a mode to those of a transition.


def evaluate(
  policy: str | os.PathLike[str] | pretrained.Policy,
  seed: int = 0,
  episodes: int = 4,
  clock_rate: float = 1.0,
  clock_rates: Sequence[float] = (),
  physics_timestep: float | None = None,
  quiet: bool = False,
  communicator: distributed.Communicator = distributed.LOCAL,
  switching_episodes: int = 0,
  with_motion: bool = True,
  disturbed: events.TrainingEvents | Mapping[str, float] = events.NONE,
) -> dict[str, Any]:
  """Evaluates every mode and every transition, deterministically.

  Args:
    policy: name of a shipped one, a folder, or a policy.
    seed: of the initial states.
    episodes: of each transition at each phase and clip; 4 times as many of each
      mode.
    clock_rate: of the modes.
    clock_rates: further rates at which to measure travelling modes.
    physics_timestep: seconds; `constants.PHYSICS_TIMESTEP` if None.
    quiet: hides the progress bars.
    communicator: of the ranks, which share the episodes.
    switching_episodes: of random switches, see `switching.evaluate`.
    with_motion: measures how the modes move, see `motion.evaluate`.
    disturbed: disturbances of all robots by name, as arguments of
      `events.fixed`, or its result.

  Returns:
    JSON values: scores, what is asked for besides, and the policy's
    `provenance`.

    `mra_modes`, `mra_transitions`: over the modes or transitions, of the mean
    normalised return, in [0, 1]; `survival_modes`, `survival_transitions`:
    share of the episodes that no termination ends.

    `modes`: by mode, means over its episodes.
      mra, survival: as above.
      velocity, lateral_velocity: of the trunk along world x and y after the
        first second, m/s.
      reference_velocity: of the reference along x, likewise, m/s.
      turn_rate: mean rate of the yaw after the first second, to the left,
        rad/s.
      height: mean of the trunk over the ground below it, m.
      apex: greatest height in a cycle, mean of the cycles, m.
      rise: range of the height in a cycle, mean of the cycles, m.
      flight: longest time in a cycle without a foot on the ground, mean of the
        cycles, s.
      single_support: share of the time with just one foot on the ground.
      alternation: share of single touch-downs that follow one of the other
        foot, after the first second.
      agreement: share, over steps and feet after the first second, in which a
        foot is on the ground, or off it, as in the reference; without meaning
        where that leaves contacts free.
      drift: greatest horizontal distance from the start, m.
      position_error: mean distance of the trunk from the reference, m.
      final_height: of the trunk in the world, at the end, m.

    `transitions`: mra and survival of each, 'FROM->TO'.

    `acceptance`: by mode, criteria in episodes of 5.1 s, each with its `value`,
    the `worst` of the episodes, `least` and `most` (null for none) and
    `passed`. drift, turn_rate, rise, flight, alternation: as above.
      speed: along the reference's way after the first second, m/s.
      bob: greatest deviation of the height from its mean, likewise, m.
      stance: longest time on all feet at the height after a jump, s.
      lean_right, lean_left, lean_ahead, lean_back: greatest angle to which the
        trunk leans in a cycle, mean of the cycles, rad.

    `motion`: by mode, how it moves; null where there is nothing to measure.
      action_change, action_change_p99: change of a joint target from one
        control step to the next, mean and 99th percentile, rad.
      fast_action_power: share of the actions' power above 5 Hz.
      torque_rms, torque_peak: root mean square, and greatest, of the servos'
        torques, Nm.
      power: positive mechanical power of all servos, mean, W.
      cost_of_transport: positive work over weight and distance.
      touch_down_speed, touch_down_speed_p99: of the corners of soles as they
        come into the ground, mean and 99th percentile, m/s.
      slip: horizontal speed of a sole that bears a tenth of the weight, mean,
        m/s.
      penetration_p99: depth of a loaded foot under the ground, 99th percentile,
        mm.
      limit_excess: farthest that a joint is beyond its limit, degrees.
      hip_yaw_at_limit: share of the time that a hip yaw is within half a degree
        of a limit, or beyond.
      peak_force: greatest force of the ground in an episode, mean, body
        weights.
      stance_asymmetry: |left - right| / (left + right) of the times on the
        feet, mean.
      drift_60s: greatest horizontal distance from the start in 60 s, mean, of
        standing modes, m.

  Raises:
    FileNotFoundError: there is no such policy.
    ValueError: a file is damaged, or a number is out of bounds.
  """
  if episodes < 1:
    raise ValueError(f'episodes must be positive, got {episodes}.')
  if not all(0 < rate < np.inf for rate in clock_rates):
    raise ValueError('clock_rates must be positive and finite.')
  if isinstance(policy, (str, os.PathLike)):
    policy = pretrained.load(policy)
  if not isinstance(disturbed, events.TrainingEvents):
    disturbed = events.fixed(**disturbed)
  evaluator = make_evaluator(
    policy, seed, physics_timestep, quiet, communicator, disturbed
  )
  values = report(evaluator, episodes, clock_rate)
  if with_motion:
    values['motion'] = motion.evaluate(
      evaluator, MODE_FACTOR * episodes, clock_rate
    )
  if switching_episodes:
    values['switching'] = switching.evaluate(evaluator, switching_episodes)
  if clock_rates:
    values['clock_rates'] = evaluate_clock_rates(
      evaluator, MODE_FACTOR * episodes, clock_rates
    )
  values['provenance'] = dict(policy.provenance)
  return values


def make_evaluator(
  policy: pretrained.Policy,
  seed: int = 0,
  physics_timestep: float | None = None,
  quiet: bool = False,
  communicator: distributed.Communicator = distributed.LOCAL,
  disturbed: events.TrainingEvents = events.NONE,
) -> evaluator_lib.Evaluator:
  """Returns the evaluator of a policy on its own task; see `evaluate`."""
  changes: dict[str, Any] = {'events': disturbed}
  if physics_timestep is not None:
    changes['physics_timestep'] = physics_timestep
  config = task_config.evaluated(policy.config, **changes)
  return evaluator_lib.Evaluator(policy, config, seed, quiet, communicator)


def evaluate_modes(
  evaluator: evaluator_lib.Evaluator, episodes: int, clock_rate: float
) -> dict[str, dict[str, float]]:
  """Returns MRA, survival and gait metrics of every mode by itself."""
  bank = evaluator.mode_set.bank
  modes = np.repeat(np.arange(len(bank)), episodes)
  found = evaluator.run(schedule_lib.single(modes, clock_rate), 'modes')
  result = {}
  for i, name in enumerate(bank.names):
    mine = found.rows(np.flatnonzero(modes == i))
    traces = evaluator.traces(mine, bank.durations[i] / clock_rate)
    rows = [gait_metrics.metrics(trace) for trace in traces]
    result[name] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
      **{key: float(np.mean([row[key] for row in rows])) for key in rows[0]},
    }
  return result


def evaluate_clock_rates(
  evaluator: evaluator_lib.Evaluator, episodes: int, rates: Sequence[float]
) -> dict[str, dict[str, dict[str, float]]]:
  """Returns speeds and scores of travelling modes at other clock rates.

  For speed and survival tracking limits are off, for robots that cannot keep
  up: only a fall ends an episode. MRA is that of the task.

  Returns:
    By rate and mode: speed along the mode's direction, that of the reference,
      m/s, survival, and MRA. Empty if no mode travels.
  """
  bank = evaluator.mode_set.bank
  limits = terminations.falls_alone(evaluator.config.limits)
  free = evaluator.changed(limits=limits)
  lengths = np.linalg.norm(bank.displacements[:, :2], axis=1)
  travelling = np.flatnonzero(lengths)
  if not len(travelling):
    return {}
  modes = np.repeat(travelling, episodes)
  result: dict[str, dict[str, dict[str, float]]] = {}
  for rate in rates:
    schedule = schedule_lib.single(modes, rate)
    found = free.run(schedule, f'clock rate {rate:g}')
    limited = evaluator.run(schedule, f'clock rate {rate:g}, MRA')
    row = result[f'{rate:g}'] = {}
    for i in travelling:
      mine = found.rows(np.flatnonzero(modes == i))
      way = bank.displacements[i, :2] / lengths[i]
      traces = free.traces(mine, bank.durations[i] / rate)
      speeds = [t.velocity(t.position)[:2] @ way for t in traces]
      row[bank.names[i]] = {
        'reference': float(rate * lengths[i] / bank.durations[i]),
        'velocity': float(np.mean(speeds)),
        'survival': float(mine.survived.mean()),
        'mra': float(limited.returns[modes == i].mean()),
      }
  return result


def evaluate_acceptance(
  evaluator: evaluator_lib.Evaluator, episodes: int
) -> dict[str, dict[str, dict[str, Any]]]:
  """Returns the findings of every mode's acceptance criteria."""
  bank = evaluator.mode_set.bank
  longer = evaluator.changed(time_limit=acceptance.DURATION)
  modes = np.repeat(np.arange(len(bank)), episodes)
  run = longer.run(schedule_lib.single(modes), 'acceptance')
  result = {}
  for i, mode in enumerate(bank.motions):
    mine = run.rows(np.flatnonzero(modes == i))
    traces = longer.traces(mine, mode.duration)
    result[mode.name] = {
      found.metric: {
        'value': found.value,
        'worst': found.worst,
        'least': found.least if np.isfinite(found.least) else None,
        'most': found.most if np.isfinite(found.most) else None,
        'passed': found.passed,
      }
      for found in acceptance.check(mode, traces, evaluator.config.robot.size)
    }
  return result


def evaluate_transitions(
  evaluator: evaluator_lib.Evaluator, episodes: int
) -> dict[str, dict[str, float]]:
  """Returns scores of all transitions, over the phases and clips of Alg. 1."""
  mode_set = evaluator.mode_set
  n = len(mode_set)
  cases = np.array(
    list(
      itertools.product(
        range(n),
        range(n),
        schedule_lib.CLIPS,
        schedule_lib.SWITCH_PHASES,
        range(episodes),
      )
    )
  )
  initial, final = cases[:, 0].astype(int), cases[:, 1].astype(int)
  found = evaluator.run(
    schedule_lib.transitions(
      mode_set,
      initial,
      final,
      cases[:, 2],
      cases[:, 3],
    ),
    'transitions',
  )
  result = {}
  for i, f in itertools.product(range(n), range(n)):
    mine = found.rows(np.flatnonzero((initial == i) & (final == f)))
    result[f'{mode_set.names[i]}->{mode_set.names[f]}'] = {
      'mra': float(mine.returns.mean()),
      'survival': float(mine.survived.mean()),
    }
  return result


def report(
  evaluator: evaluator_lib.Evaluator, episodes: int, clock_rate: float
) -> dict[str, Any]:
  """Returns all scores as JSON values."""
  modes = evaluate_modes(evaluator, MODE_FACTOR * episodes, clock_rate)
  transitions = evaluate_transitions(evaluator, episodes)
  gather = lambda rows, key: np.array([row[key] for row in rows.values()])
  return {
    'mra_modes': evaluation_episodes.summary(gather(modes, 'mra')),
    'mra_transitions': evaluation_episodes.summary(gather(transitions, 'mra')),
    'survival_modes': float(gather(modes, 'survival').mean()),
    'survival_transitions': float(gather(transitions, 'survival').mean()),
    'modes': modes,
    'acceptance': evaluate_acceptance(evaluator, MODE_FACTOR * episodes),
    'transitions': transitions,
    'seed': evaluator.seed,
    'episodes_per_case': episodes,
    'clock_rate': clock_rate,
    'task': task_config.summary(evaluator.config),
  }
